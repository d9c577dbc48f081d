"""Laws of common drift: cells within their tolerance that move together are found, scatter not."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy

from sysid_bench.harness.comparison import drift
from sysid_bench.harness.comparison.baseline import baseline_of, from_text, to_text, update_of
from sysid_bench.harness.comparison.drift import find_drift
from sysid_bench.harness.comparison.run_difference import (
    RunDifference,
    find_difference,
    moved_values,
)
from sysid_bench.harness.comparison.run_values import CellValues, RunValues, Tolerance
from sysid_bench.metrics import METRICS

NAMES = ("torque_error", "rank", "gap")


def run_of(factors: np.ndarray, methods: int = 3) -> RunValues:
    """A cell for each factor, `methods` of each experiment: errors of all sizes times it."""
    rng = np.random.default_rng(1)
    cells = {
        f"c{i:03}": CellValues(
            f"robot{i // methods % 4}",
            (f"method{i % methods}", str(i // methods)),
            "ok",
            (float(np.exp(rng.normal(-3, 2)) * factor), 36.0, 1e-15),
        )
        for i, factor in enumerate(factors)
    }
    metrics = {name: METRICS[name] for name in NAMES}
    return RunValues("s", ("estimator", "repeat"), metrics, cells, {}, {})


def compared(before: RunValues, after: RunValues) -> RunDifference:
    known = from_text(to_text(baseline_of(before)), "b.json")
    return find_difference(known.run, after, known.tolerances)


ONES = np.ones(30)


@pytest.mark.parametrize("count", [2, 3, 4, 30])
@pytest.mark.parametrize("share", [0.0099, 0.005, 0.001])
def test_cells_that_all_get_worse_within_their_tolerance_fail(share: float, count: int) -> None:
    found = compared(run_of(ONES[:count]), run_of(ONES[:count] * (1 + share)))
    assert not found.cells
    assert found.is_failed
    (drift,) = found.failed_drifts
    assert (drift.metric, drift.verdict, len(drift.cells)) == ("torque_error", "worse", count)
    assert drift.factor == pytest.approx(1 + share, rel=1e-6)
    assert drift.p <= 1e-3
    back = compared(run_of(ONES[:count] * (1 + share)), run_of(ONES[:count]))
    assert not back.is_failed
    assert [one.verdict for one in back.drifts] == ["better"]


def test_one_cell_and_the_digits_of_a_baseline_are_no_drift() -> None:
    assert not compared(run_of(ONES[:1]), run_of(ONES[:1] * 1.0099)).drifts
    assert not compared(run_of(ONES), run_of(ONES * (1 + 5e-5))).drifts


@pytest.mark.parametrize("seed", range(20))
def test_scatter_within_the_tolerance_is_no_drift(seed: int) -> None:
    scatter = np.random.default_rng(seed).uniform(-0.009, 0.009, 30)
    assert not compared(run_of(ONES), run_of(ONES * np.exp(scatter))).is_failed


def test_methods_of_one_experiment_count_once() -> None:
    """They share their data: ten of one experiment that move by chance are one chance."""
    logs = np.array([0.006, 0.005, 0.004, -0.002, 0.003, 0.001])
    assert scipy.stats.ttest_1samp(np.repeat(logs, 10), 0.0).pvalue < 1e-6
    assert not compared(run_of(np.ones(60), 10), run_of(np.exp(np.repeat(logs, 10)), 10)).drifts


@pytest.mark.parametrize("count", [3, 4])
def test_few_experiments_of_many_methods_are_few(count: int) -> None:
    logs = np.array([0.006, 0.005, 0.004, 0.001])[:count]
    factors = np.exp(np.repeat(logs, 10))
    assert scipy.stats.ttest_1samp(np.log(factors), 0.0).pvalue < 1e-6
    assert not compared(run_of(np.ones(10 * count), 10), run_of(factors, 10)).drifts
    # Of two a mean says nothing: there each cell counts.
    pair = compared(run_of(np.ones(20), 10), run_of(factors[:20], 10)).drifts
    assert [one.groups for one in pair] == [20]


def test_p_is_that_of_students_test() -> None:
    factors = np.exp(0.005 + 0.002 * np.random.default_rng(0).normal(size=30))
    (drift,) = compared(run_of(ONES, 1), run_of(factors, 1)).drifts
    wanted = scipy.stats.ttest_1samp(np.log(factors), 0.0)
    assert drift.p == pytest.approx(float(wanted.pvalue), rel=1e-3)
    assert drift.groups == 30


@pytest.mark.parametrize("factor", [0.01, 100.0])
def test_a_cell_beyond_its_tolerance_does_not_hide_what_the_others_do(factor: float) -> None:
    factors = ONES * 1.009
    factors[7] = factor
    found = compared(run_of(ONES), run_of(factors))
    assert [change.cell for change in found.cells] == ["c007"]
    (drift,) = found.failed_drifts
    assert len(drift.cells) == 29
    assert drift.factor == pytest.approx(1.009, rel=1e-5)


def test_errors_of_rounding_do_not_drift() -> None:
    small = {
        key: replace(cell, values=(5e-12, 36.0, 1e-15)) for key, cell in run_of(ONES).cells.items()
    }
    before = replace(run_of(ONES), cells=small)
    larger = {key: replace(c, values=(6e-12, 36.0, 1e-15)) for key, c in small.items()}
    assert not compared(before, replace(before, cells=larger)).is_failed


@pytest.mark.parametrize("better", [True, False])
def test_limits_of_size_and_of_chance_belong_to_a_drift(
    better: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exactly at both a drift counts, and not behind."""
    small, large = (
        replace(run_of(ONES[:2]), cells={
            key: replace(cell, values=(error, 36.0, 1e-15))
            for key, cell in run_of(ONES[:2]).cells.items()
        })
        for error in (1.0, 1.25)
    )  # fmt: skip
    before, after = (large, small) if better else (small, large)
    allowed = {"torque_error": Tolerance("ratio", math.e)}  # of logarithm one
    found = find_drift(before, after, [*small.cells], allowed)
    assert [one.verdict for one in found] == ["better" if better else "worse"]
    assert found[0].cells == tuple(small.cells)
    size = abs(math.log(1 / 1.25 if better else 1.25))
    for name, limit, behind in (
        ("SMALLEST", size, np.nextafter(size, 1.0)),
        ("LEVEL", found[0].p, np.nextafter(found[0].p, 0.0)),
    ):
        with monkeypatch.context() as context:
            context.setattr(drift, name, limit)
            assert find_drift(before, after, [*small.cells], allowed) == found
            context.setattr(drift, name, behind)
            assert not find_drift(before, after, [*small.cells], allowed)


