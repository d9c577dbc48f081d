"""Statistics against simulation and against their definitions: does a 95 % interval hold 95 %?"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.evaluation.covariance import (
    ResidualScore,
    residual_score,
    standard_errors,
)
from sysid_bench.evaluation.cramer_rao import encoder_bound, torque_bound, white_bound
from sysid_bench.evaluation.intervals import StandardError
from sysid_bench.evaluation.repeat_statistic import WITH_BOUND, mean_error
from sysid_bench.identification.estimators.linear import OLS, WLS
from sysid_bench.identification.linear.least_squares import row_noise
from sysid_bench.types import Array, Estimate, Trajectory
from tests.closeness import assert_close
from tests.identification.test_least_squares import problem_of

TRUTH = np.array([1.0, -2.0, 0.5, 3.0])
PERIOD, PERIODS, REPEATS = 150, 10, 250


@cache
def regressor() -> Array:
    """Two rows of four parameters along a motion with ten periods."""
    t = 2 * np.pi * np.arange(PERIOD * PERIODS) / PERIOD
    base = np.stack([np.sin(t), np.cos(2 * t), np.sin(3 * t + 1), np.ones_like(t)], axis=-1)
    return np.stack([base, base[:, [1, 0, 3, 2]]], axis=1)


def noise(kind: str, rng: np.random.Generator) -> Array:
    from scipy.signal import lfilter

    white = rng.normal(size=(PERIOD * PERIODS + 500, 2)) * [0.3, 0.1]
    slow = {"white": 0.0, "slow": 0.95}[kind]
    return np.asarray(lfilter([1.0], [1.0, -slow], white, axis=0)[500:])


def coverage(low: Array, high: Array, truth: Array) -> tuple[float, float]:
    """The share of intervals (n, r) that hold the truth (r,), and its standard error: parameters of
    one repeat share their noise, so it is over the n repeats alone."""
    held = ((low <= truth) & (truth <= high)).mean(axis=1)
    return float(held.mean()), float(held.std(ddof=1) / np.sqrt(len(held)))


@cache
def covered(kind: str) -> dict[str, float]:
    """The share of intervals that hold the truth, of three ways to make them."""
    rng = np.random.default_rng(4)
    ends: dict[str, list[tuple[Array, Array]]] = {"textbook": [], "sandwich": [], "periods": []}
    for _ in range(REPEATS):
        W = regressor()
        problem = problem_of(W, W @ TRUTH + noise(kind, rng))
        estimate, sigma = WLS().solve(problem), row_noise(problem)
        assert estimate.beta is not None
        assert estimate.covariance is not None
        scores = residual_score(problem, estimate.beta, sigma)
        for name, made in (
            ("textbook", StandardError(estimate.covariance)),
            ("sandwich", scores.residual_covariance(scores.bandwidth)),
            ("periods", scores.period_covariance(PERIOD)),
        ):
            ends[name].append(made.interval(estimate.beta))
    found = {}
    for name, pairs in ends.items():
        low, high = (np.array(side) for side in zip(*pairs, strict=True))
        found[name], error = coverage(low, high, TRUTH)
        assert error < 0.02
    return found


def test_white_noise_is_covered_by_all() -> None:
    found = covered("white")
    assert 0.93 < found["textbook"] < 0.97
    assert 0.92 < found["sandwich"] < 0.97
    assert 0.925 < found["periods"] < 0.975


def test_slow_noise_is_covered_by_repeated_periods_and_not_by_the_textbook() -> None:
    found = covered("slow")
    assert found["textbook"] < 0.85
    assert 0.88 < found["sandwich"] < 0.98
    assert 0.925 < found["periods"] < 0.975


def test_two_periods_are_needed_to_see_a_spread() -> None:
    W = regressor()
    scores = residual_score(problem_of(W, W @ TRUTH), TRUTH, np.ones(2))
    for samples in (PERIOD * PERIODS, 10 * PERIOD * PERIODS, 0):
        with pytest.raises(UsageError, match="at least two"):
            scores.period_covariance(samples)
    assert scores.period_covariance(PERIOD * PERIODS // 2).freedom == 1


def test_a_spread_of_exact_data_is_nothing() -> None:
    W = regressor()
    scores = residual_score(problem_of(W, W @ TRUTH), TRUTH, np.ones(2))
    for made in (
        scores.period_covariance(PERIOD),
        scores.residual_covariance(scores.bandwidth),
    ):
        assert np.abs(made.std).max() < 1e-12


@pytest.mark.parametrize(
    ("period", "kinds"),
    [
        (PERIOD, ["periods", "residuals", "textbook"]),
        (PERIOD * PERIODS // 5, ["periods", "residuals", "textbook"]),
        (PERIOD * PERIODS // 4, ["residuals", "textbook"]),
        (0, ["residuals", "textbook"]),
    ],
)
def test_periods_are_reported_first_where_there_are_enough(period: int, kinds: list[str]) -> None:
    W = regressor()
    problem = replace(
        problem_of(W, W @ TRUTH + noise("slow", np.random.default_rng(1))), period=period
    )
    estimate = WLS().solve(problem)
    assert list(standard_errors(problem, estimate)) == kinds
    assert list(standard_errors(problem, replace(estimate, sigma=None))) == ["textbook"]
    assert standard_errors(problem, Estimate(estimate.beta)) == {}


@pytest.mark.parametrize("method", [OLS(), WLS()])
def test_deviations_have_the_units_of_torque_over_those_of_columns(method: OLS | WLS) -> None:
    W, factor = regressor(), np.array([1e-3, 1.0, 20.0, 1e3])
    tau = W @ TRUTH + noise("slow", np.random.default_rng(2))
    plain, scaled = (
        replace(problem_of(w, t), period=PERIOD) for w, t in ((W, tau), (W * factor, 7.0 * tau))
    )
    reported, other = (standard_errors(one, method.solve(one)) for one in (plain, scaled))
    for kind in reported:
        np.testing.assert_allclose(other[kind].std, 7.0 * reported[kind].std / factor, rtol=1e-6)


def test_windows_are_bartlett_weights() -> None:
    W = regressor()[:200]
    tau = W @ TRUTH + noise("slow", np.random.default_rng(3))[:200]
    problem, sigma, lags = problem_of(W, tau), np.array([0.3, 0.1]), 7
    beta = TRUTH + 0.01
    forces = np.einsum("nir,ni->nr", W, (tau - W @ beta) / sigma**2)
    middle = forces.T @ forces
    for k in range(1, lags + 1):
        shifted = forces[k:].T @ forces[:-k]
        middle += (1 - k / (lags + 1)) * (shifted + shifted.T)
    inverse = np.linalg.inv(np.einsum("nir,nis->rs", W / sigma[:, None] ** 2, W))
    found = residual_score(problem, beta, sigma).residual_covariance(lags).covariance
    assert_close(found, inverse @ middle @ inverse)


def test_the_bandwidth_grows_with_how_slow_noise_is() -> None:
    rng = np.random.default_rng(0)
    white, slow = (ResidualScore(np.eye(2), noise(kind, rng)) for kind in ("white", "slow"))
    assert white.bandwidth < 8 < 30 < slow.bandwidth


def test_quantiles_are_students() -> None:
    for level, freedom, quantile in (
        (0.95, np.inf, 1.959964),
        (0.95, 1.0, 12.7062),
        (0.9, 9.0, 1.833113),
    ):
        low, high = StandardError(np.diag([1.0, 4.0]), freedom).interval(np.ones(2), level)
        np.testing.assert_allclose(high - 1.0, [quantile, 2 * quantile], rtol=1e-5)
        assert_close(1.0 - low, high - 1.0, 1e-12)


# --- The bound ----------------------------------------------------------------------------------


@cache
def errors_of(method: OLS | WLS, repeats: int) -> Array:
    rng, found = np.random.default_rng(5), []
    for _ in range(repeats):
        W = regressor()[:300]
        beta = method.solve(problem_of(W, W @ TRUTH + noise("white", rng)[:300])).beta
        assert beta is not None
        found.append(beta - TRUTH)
    return np.array(found)


def bound_of_white() -> Array:
    bound = torque_bound([regressor()[:300]], np.diag([0.3, 0.1]) ** 2)
    assert bound is not None
    return np.sqrt(np.diag(bound))


def test_factors_give_the_bound_of_the_rows() -> None:
    W, std = regressor()[:300], np.array([0.3, 0.1])
    by_factors = white_bound(problem_of(W, W @ TRUTH), std)
    by_rows = torque_bound([W], np.diag(std**2))
    assert by_factors is not None
    assert by_rows is not None
    np.testing.assert_allclose(by_factors, by_rows, rtol=1e-9, atol=1e-15)
    assert white_bound(problem_of(W[:1], W[:1] @ TRUTH), std) is None


def test_weighted_least_squares_reaches_the_bound_and_plain_does_not() -> None:
    errors, bound = errors_of(WLS(), 400), bound_of_white()
    for figure in WITH_BOUND.values():
        reported, low, high = figure(errors, bound)
        assert low < reported < high
        assert low < 1.0 < high
    _, _, high = WITH_BOUND["efficiency"](errors_of(OLS(), 400), bound)
    assert high < 0.9


@pytest.mark.parametrize("share", [0.0, 1.0, 3.0])
def test_bias_is_distinguished_from_scatter(share: float) -> None:
    bound = bound_of_white()
    straight = errors_of(WLS(), 400)
    errors = straight + share * bound
    spread, bound_ratio = WITH_BOUND["spread"], WITH_BOUND["bound_ratio"]
    assert_close(spread(errors, bound), spread(straight, bound))
    reported, low, high = mean_error(errors)
    assert low <= reported <= high
    assert low <= share <= high + 0.05
    assert high - low < 0.3
    assert bound_ratio(errors, bound)[0] == pytest.approx(np.hypot(1, share), rel=0.05)


def test_intervals_of_figures_narrow_with_repeats() -> None:
    bound = bound_of_white()
    few, many = (WITH_BOUND["efficiency"](errors_of(WLS(), 400)[:n], bound) for n in (40, 400))
    assert (many[2] - many[1]) < 0.5 * (few[2] - few[1])


@pytest.mark.parametrize("correlation", [0.5, 0.98])
def test_noise_with_memory_is_bounded_by_the_inverse_of_its_covariance(correlation: float) -> None:
    W, std = regressor()[:80], np.array([0.3, 0.1])
    lags = np.abs(np.subtract.outer(np.arange(80), np.arange(80)))
    inverse = np.linalg.inv(correlation**lags)
    by_definition = sum(W[:, i].T @ inverse @ W[:, i] / std[i] ** 2 for i in range(2))
    bound = torque_bound([W[:1], W[1:30], W[30:]], np.diag(std**2), correlation)
    assert bound is not None
    assert_close(np.linalg.inv(bound), by_definition, 1e-9)


def test_what_the_motion_does_not_excite_has_no_bound() -> None:
    W = regressor()[:50].copy()
    W[..., 2] = W[..., 1]
    assert torque_bound([W], np.eye(2)) is None
    assert torque_bound([], np.eye(2)) is None


# --- Errors in variables ------------------------------------------------------------------------


@pytest.mark.parametrize(("samples", "rows", "joints"), [(12, 1, 1), (30, 2, 2), (20, 2, 3)])
def test_the_bound_with_encoders_is_that_of_the_dense_covariance(
    samples: int, rows: int, joints: int
) -> None:
    rng = np.random.default_rng(samples)
    N, step, r = samples, 0.1, 4
    W = rng.normal(size=(N, rows, r))
    dq, dv, da = (rng.normal(size=(N, rows, joints)) for _ in range(3))
    q_std, tau_std = rng.uniform(0.01, 0.1, joints), rng.uniform(0.1, 0.5, rows)
    D1 = (np.eye(N, k=1) - np.eye(N, k=-1)) / (2 * step)
    D2 = (np.eye(N, k=1) - 2 * np.eye(N) + np.eye(N, k=-1)) / step**2
    J = sum(np.einsum("kij,kl->kilj", d, D) for d, D in ((dq, np.eye(N)), (dv, D1), (da, D2)))
    inner = np.asarray(J)[1:-1].reshape((N - 2) * rows, N * joints)
    C = np.kron(np.eye(N - 2), np.diag(tau_std**2))
    C += inner @ np.kron(np.eye(N), np.diag(q_std**2)) @ inner.T
    flat = W[1:-1].reshape(-1, r)
    expected = np.linalg.inv(flat.T @ np.linalg.solve(C, flat))
    bound = encoder_bound(W, (dq, dv, da), step, q_std, tau_std)
    assert bound is not None
    assert_close(bound, expected, 1e-8)
    # Exact encoders: the bound of torque noise. Noisier ones: never a smaller bound.
    exact = encoder_bound(W, (dq, dv, da), step, 0 * q_std, tau_std)
    alone = torque_bound([W[1:-1]], np.diag(tau_std**2))
    assert exact is not None
    assert alone is not None
    assert_close(exact, alone, 1e-8)
    assert (np.diag(bound) > np.diag(alone)).all()
    assert encoder_bound(0 * W, (dq, dv, da), step, q_std, tau_std) is None


# --- Periods ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("period", "rate", "count", "samples"),
    [
        (2.0, 50.0, 1000, 100),
        (None, 50.0, 1000, 0),
        (2.001, 50.0, 1000, 100),  # half a sample in ten periods
        (2.004, 50.0, 1000, 0),
        (1.0, 140.0, 700, 140),
    ],
)
def test_periods_are_whole_samples(
    period: float | None, rate: float, count: int, samples: int
) -> None:
    t, still = np.arange(count) / rate, np.zeros((count, 1))
    motion = Trajectory(t, still, still, still, period=period)
    assert motion.period_samples == samples
    kept = np.delete(np.arange(count), slice(300, 305))
    gap = Trajectory(t[kept], still[kept], still[kept], still[kept], period=period)
    assert gap.period_samples == 0
