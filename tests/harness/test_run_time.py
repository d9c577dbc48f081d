"""Laws of the expected time of a run: earlier rows decide, a table fills the rest."""

from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
from harness_world import FULL, NAMES, read

from sysid_bench.harness.cell import Cell, cell_cost, run_cost
from sysid_bench.harness.frames import Frames
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.run_time import StoredTimes, run_time, stored_times
from sysid_bench.harness.stored_run import RunFolder

CELLS = cells_of_suite(read(FULL), NAMES).cells
ROBOTS = len({(cell.labels["robot"], cell.labels["payload"]) for cell in CELLS})


def rows(cells: tuple[Cell, ...], factor: float) -> pd.DataFrame:
    """Rows of cells that took `factor` times as long as the table has it."""
    return pd.DataFrame(
        {
            **cell.first_fields,
            "seconds_cpu": factor * cell_cost(cell.spec, cell.estimator).estimator,
            "seconds_experiment_cpu": factor * cell_cost(cell.spec, cell.estimator).experiment,
        }
        for cell in cells
    )


def times(cells: tuple[Cell, ...], factor: float, monkeypatch: pytest.MonkeyPatch) -> StoredTimes:
    frames = Frames(lambda name, fields: rows(cells, factor))
    folder = SimpleNamespace(frames=lambda: frames)
    monkeypatch.setattr(RunFolder, "open", lambda path: folder)
    return stored_times([Path("reports/full")])


def work(cells: tuple[Cell, ...]) -> float:
    """Seconds of the table without start and robots."""
    parts = {cell.experiment: cell_cost(cell.spec, cell.estimator).experiment for cell in cells}
    return sum(parts.values()) + sum(cell_cost(c.spec, c.estimator).estimator for c in cells)


def test_without_earlier_rows_the_table_counts_each_experiment_once() -> None:
    found = run_time(CELLS, StoredTimes())
    assert found.seconds == pytest.approx(run_cost([work(CELLS)], ROBOTS))
    assert found.source == "from a table"
    assert run_time((), StoredTimes()).seconds == 0.0


@pytest.mark.parametrize("factor", [0.01, 1.0, 50.0])
def test_the_same_cells_take_what_they_took(factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    found = run_time(CELLS, times(CELLS, factor, monkeypatch))
    assert found.seconds == pytest.approx(run_cost([factor * work(CELLS)], ROBOTS))
    assert (found.known, found.source) == (len(CELLS), "from rows of reports/full")


@pytest.mark.parametrize(("factor", "used"), [(0.01, 1 / 3), (2.0, 2.0), (50.0, 3.0)])
def test_what_no_row_has_follows_the_speed_of_the_machine(
    factor: float, used: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = tuple(c for c in CELLS if c.labels["robot"] == CELLS[0].labels["robot"])
    done = tuple(c for c in done if c.labels["estimator"] == done[0].labels["estimator"])
    rest = tuple(c for c in CELLS if c.labels["estimator"] != done[0].labels["estimator"])
    rest = tuple(c for c in rest if c.labels["robot"] != done[0].labels["robot"])
    both = (*done, *rest)
    found = run_time(both, times(done, factor, monkeypatch))
    robots = len({(cell.labels["robot"], cell.labels["payload"]) for cell in both})
    assert found.known == len(done)
    wanted = run_cost([factor * work(done), used * work(rest)], robots)
    assert found.seconds == pytest.approx(wanted)
    assert found.source == "from rows of reports/full and a table"


def test_folders_that_cannot_be_read_have_no_times(tmp_path: Path) -> None:
    (tmp_path / "plan.jsonl").write_text("{")
    assert stored_times([tmp_path, tmp_path / "absent"]) == StoredTimes()
