"""Laws of tables: no cell is lost, no order matters, the best is the best."""

import csv
import io
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_bench.csv_text import csv_text
from sysid_bench.errors import UsageError
from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.selection import label, with_labels
from sysid_bench.reporting.tables import Table
from sysid_bench.reporting.writers import to_csv, to_markdown

STATS = ("median", "mean", "min", "max", "count")
INTERVALS = ("none", "iqr", "std", "range", "ci95")
LAYOUTS: tuple[tuple[list[str], list[str]], ...] = (
    (["robot", "payload"], ["estimator"]),
    (["robot"], ["noise", "estimator"]),
    (["estimator"], []),
    (["payload", "estimator"], ["noise"]),
)


def table_of(cells: pd.DataFrame, rows: list[str], columns: list[str], **cell: str) -> Table:
    wanted = {"metric": "torque_error", **cell}
    return build_table(
        cells, {"name": "t", "rows": rows, "columns": columns, "cells": wanted, "best": "min-bold"}
    )


@pytest.mark.parametrize(("rows", "columns"), LAYOUTS)
def test_every_cell_is_counted_once(
    cells: pd.DataFrame, rows: list[str], columns: list[str]
) -> None:
    table = table_of(cells, rows, columns)
    counted = [e.n + e.n_failed + e.missing for e in table.entries.values()]
    assert sum(counted) == len(cells)
    lost = sum(e.n_failed for e in table.entries.values())
    assert lost == (cells["status"] != "ok").sum()


@pytest.mark.parametrize("stat", STATS)
@pytest.mark.parametrize("interval", INTERVALS)
def test_the_order_of_the_rows_changes_no_number(
    cells: pd.DataFrame, stat: str, interval: str
) -> None:
    shuffled = cells.sample(frac=1, random_state=5)
    one = table_of(cells, ["robot"], ["estimator"], stat=stat, interval=interval).entries
    two = table_of(shuffled, ["robot"], ["estimator"], stat=stat, interval=interval).entries
    assert set(one) == set(two)
    for key, entry in one.items():
        np.testing.assert_allclose(numbers(entry), numbers(two[key]), rtol=1e-12)
        assert dict(entry.failures) == dict(two[key].failures)


@pytest.mark.parametrize("interval", INTERVALS)
def test_another_robot_changes_no_other_number(cells: pd.DataFrame, interval: str) -> None:
    two_robots = cells[cells["robot"] != "panda"]
    fewer = table_of(two_robots, ["robot"], ["estimator"], interval=interval).entries
    more = table_of(cells, ["robot"], ["estimator"], interval=interval).entries
    assert all(numbers(more[key]) == numbers(entry) for key, entry in fewer.items())


@pytest.mark.parametrize("interval", ["iqr", "range", "std", "ci95"])
@pytest.mark.parametrize("stat", ["median", "mean"])
def test_an_interval_holds_its_number(cells: pd.DataFrame, stat: str, interval: str) -> None:
    noisy = cells[cells["noise"] != "exact"]
    table = table_of(noisy, ["robot"], ["estimator"], stat=stat, interval=interval)
    for entry in table.entries.values():
        assert entry.value is not None
        assert entry.low is not None
        assert entry.high is not None
        if (stat, interval) != ("mean", "iqr"):  # a mean may leave the quartiles
            assert entry.low <= entry.value <= entry.high
        assert entry.low < entry.high


def test_nothing_is_measured_from_one_repeat(cells: pd.DataFrame) -> None:
    table = table_of(cells[cells["repeat"] == 0], ["robot"], ["estimator"], interval="ci95")
    assert all(entry.low is None for entry in table.entries.values())


def test_a_group_without_a_number_shows_its_most_frequent_failure(cells: pd.DataFrame) -> None:
    table = table_of(cells, ["robot", "payload"], ["estimator"])
    lost = {key: e for key, e in table.entries.items() if e.value is None}
    assert {key[0][0] for key in lost} == {"anymal_c"}
    for (_, column), entry in lost.items():
        assert entry.label == ("unsupported" if column == ("wls",) else "failed")


def test_a_group_with_some_failures_has_a_note_that_counts_them(cells: pd.DataFrame) -> None:
    table = table_of(cells, ["robot", "payload"], ["estimator"])
    for entry in table.entries.values():
        silent = entry.value is not None and entry.n_failed > 0 and not entry.note
        assert not silent
        if entry.note:
            assert f"{entry.n_failed} of {entry.n_failed + entry.n}" in entry.note
            assert entry.note in table.note_labels


