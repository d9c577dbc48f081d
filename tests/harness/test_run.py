"""Laws of a run: every selected cell has one row in the end, and none is executed twice."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from harness_world import FULL, NAMES, read, small

from sysid_bench.errors import UsageError
from sysid_bench.harness import fingerprint as fingerprints
from sysid_bench.harness.run import RunResult, run
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.harness.suite.names import Names

HERE = Path(__file__).parent
CALL = "harness_tasks:execute"
ANY = Names(NAMES.robot, NAMES.payload, lambda kind, spec: None)


def go(source: Any, out: Path, **settings: Any) -> RunResult:
    return run(source, out, jobs=2, names=ANY, call=CALL, **settings)


def suite_of(*estimators: str, body: str = "") -> Any:
    """A suite of one experiment whose estimators do what these settings say."""
    tables = [f'[[estimator]]\nuse = "e{i}"\n{text}\n' for i, text in enumerate(estimators)]
    return parse_suite(small(body, estimators="".join(tables)), names=ANY)


@pytest.fixture
def executed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Ids of the cells executed since the last call."""
    log = tmp_path / "executed.log"
    monkeypatch.setenv("SYSID_TEST_LOG", str(log))

    def since() -> list[str]:
        ids = log.read_text().split() if log.exists() else []
        log.write_text("")
        return ids

    return since


def test_every_planned_cell_gets_its_row_and_its_place_in_the_tables(tmp_path: Path) -> None:
    result = go(read(FULL), tmp_path)
    assert (result.exit_code, result.counts, result.open) == (0, {"ok": 56}, 0)
    cells = pd.read_parquet(tmp_path / "cells.parquet")
    assert list(cells["id"]) == [cell.id for cell in result.folder.plan.cells]
    assert len(pd.read_parquet(tmp_path / "joints.parquet")) == 56
    assert len(pd.read_parquet(tmp_path / "parameters.parquet")) == 56


def test_a_second_run_does_nothing_and_a_folder_needs_no_suite(
    tmp_path: Path, executed: Any
) -> None:
    go(read(FULL), tmp_path / "run")
    assert len(executed()) == 56
    for source in (read(FULL), tmp_path / "run", str(tmp_path / "run")):
        result = go(source, tmp_path / "run")
        assert (result.asked, result.counts, result.exit_code) == (0, {"ok": 56}, 0)
    assert executed() == []


def test_only_open_cells_of_an_experiment_are_asked_for(tmp_path: Path, executed: Any) -> None:
    suite = suite_of("", "", "")
    go(suite, tmp_path / "run", select='estimator == "e1"')
    assert len(executed()) == 1
    result = go(tmp_path / "run", None)  # type: ignore[arg-type]
    assert (result.asked, len(executed())) == (2, 2)
    assert result.counts == {"ok": 3}


def test_select_and_limit_take_planned_cells(tmp_path: Path, executed: Any) -> None:
    for _ in range(2):
        result = go(read(FULL), tmp_path / "run", select='robot == "panda"', limit=5)
        assert result.counts == {"ok": 5}
    ids = [cell.id for cell in result.folder.plan.select('robot == "panda"')[:5]]
    assert sorted(executed()) == sorted(ids)


def test_bad_cells_are_rows_with_their_labels_and_the_rest_is_unharmed(tmp_path: Path) -> None:
    text = FULL.replace('use = "ols"', 'use = "ols"\nstatus = "unsupported"').replace(
        'use = "mylab.methods:Geodesic"', 'use = "mylab.methods:Geodesic"\ndo = "die"'
    )
    condition = 'noise == "exact"'
    result = go(parse_suite(text, names=ANY), tmp_path, select=condition)
    assert result.exit_code == 3
    assert result.counts == {"crash": 7, "unsupported": 7}
    cells = result.folder.cells
    crashed = cells[cells["status"] == "crash"]
    assert set(crashed["estimator"]) == {"Geodesic (ours)"}
    assert set(crashed["robot"]) == {"ur5", "panda", "my_arm"}
    assert crashed["reason"].str.contains("SIGSEGV").all()
    assert set(crashed["noise"]) == {"exact"}


@pytest.mark.parametrize(
    ("estimators", "code"),
    [
        (("", ""), 0),
        (("", 'do = "raise"'), 3),
        (("", 'status = "unsupported"'), 0),
        (('status = "unsupported"',), 4),
        (("", 'status = "skipped"\ncrosscheck = "failed"'), 1),
        (('status = "skipped"\ncrosscheck = "failed"',), 1),
        (('status = "skipped"\ncrosscheck = "failed"', 'status = "failed"'), 3),
    ],
)
def test_exit_codes(tmp_path: Path, estimators: tuple[str, ...], code: int) -> None:
    assert go(suite_of(*estimators), tmp_path).exit_code == code
    assert go(suite_of(*estimators), tmp_path, select='robot == "nobody"').exit_code == 4


