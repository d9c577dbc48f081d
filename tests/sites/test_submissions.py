"""A submission is accepted as it was computed, and refused with the ids of what was changed."""

import hashlib
import json
import math
import os
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

from sysid_bench.apps.site.commands.site import find_rate, random_cells, read_submission, site
from sysid_bench.errors import UsageError
from sysid_bench.harness.merge import merge
from sysid_bench.harness.plan import Plan
from sysid_bench.harness.run import run
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.work.row_files import (
    ROWS_DIGEST,
    rows_digest,
    with_hash,
    without_hash,
)
from sysid_bench.package_folders import package_folder

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


METHOD = """
import numpy as np

from sysid_bench.types import Estimate


class Mine:
    def solve(self, problem):
        return Estimate(np.linalg.lstsq(problem.W, problem.b, rcond=None)[0])
"""


def run_of(folder: Path, text: str = SUITE, seed: int = 3) -> Path:
    """A run with the files that its suite names, as somebody submits it."""
    suite = folder / "tiny.toml"
    suite.write_text(text.replace("seed = 3", f"seed = {seed}"))
    (folder / "mine.py").write_text(METHOD)
    run(str(suite), folder / "run", jobs=1)
    (folder / "run" / "mine.py").write_text(METHOD)
    return folder / "run"


@pytest.fixture(scope="module")
def submitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_of(tmp_path_factory.mktemp("submitted"))


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


# --- Falsified submissions ----------------------------------------------------------------------