def test_ok_without_a_value_is_no_number_and_no_failure(cells: pd.DataFrame) -> None:
    table = table_of(cells.assign(payload_error=np.nan), ["robot"], [], metric="payload_error")
    for entry in table.entries.values():
        assert entry.value is None
        assert entry.n == 0
        assert entry.missing > 0


@pytest.mark.parametrize(("rows", "columns"), LAYOUTS)
@pytest.mark.parametrize("best", ["min-bold", "max-bold"])
def test_the_best_are_those_that_no_competitor_beats(
    cells: pd.DataFrame, rows: list[str], columns: list[str], best: str
) -> None:
    wanted = {"metric": "torque_error"}
    table = build_table(cells, {"rows": rows, "columns": columns, "cells": wanted, "best": best})
    fields = rows + columns
    sign = 1 if best == "min-bold" else -1
    for key, entry in table.entries.items():
        rivals = [
            max(other.value, table.metric.floor)
            for place, other in table.entries.items()
            if other.value is not None
            and all(
                mine == theirs
                for name, mine, theirs in zip(
                    fields, key[0] + key[1], place[0] + place[1], strict=True
                )
                if name != "estimator"
            )
        ]
        if len(rivals) > 1 and len(set(rivals)) == 1:
            assert not entry.best
        elif entry.value is not None and max(rivals) > table.metric.floor:
            ours = max(entry.value, table.metric.floor)
            assert entry.best or sign * ours != min(sign * v for v in rivals)
        if entry.best:
            assert entry.value is not None
            ours = max(entry.value, table.metric.floor)
            assert sign * ours <= min(sign * v for v in rivals) + ours * 0.01


def test_plants_do_not_compete(cells: pd.DataFrame) -> None:
    """Neither the columns of a row nor numbers that pool levels have a best across levels."""
    levels = pd.concat([cells.assign(plant=level) for level in ("L0", "L1")])
    levels["torque_error"] *= np.where(levels["plant"] == "L0", 1.0, 100.0)
    alone = table_of(levels, ["robot"], ["plant"])
    assert not any(entry.best for entry in alone.entries.values())
    methods = table_of(levels, ["robot"], ["plant", "estimator"])
    best = {column[0] for (_, column), entry in methods.entries.items() if entry.best}
    assert best == {"L0", "L1"}
    pooled = table_of(levels, ["robot"], ["estimator"])
    assert not any(entry.best for entry in pooled.entries.values())
    single = table_of(levels[levels["plant"] == "L1"], ["robot"], ["estimator"])
    assert any(entry.best for entry in single.entries.values())


def test_numbers_that_print_alike_are_all_best() -> None:
    values = {"a": 0.12341, "b": 0.12339, "c": 0.2}
    rows = [
        {"robot": "r", "estimator": k, "status": "ok", "torque_error": v} for k, v in values.items()
    ]
    table = table_of(pd.DataFrame(rows), ["robot"], ["estimator"])
    assert [e.best for e in table.entries.values()] == [True, True, False]


@pytest.mark.parametrize(
    ("values", "best"),
    [
        ([3e-15, 2e-15], [False, False]),
        ([3e-15, 2e-15, 1e-3], [True, True, False]),
        ([0.25, 0.25, 0.25], [False, False, False]),
        ([0.25, 0.25, 0.5], [True, True, False]),
    ],
)
def test_rounding_is_no_merit(values: list[float], best: list[bool]) -> None:
    rows = [
        {"robot": "r", "estimator": str(k), "status": "ok", "torque_error": v}
        for k, v in enumerate(values)
    ]
    table = table_of(pd.DataFrame(rows), ["robot"], ["estimator"])
    assert [e.best for e in table.entries.values()] == best


def test_columns_that_differ_in_the_estimator_alone_are_printed_alike() -> None:
    rows = [
        {"robot": "r", "noise": n, "estimator": e, "status": "ok", "torque_error": v}
        for n, e, v in [("x", "a", 0.02), ("x", "b", 2e-5), ("y", "a", 0.02), ("y", "b", 0.03)]
    ]
    table = table_of(pd.DataFrame(rows), ["robot"], ["noise", "estimator"])
    reported = [table.column_notation[column].scientific for column in table.columns]
    assert reported == [True, True, False, False]


def test_rows_and_columns_stand_in_the_order_of_the_cells(cells: pd.DataFrame) -> None:
    table = table_of(cells.iloc[::-1], ["robot", "payload"], ["noise", "estimator"])
    assert [row[0] for row in table.rows[::3]] == ["anymal_c", "panda", "ur5"]
    assert table.columns == (
        ("q 1e-4 rad, tau 0.5 %", "wls"),
        ("q 1e-4 rad, tau 0.5 %", "ols"),
        ("exact", "wls"),
        ("exact", "ols"),
    )


