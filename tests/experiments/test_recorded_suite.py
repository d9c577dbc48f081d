"""Recordings as a suite: the same numbers as `identify --log`, one row per cell, always."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sysid_bench.commands.identify import identify
from sysid_bench.commands.report import report, table
from sysid_bench.errors import UsageError
from sysid_bench.harness.cell import Cell
from sysid_bench.harness.fingerprint import cell_fingerprint
from sysid_bench.harness.plan import Plan, cells_of_suite
from sysid_bench.harness.run import run
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.load_suite import parse_stored, parse_suite, suite_text
from tests.robots import named_robot
from tests.signals.logs import recorded, write, write_two

SUITE = """
schema = 1
name = "real"
[run]
timeout = "60 s"
[[log]]
name = "plain"
robot = "ur5"
train = ["run.toml"]
test = [{ use = "other.toml", name = "another motion" }, "again.toml"]
filter = "none"
terms = [["viscous", "coulomb"], ["viscous", "coulomb", "offset"]]
[[log]]
name = "load"
robot = "ur5"
task = "payload"
position_given = true
true_mass = "2 kg"
filter = "none"
train = ["run.toml", { use = "loaded.toml", payload = "box-2kg" }]
[[log]]
name = "all of the load"
robot = "ur5"
task = "payload"
filter = "none"
train = ["run.toml", { use = "loaded.toml", payload = "box-2kg" }]
[[estimator]]
use = "ols"
[[estimator]]
use = "wls"
[[table]]
name = "joints"
rows = ["joint"]
columns = ["terms", "estimator"]
cells = { metric = "joint_error" }
select = 'excitation == "plain"'
[[paper]]
name = "base"
show = "base-parameters"
select = 'excitation == "plain" and estimator == "wls"'
[[paper]]
name = "model"
show = "model"
[[paper]]
name = "torques"
show = "torques"
test = "again"
select = 'excitation == "plain"'
[[paper]]
name = "motion"
show = "motion"
select = 'excitation == "plain"'
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_two(tmp_path_factory.mktemp("suite"))
    first = recorded(named_robot("ur5"), 0)
    louder = replace(first, tau=1.1 * first.tau)
    write(folder, louder, name="again", file="$WHERE_LOGS_ARE/again.csv")
    write(folder, recorded(named_robot("ur5", "box-2kg"), 2), name="loaded")
    (folder / "real.toml").write_text(SUITE)
    return folder


@pytest.fixture(scope="module")
def ran(folder: Path) -> Iterator[RunFolder]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WHERE_LOGS_ARE", str(folder))
        result = run(folder / "real.toml", folder / "out", jobs=1)
        assert result.exit_code == 0, result.counts
        yield result.folder


def plan(folder: Path, old: str = "", new: str = "") -> Plan:
    assert old in SUITE
    return cells_of_suite(parse_suite(SUITE.replace(old, new, 1), folder=folder))


def test_a_cell_is_what_the_command_line_gives(ran: RunFolder, folder: Path) -> None:
    rows = {(r["excitation"], r["terms"], r["estimator"]): r for r in ran.rows().rows.values()}
    assert len(rows) == 8
    tests = [folder / "other.toml", folder / "again.toml"]
    answer = identify("ur5", log=[folder / "run.toml"], test=tests, terms=("viscous", "coulomb"),
                         estimator="wls", filter="none")  # fmt: skip
    row = rows["plain", "viscous coulomb", "wls"]
    for figure in ("rank", "rmse_train", "rmse_test", "torque_error", "condition"):
        assert row[figure] == pytest.approx(answer[figure], rel=1e-9), figure
    assert row["held_out"] == "another motion, again"
    assert row["pipeline"] == answer["signals"]["pipeline"] == "plain"  # with a filter of its own
    robot = named_robot("ur5")
    used = np.max([np.abs(recorded(robot, seed).v).max(axis=0) for seed in (0, 1)], axis=0)
    assert row["v_margin"] == pytest.approx(1 - (used / robot.limits.v).max(), abs=1e-3)
    for joint in row["joints"]:
        assert joint["relative_train"] == answer["training"][joint["name"]]["relative"]
    motions = row["torque_error_by_motion"]
    assert motions["another motion"] < 3e-3
    assert motions["again"] == pytest.approx(0.1 / 1.1, abs=3e-3)
    load = rows["load", "default", "wls"]
    assert load["mass"] == pytest.approx(2.0, rel=2e-3)
    assert load["mass_error"] == pytest.approx(abs(load["mass"] - 2.0))
    assert rows["all of the load", "default", "ols"]["mass"] == pytest.approx(2.0, rel=5e-3)
    assert load["mass_low"] <= load["mass"] <= load["mass_high"]


