"""Law: a method gives the same row, bit for bit, in a process of its own as beside the truth."""

import io
import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from sysid_bench.harness.run import run
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.harness.work import blind_process
from sysid_bench.harness.work.confinement import ISOLATION
from sysid_bench.reporting.ranking import rank_cells
from sysid_bench.words import MACHINE_FIELDS

from .runners import suite_of

HERE = Path(__file__).parent
METHODS = (
    "ols", "wls", "lmi", "iv", "didim", "ekf", "cloe", "ridge", "kalman", "ml", "huber",
    "payload-difference", "log-cholesky", "rollout",
)  # fmt: skip
"""Linear, feasible, recursive and simulating ones, with state and without."""
OWN = MACHINE_FIELDS | {"id", "estimator", "fingerprint", "sources"}


def suite(settings: str, robot: str, methods: tuple[str, ...]) -> Any:
    defaults = (
        f'prior = {{ mass = "20 %" }}\nnoise = {{ tau = "1 %" }}\nrate = "100 Hz"\n{settings}'
    )
    pairs = []
    for name in methods:
        own = f"file:{HERE}/every_method.py:{name.replace('-', '_')}"
        pairs += [f'use = "{name}"', f'use = "{own}"\nlabel = "blind {name}"']
    return parse_suite(suite_of(pairs, defaults, robot), folder=HERE)


def check(out: Path, settings: str, robot: str, methods: tuple[str, ...]) -> set[str]:
    """Compare the rows of each method; return the statuses."""
    rows = run(suite(settings, robot, methods), out, jobs=1).folder.rows().rows.values()
    found = {row["estimator"]: row for row in rows}
    for name in methods:
        beside, blind = (
            json.dumps({k: v for k, v in found[label].items() if k not in OWN})
            for label in (name, f"blind {name}")
        )
        assert beside == blind, name
        assert found[f"blind {name}"]["isolation"] in ("namespaces", "process")
    return {row["status"] for row in rows}


CLOSED_LOOP = 'simulation = { use = "closed-loop", rate = "500 Hz" }'


@pytest.mark.parametrize(
    ("settings", "robot"),
    [
        (CLOSED_LOOP, 'use = "scara"'),
        (f'{CLOSED_LOOP}\npipeline = {{ use = "parallel" }}', 'use = "dvrk_psm"'),
        ('task = "payload"', 'use = "ur5"\npayloads = ["box-2kg"]'),
        ('task = "robot"', 'use = "solo12"'),
    ],
    ids=["closed loop", "coupled joints", "payload", "free base"],
)
def test_rows_of_a_simulated_robot(tmp_path: Path, settings: str, robot: str) -> None:
    assert "ok" in check(tmp_path, settings, robot, METHODS)


def test_rows_without_namespaces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on systems that have none."""
    monkeypatch.setenv(ISOLATION, "process")
    assert check(tmp_path, CLOSED_LOOP, 'use = "scara"', ("ols", "cloe")) == {"ok"}


def test_what_a_method_returns_beside_its_estimate_has_a_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever reads a run reads all its rows; both ends of the process name the limit."""
    keys = f'use = "file:{HERE}/every_method.py:Talkative"\nlabel = "{{0}} bytes"\nsize = {{0}}'
    text = suite_of(keys.format(size) for size in (900_000, 1_100_000))
    rows = run(parse_suite(text, folder=HERE), tmp_path, jobs=1).folder.rows().rows.values()
    few, many = sorted(rows, key=lambda row: str(row["estimator"]), reverse=True)
    assert few["status"] == "ok"
    assert many["status"] == "failed"
    assert "1.1 MB; 1 MB are stored" in many["reason"]
    monkeypatch.setattr(blind_process, "_LONGEST", 1000)
    ((message),) = blind_process._messages(io.BytesIO(b"{" + b" " * 2000))
    assert "more than 0 MB" in message["error"][1]
    assert "'stats'" in message["error"][1]


def test_a_method_that_declares_link_frames_is_not_ranked(tmp_path: Path) -> None:
    """What it says of itself reaches its rows: a text, cut, or the bare fact; nothing else does."""
    given = {"text": '"it favours  an axis"', "true": "true", "long": '"' + 999 * "x" + '"'}
    given |= {"number": "7"}
    turned = f"file:{HERE}/every_method.py:Turned"
    keys = [f'use = "{turned}"\nlabel = "{k}"\ndeclared = {v}' for k, v in given.items()]
    text = suite_of(['use = "ols"', *keys])
    rows = run(parse_suite(text, folder=HERE), tmp_path, jobs=1).folder.rows().rows.values()
    assert {row["status"] for row in rows} == {"ok"}
    declared = {row["estimator"]: row.get("frame_dependent") for row in rows}
    assert declared == {
        "ols": None, "number": None, "text": "it favours an axis",
        "true": "its answer depends on the frames of the links", "long": 200 * "x",
    }  # fmt: skip
    spec = {"name": "r", "metric": "torque_error", "against": "ols"}
    [ranking] = rank_cells(pd.DataFrame(list(rows)), spec)
    assert {*ranking.method_names} == {"ols", "number"}
    assert {*ranking.left_out} == {"text", "true", "long"}
