"""Laws of the ratios between two runs."""

from dataclasses import replace

import numpy as np
import pytest
import scipy

from sysid_bench.harness.comparison import run_difference
from sysid_bench.harness.comparison.run_difference import MetricRatio, metric_ratio
from sysid_bench.harness.comparison.run_values import ROUNDING, CellValues, RunValues
from sysid_bench.metrics import METRICS

NAMES = ("torque_error", "seconds")


def run_of(robots: int, seed: int, factor: float = 1.0, scatter: float = 0.3) -> RunValues:
    """Three cells for each robot, errors of log-normal size times `factor`."""
    rng = np.random.default_rng(seed)
    size = np.exp(rng.normal(size=robots))
    draws = np.exp(scatter * rng.normal(size=(robots, 3)))
    cells = {
        f"{robot}-{i}": CellValues(
            f"robot{robot}", (str(i),), "ok", (factor * size[robot] * draws[robot, i], 1.0)
        )
        for robot in range(robots)
        for i in range(3)
    }
    return RunValues("s", ("repeat",), {name: METRICS[name] for name in NAMES}, cells, {}, {})


def error_ratio(before: RunValues, after: RunValues) -> MetricRatio:
    return next(r for r in metric_ratio(before, after) if r.metric == "torque_error")


@pytest.mark.parametrize("seed", range(5))
def test_p_is_that_of_scipy(seed: int) -> None:
    before, after = run_of(11, seed), run_of(11, seed + 100)
    found = error_ratio(before, after)
    logs = []
    for robot in range(11):
        pairs = [(before.cells[f"{robot}-{i}"], after.cells[f"{robot}-{i}"]) for i in range(3)]
        logs.append(np.mean([np.log(b.values[0] / a.values[0]) for a, b in pairs]))  # type: ignore[operator]
    test = scipy.stats.wilcoxon(logs, method="exact")
    assert found.p == pytest.approx(test.pvalue, rel=1e-12)
    assert found.ratio == pytest.approx(np.exp(np.median(logs)))
    assert found.lower + found.higher == found.robots == 11
    assert found.smallest_p == 2 / 2**11


@pytest.mark.parametrize(
    ("factor", "verdict"), [(0.5, "better"), (2.0, "worse"), (1.0, "equivalent")]
)
def test_a_common_factor_is_found(factor: float, verdict: str) -> None:
    before, after = run_of(9, 3), run_of(9, 3, factor)
    found = error_ratio(before, after)
    assert found.ratio == pytest.approx(factor)
    assert found.verdict == verdict
    assert found.p == (1.0 if factor == 1.0 else found.smallest_p)


def test_few_robots_have_no_interval() -> None:
    found = error_ratio(run_of(5, 1), run_of(5, 1, 3.0))
    assert (found.low, found.high, found.verdict) == (None, None, "")
    assert found.ratio == pytest.approx(3.0)


def test_zeros_rounding_and_failures_are_left_out_and_counted() -> None:
    before = run_of(7, 2)
    cells = dict(before.cells)
    cells["0-0"] = replace(cells["0-0"], values=(0.0, 1.0))
    cells["1-0"] = replace(cells["1-0"], values=(1e-15, 1.0))
    cells["2-0"] = replace(cells["2-0"], values=(None, 1.0))
    cells["3-0"] = replace(cells["3-0"], status="failed", values=(None, None))
    found = error_ratio(before, replace(before, cells=cells))
    assert found.zeros == 3
    assert found.cells == 21 - 4
    assert found.robots == 7


@pytest.mark.parametrize("share", [1e-3, 1e-4, 3e-6])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_small_common_factor_is_found_to_its_digits(share: float, sign: float) -> None:
    found = error_ratio(run_of(9, 4), run_of(9, 4, float(np.exp(sign * share))))
    assert found.ratio is not None
    assert np.log(found.ratio) == pytest.approx(sign * share, rel=1e-6)
    assert (found.lower, found.higher) == ((0, 9) if sign > 0 else (9, 0))
    assert found.p == found.smallest_p == 2 / 2**9


@pytest.mark.parametrize("share", [3e-7, 1e-9, 1e-15])
def test_a_factor_within_the_digits_of_a_baseline_is_one(share: float) -> None:
    for sign in (1.0, -1.0):
        found = error_ratio(run_of(9, 4), run_of(9, 4, float(np.exp(sign * share))))
        assert (found.ratio, found.lower, found.higher, found.p) == (1.0, 0, 0, 1.0)


@pytest.mark.parametrize("factor", [1.5, 100.0])
def test_errors_count_from_just_above_rounding_on(factor: float) -> None:
    """Both have to be above it: a ratio to rounding is one of rounding."""
    above, below = factor * ROUNDING, ROUNDING / factor
    for was, now, counted in (
        (above, 2 * above, 1), (2 * above, above, 1), (below, above, 0), (above, below, 0),
        (below, below, 0), (ROUNDING, above, 0), (above, ROUNDING, 0),
    ):  # fmt: skip
        found = error_ratio(one_cell(was), one_cell(now))
        assert (found.cells, found.zeros) == (counted, 1 - counted)
        if counted:
            assert found.ratio == pytest.approx(now / was)


def one_cell(error: float) -> RunValues:
    run = run_of(1, 0)
    return replace(run, cells={"0-0": replace(run.cells["0-0"], values=(error, 1.0))})


@pytest.mark.parametrize("seed", range(12))
def test_a_metric_that_should_be_large_is_judged_by_its_inverse(seed: int) -> None:
    """Of one that should be small: the same verdicts, and none without a direction."""
    rng = np.random.default_rng(seed)
    factor, scatter = float(np.exp(rng.normal(0, 0.2))), float(rng.choice([0.01, 0.1, 0.5]))
    before, cells = run_of(9, seed), {}
    for key, cell in before.cells.items():
        error = float((cell.values[0] or 0.0) * factor * np.exp(scatter * rng.normal()))
        cells[key] = replace(cell, values=(error, 1.0))
    after = replace(before, cells=cells)
    lower = error_ratio(before, after)
    large = {**before.metrics, "torque_error": replace(METRICS["torque_error"], better="higher")}
    higher = error_ratio(replace(after, metrics=large), replace(before, metrics=large))
    none = {**before.metrics, "torque_error": replace(METRICS["torque_error"], better=None)}
    plain = error_ratio(replace(before, metrics=none), replace(after, metrics=none))
    assert lower.verdict == higher.verdict != ""
    assert plain.verdict == ""
    assert plain.ratio == lower.ratio


def test_metrics_of_both_runs_that_are_compared_by_a_factor_have_a_ratio() -> None:
    names = ("torque_error", "gap", "rank", "condition")
    cells = {"c": CellValues("ur5", (), "ok", (0.5, 1e-16, 9.0, 30.0))}
    before = RunValues("s", (), {name: METRICS[name] for name in names}, cells, {}, {})
    fewer = {"c": CellValues("ur5", (), "ok", (0.5, 1e-16, 9.0))}
    after = replace(before, metrics={n: METRICS[n] for n in names[:3]}, cells=fewer)
    for pair in ((before, after), (after, before), (after, after)):
        assert [one.metric for one in metric_ratio(*pair)] == ["torque_error"]


def test_a_factor_at_the_digits_of_a_baseline_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_difference, "_DIGITS", float(np.log(1.25)))
    assert error_ratio(one_cell(1.0), one_cell(1.25)).higher == 1
    assert error_ratio(one_cell(1.0), one_cell(1.2)).higher == 0