def test_reports_show_joints_papers_and_torques(ran: RunFolder) -> None:
    page = report(ran.path).read_text()
    assert "Base parameters of ur5" in page
    lines = table(ran.path, "joints").splitlines()
    assert sum(line.startswith(("| shoulder", "| elbow", "| wrist")) for line in lines) == 6
    base = table(ran.path, "base")
    assert sum(line.startswith("| ") for line in base.splitlines()) == 2 + 48
    assert "elbow_joint.fv" in base
    assert r"\begin{tabular}" in table(ran.path, "model", "latex")
    for kind in ("pdf", "svg"):
        assert (ran.path / "figures" / f"torques.{kind}").stat().st_size > 5000
        assert (ran.path / "figures" / f"motion.{kind}").stat().st_size > 5000
    with pytest.raises(UsageError, match="figure"):
        table(ran.path, "torques")


def test_data_that_are_not_there_are_a_reason(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("WHERE_LOGS_ARE", raising=False)
    result = run(folder / "real.toml", tmp_path / "out", jobs=1, select='excitation == "plain"')
    rows = list(result.folder.rows().rows.values())
    assert {row["status"] for row in rows} == {"failed"}
    assert all("variable WHERE_LOGS_ARE" in row["reason"] for row in rows)
    assert result.exit_code == 3


def test_a_fingerprint_looks_at_the_recording(folder: Path, tmp_path: Path) -> None:
    def prints(cells: tuple[Cell, ...], at: Path) -> set[str]:
        return {cell_fingerprint(cell, None, at) for cell in cells[:1]}

    log = recorded(named_robot("ur5"), 5, period=1.0)
    for k, where in enumerate((tmp_path / "a", tmp_path / "b")):
        where.mkdir()
        write(where, replace(log, tau=log.tau + 1e-6 * k))
        for name in ("other", "again", "loaded"):
            write(where, log, name=name)
    cells = plan(tmp_path / "a").cells
    shutil.copytree(tmp_path / "a", tmp_path / "moved")
    assert [cell.id for cell in cells] == [cell.id for cell in plan(tmp_path / "moved").cells]
    # An id holds the content of the recordings: other torques are other cells.
    assert cells[0].id not in {cell.id for cell in plan(tmp_path / "b").cells}
    assert prints(cells, tmp_path / "a").isdisjoint(prints(cells, tmp_path / "b"))
    changed = plan(tmp_path / "a", 'filter = "none"', 'filter = "average 5"').cells
    assert {cell.id for cell in cells}.isdisjoint(
        cell.id for cell in changed if cell.labels["excitation"] == "plain"
    )
    suite = parse_suite(SUITE, folder=tmp_path / "a")
    assert parse_stored(suite_text(suite), "run.toml") == suite
    lines = (line.encode() for line in plan(tmp_path / "a").to_json_lines())
    assert Plan.from_json_lines(lines).cells == cells


MISTAKES = {
    'train = ["run.toml"]': ('train = ["nowhere.toml"]', "nowhere.toml"),
    'robot = "ur5"': ('robot = "ur55"', "ur55"),
    '{ use = "other.toml", name': ('{ use = "other.toml", rte = "1 Hz", name', "rte"),
    'filter = "none"': ('filter = "butterr 4 10 Hz"', "butterr"),
    'terms = [["viscous", "coulomb"]': ('terms = [["viscos", "coulomb"]', "viscos"),
    'true_mass = "2 kg"': ('true_mass = "2 m"', "kg"),
    'cells = { metric = "joint_error" }': ('cells = { metric = "torque_error" }', "joint"),
    'show = "model"': ('show = "modle"', "model"),
    'task = "payload"': ('task = "link"', "payload"),
}


@pytest.mark.parametrize("right", MISTAKES)
def test_mistakes_are_reported_before_anything_runs(folder: Path, right: str) -> None:
    wrong, message = MISTAKES[right]
    with pytest.raises(UsageError, match=message):
        plan(folder, right, wrong)


def test_a_suite_is_about_something() -> None:
    with pytest.raises(UsageError, match=r"\[\[robot\]\].*\[\[log\]\]"):
        parse_suite('schema = 1\nname = "a"\n[[estimator]]\nuse = "ols"')


def test_the_shipped_suite_plans_without_the_data(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SYSID_BENCH_DATA", raising=False)
    path = Path(__file__).parents[2] / "suites" / "dvrk-real.toml"
    cells = cells_of_suite(parse_suite(path.read_text(), folder=path.parent)).cells
    assert {cell.labels["robot"] for cell in cells} == {"dvrk_psm", "dvrk_mtm"}
    assert np.isfinite([cell.seconds for cell in cells]).all()
