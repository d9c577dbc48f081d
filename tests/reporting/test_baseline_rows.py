"""Laws of null models and floors in tables and rankings: they stand beside methods, and change
nothing of them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sysid_bench.evaluation.baselines import Baselines
from sysid_bench.reporting.baseline_rows import BASELINES, with_baselines
from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.ranking import Ranking, correct_together, rank_cells
from sysid_bench.reporting.ranking_tables import verdict_table

METHODS = ("wls", "ols", "lmi")
FIELDS = [field for fields in BASELINES.values() for field in fields]


def fabricate(seed: int, robots: int = 9) -> pd.DataFrame:
    """Errors of three methods with the baselines of each experiment, some of them absent."""
    rng, rows = np.random.default_rng(seed), []
    for robot in range(robots):
        fields: dict[str, float | None] = {name: rng.uniform(0.05, 1.0) for name in FIELDS}
        if robot % 2:
            fields["torque_error_floor"] = None
        if robot % 4 == 1:
            fields["torque_error_best"] = None
        for method in METHODS:
            failed = method == "ols" and robot == 0
            rows.append({
                "id": f"{robot}{method}", "experiment": f"e{robot}", "robot": f"r{robot}",
                "repeat": 0, "estimator": method, "status": "failed" if failed else "ok",
                "reason": "It gave up." if failed else None, "seconds": 1.0,
                "torque_error": None if failed else rng.uniform(0.05, 0.5), **fields,
            })  # fmt: skip
    return pd.DataFrame(rows)


def table(lines: pd.DataFrame, **spec: Any) -> Any:
    given: dict[str, Any] = {"name": "t", "rows": ["estimator"], "columns": ["robot"]}
    given["cells"] = {"metric": "torque_error"}
    return build_table(lines, given | spec)


def ranking(cells: pd.DataFrame) -> Ranking:
    [one] = correct_together(rank_cells(cells, {"name": "r", "metric": "torque_error"}))
    return one


@pytest.mark.parametrize("seed", range(3))
def test_an_entry_of_a_baseline_is_that_of_its_experiment(seed: int) -> None:
    cells = fabricate(seed).sample(frac=1, random_state=seed)
    made = table(cells, best="min-bold")
    assert {row[0] for row in made.rows} == {*METHODS, *BASELINES}
    assert any("Null model" in note for note in made.notes)
    for (row,), (robot,) in made.entries:
        entry = made.entries[(row,), (robot,)]
        if row not in METHODS:
            known = cells[cells["robot"] == robot][[*BASELINES[row]]].iloc[0].dropna()
            assert entry.value == min(known)
            assert not entry.best  # no method, which competes
    absent = [("floor",), ("r1",)]
    assert tuple(absent) not in made.entries


@pytest.mark.parametrize("seed", range(3))
def test_baselines_change_nothing_of_methods(seed: int) -> None:
    cells = fabricate(seed)
    plain = cells.drop(columns=FIELDS)
    with_them, without = table(cells), table(cells, baselines=False)
    assert with_them.rows[: len(METHODS)] == without.rows
    assert {key: with_them.entries[key] for key in without.entries} == without.entries
    assert table(plain).rows == without.rows
    one, two = ranking(cells), ranking(plain)
    assert not two.baselines
    assert {each.method for each in one.baselines} == {*BASELINES}
    assert one.method_names == two.method_names
    assert one.corrected == two.corrected
    assert one.verdicts == two.verdicts == 2
    np.testing.assert_array_equal(one.win_rates, two.win_rates)
    for a, b in zip(one.comparisons, two.comparisons, strict=True):
        assert (a.ratio, a.p, a.cells) == (b.ratio, b.p, b.cells)


def test_a_ranking_states_baselines_beside_methods_and_tests_none() -> None:
    cells = fabricate(1)
    one = ranking(cells)
    made = verdict_table(one)
    assert [row[0] for row in made.rows[-len(BASELINES) :]] == [*BASELINES]
    ratio = cells.drop_duplicates("experiment")["torque_error_null"].to_numpy(float)
    of_wls = cells[cells["estimator"] == "wls"]["torque_error"].to_numpy(float)
    entry = made.entries[("null model",), ("ratio",)]
    assert entry.value == pytest.approx(np.exp(np.median(np.log(ratio / of_wls))))
    assert made.entries[("null model",), ("verdict",)].text == "baseline"
    assert made.entries[("null model",), ("p",)].value is None
    assert made.entries[("floor",), ("robots",)].value == 7


def test_a_baseline_that_some_cases_lack_has_no_ratio_there() -> None:
    """Floors of one plant alone would stand beside methods over all plants."""
    known = fabricate(4).assign(torque_error_floor=0.01, torque_error_best=0.02)
    lines = [known.assign(plant=plant, experiment=known["experiment"] + plant) for plant in "ab"]
    fields = ["torque_error_floor", "torque_error_best"]
    lines[1][fields] = None
    pooled = ranking(pd.concat(lines, ignore_index=True))
    assert [one.method for one in pooled.baselines] == ["null model"]
    assert not any("Floor" in note for note in verdict_table(pooled).notes)
    lines[1].loc[lines[1]["robot"] != "r3", fields] = 0.01
    *_, floor = ranking(pd.concat(lines, ignore_index=True)).baselines
    assert (floor.method, floor.robots, floor.statuses) == ("floor", 8, {})


def test_other_metrics_have_no_baselines() -> None:
    cells = fabricate(2)
    assert table(cells, cells={"metric": "seconds"}).rows == tuple((one,) for one in METHODS)
    both = table(cells, columns=[], metrics=["torque_error", "seconds"], cells={})
    assert both.entries[("null model",), ("seconds",)].value is None
    by_robot = table(cells, rows=["robot"], columns=[])
    assert len(by_robot.rows) == 9
    assert len(with_baselines(cells.drop(columns="experiment"))) == len(cells)


@pytest.mark.parametrize("seed", range(4))
def test_the_gap_is_closed_by_the_floor_and_not_by_the_null(seed: int) -> None:
    """Absent where no floor is below the null model, whatever the error."""
    rng = np.random.default_rng(seed)
    null, floor, error = np.sort(rng.uniform(0.1, 1.0, 3))[[2, 0, 1]]
    known = Baselines({"file-friction": null}, floor, None)
    assert known.gap_closed(null) == 0.0
    assert known.gap_closed(floor) == pytest.approx(1.0)
    assert 0.0 < (known.gap_closed(error) or 0.0) < 1.0
    assert (known.gap_closed(null * 1.1) or 0.0) < 0.0
    for high in (null, null * 1.5, None):
        assert replace(known, floor=high).gap_closed(error) is None
    assert replace(known, floor=None, best=floor).gap_closed(error) == known.gap_closed(error)
