"""Law: a method gives the same row, bit for bit, in a process of its own as beside the truth."""

import json
from pathlib import Path
from typing import Any

import pytest

from sysid_bench.harness.run import run
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.harness.work.confinement import ISOLATION
from sysid_bench.words import MACHINE_FIELDS

HERE = Path(__file__).parent
METHODS = (
    "ols", "wls", "lmi", "iv", "didim", "ekf", "cloe", "ridge", "kalman", "ml", "huber",
    "payload-difference", "log-cholesky", "rollout",
)  # fmt: skip
"""Linear, feasible, recursive and simulating ones, with state and without."""
OWN = MACHINE_FIELDS | {"id", "estimator", "fingerprint", "sources"}


def suite(settings: str, robot: str, methods: tuple[str, ...]) -> Any:
    text = f"""
        schema = 1
        name = "blind"
        [defaults]
        excitation = {{ use = "fourier", harmonics = 3, period = "2 s" }}
        held_out = ["ptp"]
        prior = {{ mass = "20 %" }}
        noise = {{ tau = "1 %" }}
        rate = "100 Hz"
        {settings}
        [[robot]]
        {robot}
        """
    for name in methods:
        own = f"file:{HERE}/every_method.py:{name.replace('-', '_')}"
        text += f'[[estimator]]\nuse = "{name}"\n'
        text += f'[[estimator]]\nuse = "{own}"\nlabel = "blind {name}"\n'
    return parse_suite(text, folder=HERE)


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