def test_a_table_says_over_what_it_pools(cells: pd.DataFrame) -> None:
    pooled = table_of(cells, ["robot"], ["estimator"])
    assert "noise (2)" in pooled.notes[0]
    assert "payload (3)" in pooled.notes[0]
    assert table_of(cells, ["robot", "payload"], ["noise", "estimator"]).notes == ()


def test_what_plants_bring_along_is_not_pooled_beside_them(cells: pd.DataFrame) -> None:
    level = {"ols": "L0", "wls": "L1"}
    levels = cells.assign(plant=cells["estimator"].map(level))
    levels["simulation"] = levels["plant"].map({"L0": "inverse", "L1": "closed-loop"})
    (by_level,) = table_of(levels, ["robot", "payload"], ["plant", "noise"]).notes or ("",)
    assert "simulation" not in by_level
    (over_levels,) = table_of(levels, ["robot", "payload"], ["noise"]).notes
    assert "plant (2)" in over_levels
    assert "simulation" not in over_levels
    crossed = pd.concat([levels, levels.assign(simulation="other")])
    (note,) = table_of(crossed, ["robot", "payload"], ["plant", "noise"]).notes
    assert "simulation (2)" in note


def test_a_selection_is_a_table_of_the_chosen_cells(
    cells: pd.DataFrame, spec: Mapping[str, Any]
) -> None:
    def choose(expression: str, cell: Mapping[str, Any]) -> bool:
        return bool(cell["noise"] == expression)

    chosen = build_table(cells[cells["noise"] == "exact"], spec).entries
    assert build_table(cells, {**spec, "select": {"noise": "exact"}}).entries == chosen
    assert build_table(cells, {**spec, "select": "exact"}, choose).entries == chosen
    with pytest.raises(UsageError, match="no cell"):
        build_table(cells, {**spec, "select": {"noise": ["loud"]}})
    with pytest.raises(UsageError, match="choose"):
        build_table(cells, {**spec, "select": "exact"})


@pytest.mark.parametrize(
    ("change", "near"),
    [
        ({"row": ["robot"]}, "rows"),
        ({"rows": ["robt"]}, "robot"),
        ({"columns": ["estimater"]}, "estimator"),
        ({"best": "min-bolt"}, "min-bold"),
        ({"select": {"nois": "exact"}}, "noise"),
        ({"cells": {"metric": "torque_eror"}}, "torque_error"),
        ({"cells": {"metric": "torque_error", "stat": "mediam"}}, "median"),
        ({"cells": {"metric": "torque_error", "interval": "ci90"}}, "ci95"),
        ({"cells": {"metric": "torque_error", "statt": "mean"}}, "stat"),
    ],
)
def test_a_wrong_word_is_refused_with_the_nearest(
    cells: pd.DataFrame, spec: Mapping[str, Any], change: dict[str, Any], near: str
) -> None:
    with pytest.raises(UsageError, match=f"Did you mean '{near}'"):
        build_table(cells, {**spec, **change})


SETTINGS = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text()),
    lambda inner: st.one_of(st.lists(inner), st.dictionaries(st.text(), inner)),
    max_leaves=6,
)


@given(st.lists(SETTINGS, min_size=1, max_size=5))
def test_any_setting_can_be_a_label(settings: list[Any]) -> None:
    frame = pd.DataFrame({"payload": pd.Series(settings, dtype=object), "status": "ok"})
    assert list(with_labels(frame)["payload"]) == [label(value) for value in settings]


def numbers(entry: Any) -> list[float]:
    return [np.inf if v is None else v for v in (entry.value, entry.low, entry.high, entry.n)]


def test_words_stand_as_they_are_and_what_differs_is_counted(cells: pd.DataFrame) -> None:
    reported = cells.assign(
        verdict=["none" if n % 2 else "identifiable" for n in range(len(cells))]
    )
    reported.loc[reported["robot"] == "ur5", "verdict"] = "combination"
    wanted = {"metric": "verdict"}
    table = build_table(reported, {"rows": ["robot"], "columns": ["payload"], "cells": wanted})
    for (row, _), entry in table.entries.items():
        assert entry.value is None
        assert entry.n + entry.n_failed + entry.missing == 12
        if row == ("ur5",):
            assert entry.label == "combination"
        elif entry.n:
            own = reported[(reported["robot"] == row[0]) & (reported["status"] == "ok")]
            assert set(own["verdict"]) == {word.split()[0] for word in entry.label.split(", ")}
    lost = table.entry(("anymal_c",), ("box-2kg",))
    assert lost is not None
    assert lost.label in ("unsupported", "failed")
    for text in (to_markdown(table), to_csv(table)):
        assert "combination" in text
        assert "median" not in text.partition("\n")[0]