FEW = SUITE.replace("repeats = 10", "repeats = 2").replace(
    'use = "wls"', 'use = "file:mine.py:Mine"'
)


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four cells, two of them of a method that it brings."""
    return run_of(tmp_path_factory.mktemp("few"), FEW)


def copied(source: Path, target: Path) -> Path:
    return Path(shutil.copytree(source, target))


def with_rows_of(folder: Path, other: Path) -> Path:
    """The rows of another run under the ids of this one, with hashes and digest that agree."""
    ids = dict(zip(RunFolder.open(other).planned, RunFolder.open(folder).planned, strict=True))
    text = b"".join(file.read_bytes() for file in sorted((other / "cells").glob("*.jsonl")))
    lines = []
    for line in text.splitlines():
        row = json.loads(without_hash(line))
        lines.append(with_hash(json.dumps(row | {"id": ids[row["id"]]}).encode()) + b"\n")
    shutil.rmtree(folder / "cells")
    (folder / "cells").mkdir()
    (folder / "cells" / "000001-worker1.jsonl").write_bytes(b"".join(lines))
    stored = RunFolder.open(folder)
    stored.write_environment(stored.environment | {ROWS_DIGEST: rows_digest(folder / "cells")})
    return folder


def checked(folder: Path) -> Any:
    (check,) = site(submissions=[folder], seed=1, share=1.0, jobs=1).checks
    return check


def test_an_honest_submission_with_its_own_method_is_accepted(few: Path, tmp_path: Path) -> None:
    check = checked(few)
    assert check.ok
    assert len(check.cells) == 4
    # On a page with the run of somebody else, unless it lies about its robots.
    folder = copied(few, tmp_path / "again")
    made = site([few], tmp_path / "site", [folder], seed=1, jobs=1)
    assert made.ok
    (entry,) = json.loads((tmp_path / "site" / "leaderboard.json").read_text())["suites"]
    assert len(entry["runs"]) == 2
    records = json.loads((folder / "models.json").read_text())
    false = {name: record | {"hash": "0" * 16} for name, record in records.items()}
    (folder / "models.json").write_text(json.dumps(false))
    assert checked(folder).planned == [*RunFolder.open(few).planned]
    # Merged of runs of two machines, it has the digest of its own rows.
    merge([few, copied(few, tmp_path / "other")], tmp_path / "merged")
    shutil.copy(few / "mine.py", tmp_path / "merged")
    assert checked(tmp_path / "merged").ok


def test_a_false_score_of_an_own_method_is_found(few: Path, tmp_path: Path) -> None:
    own = RunFolder.open(few).planned[1]
    folder = changed(few, tmp_path / "run", {own}, halve)
    shutil.copy(few / "mine.py", folder)
    check = checked(folder)
    assert {one["id"] for one in check.different} == {own}


def test_a_robot_of_a_known_name_is_refused(few: Path, tmp_path: Path) -> None:
    folder, robot = copied(few, tmp_path / "run"), tmp_path / "run" / "robots" / "scara"
    shutil.copytree(str(package_folder("robots") / "scara"), robot)
    for file in robot.glob("*.xml"):
        file.write_text(re.sub(r'mass="[0-9.]+"', 'mass="9"', file.read_text()))
    for file in robot.glob("*.urdf"):
        file.write_text(re.sub(r'mass value="[0-9.]+"', 'mass value="9"', file.read_text()))
    ids = RunFolder.open(folder).planned
    check = checked(folder)
    assert list(check.refused.values()) == [[*ids]]
    assert "give it another name" in check.summary()
    assert ids[0] in check.summary()
    # Under a name of its own it is another suite version, and its plan is not that of the rows.
    robot.rename(robot.with_name("own"))
    manifest = robot.with_name("own") / "robot.toml"
    manifest.write_text(manifest.read_text().replace('"scara"', '"own"', 1))
    suite = folder / "run.toml"
    suite.write_text(suite.read_text().replace('"scara"', '"own"'))
    check = checked(folder)
    assert set(ids) <= set(check.planned)


@pytest.mark.long
def test_rows_of_a_modified_package_are_found_and_it_is_not_imported(
    few: Path, tmp_path: Path
) -> None:
    ids = RunFolder.open(few).planned
    folder = changed(few, tmp_path / "run", {*ids}, halve)
    shutil.copy(few / "mine.py", folder)
    for name in ("sysid_bench", "numpy", "sitecustomize"):
        (folder / f"{name}.py").write_text(f'open({str(tmp_path / "ran")!r}, "a"); 1 / 0\n')
    check = checked(folder)
    assert {one["id"] for one in check.different} == {*ids}
    program = str(Path(sys.executable).with_name("sysid-bench"))
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(
        [program, "site", "--check", "."],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "leave that folder" in done.stderr
    assert not (tmp_path / "ran").exists()


@pytest.mark.long
def test_rows_of_a_better_seed_are_found(few: Path, tmp_path: Path) -> None:
    other = run_of(tmp_path, FEW, seed=4)
    folder = with_rows_of(copied(few, tmp_path / "submitted"), other)
    check = checked(folder)
    assert {one["id"] for one in check.different} == {*RunFolder.open(few).planned}
    # A suite with that seed has other cells than the plan.
    folder = copied(few, tmp_path / "again")
    suite = folder / "run.toml"
    suite.write_text(suite.read_text().replace("seed = 3", "seed = 4"))
    assert set(RunFolder.open(few).planned) <= set(checked(folder).planned)


def test_rows_of_another_machine_are_found(few: Path, tmp_path: Path) -> None:
    def elsewhere(row: dict[str, Any]) -> None:
        row["versions"] = row["versions"] | {"mujoco": "9.9"}

    own = RunFolder.open(few).planned[2]
    folder = changed(few, tmp_path / "run", {own}, elsewhere)
    shutil.copy(few / "mine.py", folder)
    check = checked(folder)
    assert check.refused == {"rows of other versions than env.json states": [own]}
    assert not check.ok
    # With env.json of its own run, the digest is that of other rows.
    (folder / "env.json").write_bytes((few / "env.json").read_bytes())
    assert checked(folder).changed == [f"env.json ({ROWS_DIGEST})"]


def test_a_hidden_plug_in_is_refused_and_not_run(few: Path, tmp_path: Path) -> None:
    ids = RunFolder.open(few).planned
    folder, marker = copied(few, tmp_path / "run"), tmp_path / "ran"
    look = f"open({str(marker)!r}, 'a')\n"
    (folder / "hidden.py").write_text(f"{look}from sysid_bench.types import Metric\n{HIDDEN}")
    suite = folder / "run.toml"
    honest = suite.read_text()
    record = 'record = { name = "own", title = "Own" }'
    metric = f'metric = [{{ use = "file:hidden.py:Own", {record} }}]'
    suite.write_text(honest.replace("metric = []", metric, 1))
    check = checked(folder)
    ((why, cells),) = check.refused.items()
    assert "(metric file:hidden.py:Own)" in why
    assert cells == [*ids]
    assert ids[0] in check.summary()
    # In the plan alone: a method of its own under the label of another.
    suite.write_text(honest)
    cell, *others = RunFolder.open(folder).plan.cells
    own = replace(cell, estimator={"use": "file:hidden.py:Own"})
    (folder / "plan.jsonl").write_text("".join(Plan((own, *others)).to_json_lines()))
    assert {own.id, cell.id} == {*checked(folder).planned}
    assert not marker.exists()


HIDDEN = 'Own = Metric("own", "Own", compute=lambda cell: 0.0)\n'


@pytest.mark.long
def test_sealed_cells_need_their_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    secret, seeds = "0123456789abcdef" * 4, tmp_path / "seeds.txt"
    seeds.write_text(secret)
    seal = hashlib.sha256(secret.encode()).hexdigest()
    (tmp_path / "sealed.toml").write_text(f'schema = 1\nsealed = "{seal}"\neffects = []\n')
    text = FEW.replace("rate =", 'plant = "file:sealed.toml"\nrate =')
    monkeypatch.setenv("SYSID_BENCH_SEEDS", str(seeds))
    folder = run_of(tmp_path, text)
    assert checked(folder).ok
    monkeypatch.delenv("SYSID_BENCH_SEEDS")
    with pytest.raises(UsageError) as error:
        checked(folder)
    assert f"The plant is sealed ({seal[:12]}...)" in str(error.value)
    assert "checks it with SYSID_BENCH_SEEDS = the file" in str(error.value)


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
    with pytest.raises(UsageError, match=r"submission\.toml"):
        read_submission(tmp_path)


def test_a_site_of_runs_reads_their_facts(few: Path, tmp_path: Path) -> None:
    folder = copied(few, tmp_path / "run")
    (folder / "submission.toml").write_text('schema = 1\nname = "Mine"\n')
    site([folder], tmp_path / "site")
    (entry,) = json.loads((tmp_path / "site" / "leaderboard.json").read_text())["suites"]
    assert entry["runs"][0]["submission"]["name"] == "Mine"
    assert any("was not checked" in one for one in entry["limitations"])
    (folder / "submission.toml").write_text("schema = 1\nnames = 3\n")
    for given in ({"runs": [folder], "out": tmp_path / "site"}, {"submissions": [folder]}):
        with pytest.raises(UsageError, match=r"submission\.toml.*'names'"):
            site(**given)


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
