"""Laws of tuned weights: the rule by a plain loop, phases held out, one budget, wrong weights."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import EstimationError, UsageError
from sysid_bench.experiments.processed_rows import pooled
from sysid_bench.identification.estimators.bayesian import APriori, Ridge
from sysid_bench.identification.estimators.feasible import (
    Entropic,
    LMIEuclidean,
    LMIPullback,
    LogCholesky,
)
from sysid_bench.identification.identify import identify
from sysid_bench.identification.linear.cross_validation import (
    CROSS_VALIDATED,
    FOLDS,
    WEIGHTS,
    block_labels,
    held_out_errors,
    time_blocks,
    with_weight,
)
from sysid_bench.identification.linear.least_squares import row_noise
from sysid_bench.qr_factor import qr_factor
from sysid_bench.types import Array, Estimate, Prior, Problem
from tests.experiments.experiment_world import executed, ready, spec

PENDULUM = "example-robot-data:double_pendulum_description/urdf/double_pendulum_continuous.urdf"
METHODS: tuple[Callable[..., Any], ...] = (
    Ridge, APriori, Entropic, LMIEuclidean, LMIPullback, LogCholesky,
)  # fmt: skip


@cache
def problem(robot: str = PENDULUM, cycles: int = 1, noise: float = 0.05) -> Problem:
    excitation = {"use": "fourier", "period": "2 s", "cycles": cycles}
    return ready(robot=robot, excitation=excitation, noise={"tau_relative": noise}).problem


def plain_errors(at: Problem, weights: tuple[float, ...]) -> list[float]:
    """Held-out errors of Bayesian least squares, sample by sample, with normal equations."""
    assert at.prior is not None
    rows = len(at.rows)
    W, b = at.W.reshape(-1, rows, at.base.rank), at.b.reshape(-1, rows)
    period = at.period or at.samples
    held = [[(i % period) * FOLDS // period == k for i in range(at.samples)] for k in range(FOLDS)]
    sigma, found = row_noise(at), []
    for weight in weights:
        total = 0.0
        for fold in map(np.array, held):
            own = row_noise(time_blocks(at, FOLDS).without(held.index(fold.tolist())))
            A = (W[~fold] / own[:, None]).reshape(-1, at.base.rank) @ at.base.K
            y = (b[~fold] / own).ravel()
            P = np.diag(weight / at.prior.std**2)
            theta = np.linalg.solve(A.T @ A + P, A.T @ y + P @ at.prior.theta)
            errors = b[fold] - W[fold] @ (at.base.K @ theta)
            total += float(((errors / sigma) ** 2).sum())
        found.append(total / sum(factor.samples for factor in at.factors))
    return found


@pytest.mark.parametrize("cycles", [1, 3])
@pytest.mark.parametrize("robot", [PENDULUM, pytest.param("scara", marks=pytest.mark.long)])
def test_errors_are_those_of_a_plain_loop(robot: str, cycles: int) -> None:
    at = problem(robot, cycles)
    expected = plain_errors(at, WEIGHTS)
    method = APriori(CROSS_VALIDATED)
    np.testing.assert_allclose(held_out_errors(method._fit, at, WEIGHTS), expected, rtol=1e-5)
    estimate = method.solve(at)
    assert estimate.stats["weight"] == WEIGHTS[int(np.argmin(expected))]
    same = APriori(estimate.stats["weight"]).solve(at)
    np.testing.assert_array_equal(estimate.theta, same.theta)


@pytest.mark.parametrize("cycles", [1, 2, 5])
@pytest.mark.parametrize("robot", [PENDULUM, "scara"])
def test_the_same_phase_is_held_out_in_all_periods(robot: str, cycles: int) -> None:
    at = problem(robot, cycles)
    assert at.period * cycles == at.samples
    blocks = time_blocks(at, FOLDS)
    phase = np.arange(at.samples) % at.period
    whole = sum(factor.R.T @ factor.R for factor in at.factors[:1])
    for label in range(FOLDS):
        train, test = (
            np.concatenate([b.any(axis=1) for _, b in part.blocks()])
            for part in (blocks.without(label), blocks.part(label))
        )
        assert test.any()
        assert not set(phase[train]) & set(phase[test])
        parts = (blocks.without(label), blocks.part(label))
        joined = sum(part.factors[0].R.T @ part.factors[0].R for part in parts)
        np.testing.assert_allclose(joined, whole, rtol=1e-9, atol=1e-9 * np.abs(whole).max())
        assert sum(part.factors[0].samples for part in parts) == at.factors[0].samples


def test_the_same_phase_is_held_out_in_several_motions() -> None:
    one, three = problem(), problem(cycles=3)
    labels = block_labels(pooled([one, three]), FOLDS)
    np.testing.assert_array_equal(labels, [*block_labels(one, FOLDS), *block_labels(three, FOLDS)])
    aperiodic = replace(three, period=0)
    assert (np.diff(block_labels(aperiodic, FOLDS)) >= 0).all()
    assert set(block_labels(aperiodic, FOLDS)) == set(range(FOLDS))


def test_all_methods_have_one_budget_and_show_it() -> None:
    at, count = problem(), FOLDS * len(WEIGHTS) + 1
    for method in METHODS:
        estimate = identify(method(weight=CROSS_VALIDATED), at)
        assert estimate.status == "ok", estimate.reason
        assert estimate.stats["fits"] == count
        low, high = estimate.stats["least_weight"], estimate.stats["most_weight"]
        assert np.log10(high / low) == pytest.approx(np.log10(WEIGHTS[-1] / WEIGHTS[0]))
        assert low <= estimate.stats["weight"] <= high
        untuned = identify(method(weight=estimate.stats["weight"]), at)
        np.testing.assert_array_equal(estimate.beta, untuned.beta)
        assert "fits" not in untuned.stats
        assert untuned.stats["weight"] == estimate.stats["weight"]


def test_a_row_shows_the_weight_and_its_grid() -> None:
    tuned = {"use": "a-priori", "weight": CROSS_VALIDATED}
    rows = executed(spec(robot=PENDULUM, noise={"tau_relative": 0.05}), tuned, "a-priori", "ridge")
    shown, untuned, other = (row["stats"] for row in rows)
    assert shown["weight"] in WEIGHTS
    assert (shown["least_weight"], shown["most_weight"]) == (WEIGHTS[0], WEIGHTS[-1])
    assert shown["fits"] == FOLDS * len(WEIGHTS) + 1
    assert untuned["weight"] == 1.0
    assert 0 < other["weight"] < 1


def chosen_weights(at: Problem, share: float, draws: int, method: Any) -> Array:
    """Decades of the weights for priors that err by `share` of the truth, all declared alike."""
    assert at.prior is not None
    exact, logs = at.prior.theta, []
    for seed in range(draws):
        drawn = np.random.default_rng(seed).normal(size=len(exact))
        std = np.maximum(np.abs(exact), 1e-3)
        drawn_prior = Prior(exact + share * std * drawn, 0.2 * std)
        logs.append(np.log10(method.solve(replace(at, prior=drawn_prior)).stats["weight"]))
    return np.array(logs)


@pytest.mark.parametrize(
    "robot", [PENDULUM, *(pytest.param(name, marks=pytest.mark.long) for name in ("scara", "ur5"))]
)
def test_the_weight_falls_with_the_error_of_the_prior_in_the_mean(robot: str) -> None:
    # The prior of the experiment takes the part of the truth: data are made from it.
    at = problem(robot)
    assert at.prior is not None
    rng = np.random.default_rng(1)
    exact = at.W @ (at.base.K @ at.prior.theta)
    b = exact + 0.05 * np.sqrt((exact**2).mean()) * rng.normal(size=len(exact))
    made = with_right_side(at, b)
    means = [chosen_weights(made, s, 8, APriori(CROSS_VALIDATED)).mean() for s in (0.02, 0.2, 1.0)]
    assert means == sorted(means, reverse=True)
    assert means[0] > means[-1] + 1


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "robot"),
    [(Entropic, PENDULUM), (Entropic, "ur5"), (LMIPullback, "scara")],
)
def test_geometric_weights_fall_with_the_error_of_the_prior(robot: str, method: Any) -> None:
    means = []
    for share in (0.05, 0.2, 0.5):
        prior = {"mass": share, "com": 0.075 * share, "inertia": 1.5 * share}
        logs = []
        for seed in range(6):
            at = ready(robot=robot, prior=prior, noise={"tau_relative": 0.05}, seed=seed).problem
            logs.append(np.log10(method(weight=CROSS_VALIDATED).solve(at).stats["weight"]))
        means.append(np.mean(logs))
    assert means == sorted(means, reverse=True)
    assert means[0] > means[-1]


def with_right_side(at: Problem, b: Array) -> Problem:
    """The problem with another b (M,)."""
    W, values = at.W.reshape(-1, len(at.rows), at.base.rank), b.reshape(-1, len(at.rows))
    factors = tuple(
        replace(
            factor,
            R=qr_factor([np.column_stack([W[:, i, factor.columns], values[:, i]])]),
        )
        for i, factor in enumerate(at.factors)
    )
    return replace(at, factors=factors, blocks=lambda: iter([(W, values)]))


def never(at: Problem, weight: float) -> Estimate:
    raise EstimationError(f"did not converge with {weight:g}")


def without_a_number(at: Problem, weight: float) -> Estimate:
    return Estimate(np.full(at.base.rank, np.nan))


@pytest.mark.parametrize("failing", [never, without_a_number])
def test_a_weight_without_a_fit_is_not_chosen(failing: Callable[..., Estimate]) -> None:
    at, best = problem(), APriori(CROSS_VALIDATED).solve(problem()).stats["weight"]

    def broken(at: Problem, weight: float) -> Estimate:
        return failing(at, weight) if weight == best else APriori(weight).solve(at)

    found = held_out_errors(broken, at, WEIGHTS)
    assert [error == np.inf for error in found] == [weight == best for weight in WEIGHTS]
    estimate = with_weight(broken, at, CROSS_VALIDATED)
    assert estimate.stats["weight"] == WEIGHTS[int(np.argmin(found))] != best
    assert estimate.theta is not None
    assert np.isfinite(estimate.theta).all()


def test_the_reason_of_a_tuned_fit_that_fails_is_that_of_its_fits() -> None:
    with pytest.raises(EstimationError, match=r"No weight from .* converge with 0.01"):
        with_weight(never, problem(), CROSS_VALIDATED)
    with pytest.raises(EstimationError, match="is nan"):
        with_weight(without_a_number, problem(), CROSS_VALIDATED)
    at = replace(problem(), prior=None)
    reasons = []
    for weight in (1.0, CROSS_VALIDATED):
        with pytest.raises(EstimationError) as raised:
            APriori(weight).solve(at)
        reasons.append(str(raised.value))
    assert reasons[0] == reasons[1]


@pytest.mark.parametrize("weight", ["tuned", 0, -1.0, True, float("nan"), float("inf"), "1"])
@pytest.mark.parametrize("method", METHODS)
def test_other_weights_are_refused(method: Callable[..., Any], weight: Any) -> None:
    with pytest.raises(UsageError, match="cross-validated"):
        method(weight=weight)