def repeated(
    repeats: int, failed: int = 0, scale: float = 1.0
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Cells of two methods and their parameters: "fair" scatters as the bound, "off" is two
    deviations off as well; the first `failed` repeats of "fair" are lost."""
    rng = np.random.default_rng(1)
    cells, parameters = [], []
    for estimator, offset in (("fair", 0.0), ("off", 2.0)):
        for repeat in range(repeats):
            lost = estimator == "fair" and repeat < failed
            cell = {"id": f"{estimator}{repeat}", "robot": "arm", "estimator": estimator}
            cells.append({**cell, "repeat": repeat, "status": "failed" if lost else "ok"})
            for place, bound in enumerate((1e-3, 5.0, 100.0)):
                error = scale * bound * (offset + rng.normal())
                reported = {
                    "body": "link",
                    "name": f"p{place}",
                    "base_error": error,
                    "bound": bound,
                }
                parameters += [] if lost else [{"id": cell["id"], **reported}]
    return pd.DataFrame(cells), pd.DataFrame(parameters)


def figures(metric: str, frames: tuple[pd.DataFrame, pd.DataFrame]) -> dict[str, Any]:
    wanted = {"metric": metric, "interval": "ci95"}
    spec = {"rows": ["robot"], "columns": ["estimator"], "cells": wanted}
    table = build_table(frames[0], spec, parameters=frames[1])
    return {column[0]: entry for (_, column), entry in table.entries.items()}


@pytest.mark.parametrize(
    ("metric", "fair", "off"),
    [
        ("bias", 0.0, 2.0),
        ("spread", 1.0, 1.0),
        ("efficiency", 1.0, 1.0),
        ("bound_ratio", 1.0, np.sqrt(5)),
    ],
)
def test_repeats_separate_bias_from_scatter(metric: str, fair: float, off: float) -> None:
    found = figures(metric, repeated(300))
    for estimator, true in (("fair", fair), ("off", off)):
        entry = found[estimator]
        assert entry.n == 300
        assert entry.value == pytest.approx(true, abs=0.15)
        assert entry.low - 0.05 <= true <= entry.high + 0.05
        assert entry.low <= entry.value <= entry.high


def test_lost_repeats_are_counted_and_the_rest_is_reported() -> None:
    found = figures("spread", repeated(60, failed=25))
    assert found["fair"].n == 35
    assert found["fair"].failures == {"failed": 25}
    assert "25 failed" in found["fair"].note


@pytest.mark.parametrize("metric", ["bias", "spread", "efficiency", "bound_ratio"])
def test_figures_of_repeats_need_repeats_a_bound_and_noise(metric: str) -> None:
    cells, parameters = repeated(30)
    few = cells["repeat"] < 19
    for frames in (
        (cells[few], parameters),
        (cells, parameters.iloc[:0]),
        repeated(30, scale=0.0),
        (cells[:0].reindex(range(30)).assign(status="failed", robot="arm"), parameters),
    ):
        for entry in figures(metric, frames).values():
            assert entry.value is entry.low is entry.high is None
            assert entry.n == 0
    without = figures(metric, (cells, parameters.assign(bound=np.nan)))
    assert all((entry.value is None) == (metric != "bias") for entry in without.values())


def test_verdicts_with_gaps_are_numbers(cells: pd.DataFrame) -> None:
    """Some methods estimate no whole bodies: the column of the others is true, false or nothing."""
    verdicts = [True, False, None] * len(cells)
    reported = cells.assign(feasible=pd.Series(verdicts[: len(cells)], dtype=object).to_numpy())
    spec = {"name": "f", "rows": ["status"], "cells": {"metric": "feasible", "stat": "mean"}}
    table = build_table(reported, spec)
    values = [entry.value for entry in table.entries.values() if entry.value is not None]
    assert values
    assert all(0 <= value <= 1 for value in values)


@pytest.mark.parametrize("name", ["=1+1", "+cmd", "-x.m + y.m", "@sum(a)", "\t=1", "\uff1d1"])
def test_no_text_of_a_csv_is_a_formula(cells: pd.DataFrame, name: str) -> None:
    text = to_csv(table_of(cells.assign(estimator=name), ["robot"], ["estimator"]))
    lines = list(csv.DictReader(io.StringIO(text, newline="")))
    assert {line["estimator"] for line in lines} == {f"'{name}"}


def test_numbers_of_a_csv_stay_numbers() -> None:
    assert csv_text([[-0.5, "-0.5", "+1e-3", -1, "a-b", ""]]) == "-0.5,-0.5,+1e-3,-1,a-b,\n"