def test_rerun_failed_and_all(tmp_path: Path, executed: Any) -> None:
    suite = suite_of("", 'status = "failed"', 'status = "unsupported"', 'status = "skipped"')
    assert go(suite, tmp_path / "run").asked == 4
    assert go(suite, tmp_path / "run", rerun="failed").asked == 2
    assert go(suite, tmp_path / "run", rerun="all").asked == 4
    assert len(executed()) == 10
    assert len(go(suite, tmp_path / "run").folder.cells) == 4


def test_rerun_stale_runs_what_a_change_has_touched(tmp_path: Path, executed: Any) -> None:
    for name in ("one.urdf", "two.urdf"):
        (tmp_path / name).write_text("<robot/>")
    text = small().replace('use = "ur5"', 'use = ["file:one.urdf", "file:two.urdf"]')
    suite = parse_suite(text, "suite.toml", tmp_path, ANY)
    go(suite, tmp_path / "run")
    assert len(executed()) == 2
    assert go(suite, tmp_path / "run", rerun="stale").asked == 0
    (tmp_path / "two.urdf").write_text("<robot />")
    for name in ("_file", "_model", "_fingerprint"):
        getattr(fingerprints, name).cache_clear()
    result = go(suite, tmp_path / "run", rerun="stale")
    (changed,) = result.folder.plan.select('robot == "two"')
    assert executed() == [changed.id]
    assert go(suite, tmp_path / "run", rerun="stale").asked == 0


@pytest.mark.long
def test_a_lost_cell_is_repeated_twice_and_then_left(tmp_path: Path, executed: Any) -> None:
    suite = suite_of("", 'do = "killed"', "")
    for asked, losses in ((3, 1), (1, 2), (1, 3), (0, 3), (0, 3)):
        result = go(suite, tmp_path)
        assert (result.asked, result.exit_code) == (asked, 3)
        assert result.counts == {"ok": 2, "lost": 1}
        (lost,) = [r for r in result.folder.rows().rows.values() if r["status"] == "lost"]
        assert lost["losses"] == losses
    assert go(suite, tmp_path, rerun="failed").asked == 1


def test_fail_fast_leaves_open_cells_open(tmp_path: Path) -> None:
    suite = suite_of('do = "raise"', body="[defaults]\nrate = [100, 200, 300, 400, 500, 600]")
    result = run(suite, tmp_path, jobs=1, names=ANY, call=CALL, fail_fast=True)
    assert (result.exit_code, result.counts, result.open) == (3, {"failed": 1}, 5)


def test_events_begin_with_the_plan_and_its_cost(tmp_path: Path) -> None:
    events: list[Any] = []
    result = go(read(FULL), tmp_path, on_event=lambda kind, data: events.append((kind, data)))
    kinds = [kind for kind, _ in events]
    assert kinds[:2] == ["code", "plan"]  # the suite names a plug-in of others
    plan = events[1][1]
    assert (plan["cells"], plan["open"], plan["tasks"]) == (56, 56, 28)
    assert sum(plan["seconds"].values()) == pytest.approx(
        sum(cell.seconds for cell in result.folder.plan.cells)
    )


@pytest.mark.parametrize(
    ("settings", "reported"),
    [
        ({"rerun": "fail"}, "Did you mean 'failed'"),
        ({"limit": 0}, "limit is 0"),
        ({"timeout": "5 parsecs"}, "parsecs"),
        ({"timeout": 0}, "positive"),
        ({"select": "robt == 'x'"}, "'robot'"),
    ],
)
def test_wrong_words_run_nothing(tmp_path: Path, settings: dict[str, Any], reported: str) -> None:
    with pytest.raises(UsageError, match=reported):
        go(read(FULL), tmp_path / "run", **settings)
    assert not list((tmp_path).glob("run/cells/*"))


def test_a_run_goes_on_where_it_is(tmp_path: Path) -> None:
    go(suite_of(""), tmp_path / "run")
    with pytest.raises(UsageError, match="without -o"):
        go(tmp_path / "run", tmp_path / "other")
    with pytest.raises(UsageError, match="frozen"):
        run(tmp_path / "run", names=ANY, call=CALL, overrides={"seed": "1"})


@pytest.mark.long
def test_rows_are_the_same_with_one_worker_and_with_two(tmp_path: Path) -> None:
    one, two = (
        run(read(FULL), tmp_path / str(jobs), jobs=jobs, names=ANY, call=CALL).folder.cells
        for jobs in (1, 2)
    )
    pd.testing.assert_frame_equal(one, two)
