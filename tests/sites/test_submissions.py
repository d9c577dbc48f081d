"""A submission is accepted as it was computed, and refused with the ids of what was changed."""

import json
import math
import random
from collections.abc import Callable, Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

from sysid_bench.apps.site.commands.site import find_rate, random_cells, read_submission, site
from sysid_bench.errors import UsageError
from sysid_bench.harness.run import run
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.work.row_files import ROWS_DIGEST, with_hash, without_hash

SUITE = """
schema = 1
name = "tiny"
seed = 3
[run]
repeats = 10
[defaults]
excitation = { use = "fourier", period = "2 s", cycles = 1 }
held_out = [["ptp"]]
rate = "50 Hz"
noise = { tau = "1 %" }
[[robot]]
use = "scara"
[[estimator]]
use = "ols"
[[estimator]]
use = "wls"
"""


@pytest.fixture(scope="module")
def submitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("submitted")
    (folder / "tiny.toml").write_text(SUITE)
    run(str(folder / "tiny.toml"), folder / "run", jobs=1)
    return folder / "run"


def changed(
    source: Path, target: Path, ids: set[str], change: Callable[[dict[str, Any]], None]
) -> Path:
    """A copy whose rows of some cells are other ones, with valid hashes, in place."""
    run_folder = RunFolder.open(source)
    # Who changes rows leaves their digest out, too.
    environment = {k: v for k, v in run_folder.environment.items() if k != ROWS_DIGEST}
    run_folder.write_plan(target, environment)
    for file in sorted((source / "cells").glob("*.jsonl")):
        lines = []
        for line in file.read_bytes().splitlines():
            row = json.loads(without_hash(line))
            if row["id"] in ids:
                change(row)
                row.pop("row_sha256", None)
                line = with_hash(json.dumps(row).encode())
            lines.append(line + b"\n")
        (target / "cells" / file.name).write_bytes(b"".join(lines))
    return target


def halve(row: dict[str, Any]) -> None:
    row["torque_error"] /= 2


def fail(row: dict[str, Any]) -> None:
    row["status"] = "unsupported"


def test_rows_that_were_changed_are_found_wherever_they_are(
    submitted: Path, tmp_path: Path
) -> None:
    ids = RunFolder.open(submitted).planned
    false = {ids[0]: halve, ids[len(ids) // 2]: fail, ids[-1]: halve}

    def change(row: dict[str, Any]) -> None:
        false[row["id"]](row)

    folder = changed(submitted, tmp_path / "false", {*false}, change)
    result = site((), tmp_path / "site", [folder], seed=1, share=1.0, jobs=1)
    (check,) = result.checks
    assert not result.ok
    assert not (tmp_path / "site").exists()
    assert {one["id"] for one in check.different} == {*false}
    assert all(name in check.summary() for name in false)


@pytest.mark.long
@pytest.mark.parametrize("index", [0, 10, 19])
def test_a_false_row_is_found_where_it_is_drawn(
    submitted: Path, tmp_path: Path, index: int
) -> None:
    ids = RunFolder.open(submitted).planned
    seed = next(s for s in range(1000) if random_cells(sorted(ids), 0.05, s) == [ids[index]])
    folder = changed(submitted, tmp_path / "false", {ids[index]}, halve)
    (check,) = site(submissions=[folder], seed=seed, jobs=1).checks
    assert check.cells == [ids[index]]
    assert [one["id"] for one in check.different] == check.cells
    (honest,) = site(submissions=[submitted], seed=seed, jobs=1).checks
    assert honest.ok


def test_an_honest_submission_joins_the_site_and_a_site_is_replaced(
    submitted: Path, tmp_path: Path
) -> None:
    (submitted / "submission.toml").write_text('schema = 1\nname = "Mine <b>"\nauthors = "A"\n')
    out = tmp_path / "site"
    first = site((), out, [submitted], seed=1, jobs=1)
    assert first.ok
    assert first.checks[0].drawable == 20
    assert len(first.checks[0].cells) == 1
    assert "Mine &lt;b&gt;" in (out / "index.html").read_text()
    site([submitted], out)
    written = {path.relative_to(out): path.read_bytes() for path in out.rglob("*.*")}
    (out / "robots" / "old.html").write_text("gone")
    site([submitted], out)
    assert {path.relative_to(out): path.read_bytes() for path in out.rglob("*.*")} == written
    with pytest.raises(UsageError, match="not a site"):
        site([submitted], submitted.parent)


def test_a_plan_of_another_suite_and_a_changed_line_are_refused(
    submitted: Path, tmp_path: Path
) -> None:
    folder = changed(submitted, tmp_path / "false", set(), halve)
    plan = (folder / "plan.jsonl").read_text()
    (folder / "plan.jsonl").write_text(plan.replace('"robot": "scara"', '"robot": "ur5"', 1))
    (file,) = [path for path in (folder / "cells").glob("*.jsonl") if path.stat().st_size]
    file.write_bytes(file.read_bytes().replace(b'"torque_error":0.0', b'"torque_error":0.00', 1))
    (check,) = site(submissions=[folder], seed=1, jobs=1).checks
    assert check.planned == [RunFolder.open(folder).planned[0]]
    assert len(check.changed) == 1
    assert not check.cells
    assert not check.ok


@pytest.mark.parametrize("text", ["name = 'a'", "schema = 1\nname = 3", "schema = 1\nother = 'x'"])
def test_facts_of_another_form_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "submission.toml").write_text(text)
    with pytest.raises(UsageError):
        read_submission(tmp_path)


def test_the_chance_of_finding_is_that_of_all_draws() -> None:
    for cells, drawn, false in ((6, 2, 1), (7, 3, 2), (8, 1, 4), (5, 5, 1)):
        draws = list(combinations(range(cells), drawn))
        found = sum(any(i < false for i in draw) for draw in draws) / len(draws)
        assert math.isclose(find_rate(cells, drawn, false / cells), found)


def test_every_cell_is_drawn_as_often_as_any_other() -> None:
    ids = [f"{i:012x}" for i in range(40)]
    counts: Mapping[str, int] = dict.fromkeys(ids, 0)
    for seed in range(2000):
        shuffled = random.Random(seed).sample(ids, len(ids))
        drawn = random_cells(ids, 0.05, seed)
        assert len(drawn) == 2
        assert random_cells(shuffled, 0.05, seed) == drawn
        counts = {name: count + (name in drawn) for name, count in counts.items()}
    # Each count is binomial with mean 100 and deviation 9.7.
    assert all(50 < count < 150 for count in counts.values())