def test_a_metric_without_a_direction_or_a_factor_does_not_drift() -> None:
    before, after = run_of(ONES), run_of(ONES * 1.005)
    for tolerance in (Tolerance("exact"), Tolerance("absolute", 1.0), Tolerance("ratio", 1.0)):
        assert not find_drift(before, after, [*before.cells], {"torque_error": tolerance})
    plain = replace(METRICS["torque_error"], better=None)
    before = replace(before, metrics={**before.metrics, "torque_error": plain})
    allowed = {"torque_error": Tolerance("ratio", 1.01)}
    assert not find_drift(before, after, [*before.cells], allowed)


@pytest.mark.parametrize("floor", [1e-11, 1e-3])
def test_a_value_at_the_floor_is_rounding_and_one_above_is_not(floor: float) -> None:
    def run_at(error: float) -> RunValues:
        cells = {k: replace(c, values=(error, 36.0, 1e-15)) for k, c in run_of(ONES).cells.items()}
        return replace(run_of(ONES), cells=cells)

    allowed = {"torque_error": Tolerance("ratio", 1.01, floor)}
    for low, count in ((floor, 0), (float(np.nextafter(floor, 1.0)), 1)):
        for pair in ((low, 1.009 * low), (1.009 * low, low)):
            before, after = map(run_at, pair)
            assert len(find_drift(before, after, [*before.cells], allowed)) == count


def test_an_update_takes_a_drift_over_and_counts_it() -> None:
    before, after = run_of(ONES), run_of(ONES * 1.009)
    update = update_of(compared(before, after))
    assert update.counts == {"values of drifting metrics": 30}
    assert not compared(update.run, after).drifts
    assert compared(update.run, before).drifts[0].verdict == "better"
    # What is not reported stays: the next drift of half the size is against the same values.
    scattered = run_of(ONES * np.exp(np.random.default_rng(0).uniform(-0.009, 0.009, 30)))
    kept = update_of(compared(before, scattered))
    assert kept.taken == 0
    assert [c.values[0] for c in kept.run.cells.values()] == pytest.approx(
        [c.values[0] for c in before.cells.values()], rel=1e-12
    )


@pytest.mark.parametrize("share", [3e-12, 1e-9, 5e-3, -3e-12])
def test_exact_lists_what_is_another_number(share: float) -> None:
    before, factors = run_of(ONES), ONES.copy()
    factors[4] += share
    known = from_text(to_text(baseline_of(before)), "b.json")
    (moved,) = moved_values(known.run, run_of(factors), known.tolerances)
    assert (moved.cell, moved.metric, moved.verdict) == ("c004", "torque_error", "changed")
    assert not moved.is_failed
    assert not moved_values(known.run, run_of(ONES * (1 + 2e-13)), known.tolerances)


def test_rounding_below_the_floor_has_not_moved() -> None:
    before = run_of(ONES)
    cells = {key: replace(c, values=(*c.values[:2], 3e-15)) for key, c in before.cells.items()}
    known = from_text(to_text(baseline_of(before)), "b.json")
    assert not moved_values(known.run, replace(before, cells=cells), known.tolerances)
