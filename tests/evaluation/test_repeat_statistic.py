"""Laws of the statistics over repeats: their definitions, taken one repeat at a time."""

from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest

from sysid_bench.evaluation.intervals import REPEATS
from sysid_bench.evaluation.repeat_statistic import (
    ENCODER_BOUND,
    WITH_BOUND,
    WORST,
    mean_error,
    repeat_errors,
    repeat_statistic,
)
from sysid_bench.types import Array

Statistic = Callable[[Array, Array, float, Array], float]
"""Of the mean and variance (r,), the expected squared mean in variances, and the bound (r,)."""

BY_DEFINITION: dict[str, Statistic] = {
    "bias": lambda m, v, c, b: max(float(np.mean(m**2 / v)) - c, 0.0) ** 0.5,
    "spread": lambda m, v, c, b: float(np.sqrt(np.mean(v / b**2))),
    "efficiency": lambda m, v, c, b: float(np.mean(b**2 / v) * (1 - 2 * c)),
    "bound_ratio": lambda m, v, c, b: float(np.sqrt(np.mean((m**2 + v * (1 - c)) / b**2))),
}


@pytest.mark.parametrize("name", BY_DEFINITION)
@pytest.mark.parametrize("seed", range(3))
def test_a_figure_and_its_interval_are_those_of_the_definition(name: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, r = int(rng.integers(20, 40)), int(rng.integers(1, 6))
    errors, bound = rng.normal(0.7, rng.uniform(0.5, 3.0, r), (n, r)), rng.uniform(0.5, 3.0, r)
    figure = mean_error(errors) if name == "bias" else WITH_BOUND[name](errors, bound)
    statistic = BY_DEFINITION[name]
    mean, variance = errors.mean(axis=0), errors.var(axis=0, ddof=1)
    assert figure[0] == pytest.approx(statistic(mean, variance, 1 / n, bound))
    drawn = []
    for counts in REPEATS.counts(n):
        again = np.repeat(errors, counts, axis=0)
        scaled = again.var(axis=0, ddof=0) * (n / (n - 1)) ** 2
        drawn.append(statistic(again.mean(axis=0), scaled, 2 / n, bound))
    assert figure[1:] == pytest.approx(tuple(np.quantile(drawn, (0.025, 0.975))), rel=1e-9)


def frames(
    rng: np.random.Generator, repeats: int = REPEATS.fewest, robots: tuple[str, ...] = ("a", "b")
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Cells of some robots and repeats, and the parameters of each: two in the base, one not."""
    cells, lines = [], []
    for robot in robots:
        for repeat in range(repeats):
            name = f"{robot}{repeat}"
            cells.append({"id": name, "robot": robot, "repeat": repeat, "std_from": "textbook"})
            for body, kind in (("l1", "inertial"), ("l2", "friction"), ("l3", "inertial")):
                lines.append(
                    {"id": name, "body": body, "name": "m", "class": kind,
                     "base_error": None if body == "l3" else rng.normal(),
                     "bound": rng.uniform(0.5, 2.0),
                     ENCODER_BOUND: rng.uniform(2.0, 3.0) if repeat == 0 else None,
                     "held_textbook": bool(rng.random() < 0.8)}
                )  # fmt: skip
    return pd.DataFrame(cells), pd.DataFrame(lines)


def numbers(lines: pd.DataFrame, robot: str, body: str, column: str, repeats: list[int]) -> Array:
    ids = [f"{robot}{repeat}" for repeat in repeats]
    chosen = lines[(lines["body"] == body)].set_index("id").loc[ids, column]
    return chosen.to_numpy(dtype=float)


@pytest.mark.parametrize("lost", [[], [3], [0, 5]])
@pytest.mark.parametrize("which", ["bound", ENCODER_BOUND, "absent"])
def test_errors_are_of_the_repeats_that_all_settings_have(lost: list[int], which: str) -> None:
    cells, lines = frames(np.random.default_rng(len(lost)))
    lines.loc[lines["id"].isin([f"a{repeat}" for repeat in lost]), "base_error"] = None
    errors, bound = repeat_errors(cells.sample(frac=1, random_state=1), lines, which)
    kept = [repeat for repeat in range(REPEATS.fewest) if repeat not in lost]
    wanted = [(robot, body) for robot in "ab" for body in ("l1", "l2")]
    columns = [numbers(lines, *one, "base_error", kept) for one in wanted]
    np.testing.assert_array_equal(errors, np.column_stack(columns))
    if which == "absent":
        assert np.isnan(bound).all()
    elif which == "bound":  # root mean square of those of the repeats that count
        squares = [np.mean(numbers(lines, *one, which, kept) ** 2) for one in wanted]
        assert bound == pytest.approx(np.sqrt(squares))
    elif 0 not in lost:
        assert bound == pytest.approx([numbers(lines, *one, which, [0])[0] for one in wanted])
    none = repeat_errors(cells, lines.assign(base_error=np.nan))
    assert (none[0].shape, none[1].shape) == ((0, 0), (0,))


@pytest.mark.parametrize("metric", ["bias", *WITH_BOUND])
def test_a_figure_needs_twenty_repeats_scatter_and_a_bound(metric: str) -> None:
    cells, lines = frames(np.random.default_rng(2))
    of_encoders = metric == "bound_ratio_encoders"
    errors, bound = repeat_errors(cells, lines, ENCODER_BOUND if of_encoders else "bound")
    expected = mean_error(errors) if metric == "bias" else WITH_BOUND[metric](errors, bound)
    assert repeat_statistic(metric, cells, lines) == pytest.approx(expected)
    fewer = cells[cells["repeat"] < REPEATS.fewest - 1]
    assert repeat_statistic(metric, fewer, lines) is None
    equal = lines.assign(base_error=lines["base_error"].where(lines["body"] != "l1", 0.3))
    assert repeat_statistic(metric, cells, equal) is None
    one = lines.assign(
        **{c: lines[c].where(lines["body"] != "l1") for c in ("bound", ENCODER_BOUND)}
    )
    assert (repeat_statistic(metric, cells, one) is None) == (metric != "bias")
    assert repeat_statistic(metric, cells, lines.iloc[:0]) is None
    assert [one.shape for one in repeat_errors(cells, lines.iloc[:0])] == [(0, 0), (0,)]


@pytest.mark.parametrize("metric", WORST)
@pytest.mark.parametrize("seed", range(4))
def test_the_worst_coverage_is_the_least_share_of_a_parameter(metric: str, seed: int) -> None:
    cells, lines = frames(np.random.default_rng(seed))
    bodies = ("l1", "l3") if WORST[metric] == "inertial" else ("l2",)
    every = range(REPEATS.fewest)
    shares = {
        (robot, body): numbers(lines, robot, body, "held_textbook", [*every]).mean()
        for robot in "ab" for body in bodies
    }  # fmt: skip
    found = repeat_statistic(metric, cells, lines)
    assert found is not None
    least = min(shares.values())
    exact = binomtest(round(least * len(every)), len(every)).proportion_ci(0.95, method="exact")
    assert found == pytest.approx((least, exact.low, exact.high), abs=1e-9)
    # Too few repeats of one parameter, several kinds of intervals, and kinds without a column.
    assert repeat_statistic(metric, cells[cells["repeat"] > 0], lines) is None
    unknown = lines["held_textbook"].where(lines["id"] != "a0")
    assert repeat_statistic(metric, cells, lines.assign(held_textbook=unknown)) is None
    mixed = cells.assign(std_from=np.where(cells["robot"] == "a", "periods", "textbook"))
    assert repeat_statistic(metric, mixed, lines) is None
    assert repeat_statistic(metric, cells.assign(std_from="periods"), lines) is None
    assert repeat_statistic(metric, cells.drop(columns="std_from"), lines) is None
    assert repeat_statistic(metric, cells, lines.assign(**{"class": "other"})) is None
