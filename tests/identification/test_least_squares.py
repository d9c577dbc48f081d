"""OLS and WLS against dense least squares, their covariance against repeated draws."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import qr

from sysid_bench.errors import EstimationError, UsageError
from sysid_bench.identification.estimators.linear import OLS, WLS
from sysid_bench.identification.linear.least_squares import residual_norm, row_noise
from sysid_bench.numerics import qr_factor
from sysid_bench.types import Array, BaseMap, Estimate, Factor, Problem
from tests.closeness import assert_close
from tests.experiments.experiment_world import RICH, dense, ready

NOISE = {"tau_relative": 0.02}


@cache
def noisy(robot: str = "ur5", payload: str = "none", task: str = "robot") -> Problem:
    return ready(robot=robot, payload=payload, task=task, noise=NOISE).problem


def problem_of(W: Array, b: Array) -> Problem:
    """A problem of dense rows W (N, rows, r), b (N, rows); zero columns do not act on a row."""
    n, rows, r = W.shape
    factors = []
    for i in range(rows):
        columns = np.flatnonzero(W[:, i].any(axis=0))
        R = qr(np.column_stack([W[:, i, columns], b[:, i]]), mode="r")[0][: len(columns) + 1]
        factors.append(Factor(f"j{i}", columns, R, n))
    names = tuple(f"p{i}" for i in range(r))
    base = BaseMap(np.eye(r), np.arange(r), names, np.inf, 0, np.ones(r))
    row_names = tuple(f.row for f in factors)
    return Problem(names, base, row_names, tuple(factors), (), lambda: iter([(W, b)]), n)


def beta_of(estimate: Estimate) -> Array:
    assert estimate.status == "ok"
    assert estimate.beta is not None
    return estimate.beta


def covariance_of(estimate: Estimate) -> Array:
    assert estimate.covariance is not None
    return estimate.covariance


PROBLEMS = [
    ("ur5", "none", "robot"),
    ("panda", "box-2kg", "robot"),
    ("solo12", "none", "robot"),
    ("ur10", "rod-1kg", "payload"),
    ("z1", "sphere-1kg", "link"),
    (RICH, "none", "robot"),
]


@pytest.mark.parametrize("place", PROBLEMS, ids=str)
def test_ols_is_least_squares_on_all_rows(place: tuple[str, str, str]) -> None:
    problem = noisy(*place)
    W, b = problem.W, problem.b
    assert W.shape == (problem.samples * len(problem.rows), problem.base.rank)
    beta, squares, rank, _ = np.linalg.lstsq(W, b)
    assert rank == problem.base.rank
    estimate = OLS().solve(problem)
    np.testing.assert_allclose(beta_of(estimate), beta, rtol=1e-7, atol=1e-9)
    touched = sum(len(f.columns) > 0 for f in problem.factors) * problem.samples
    variance = squares[0] / (touched - problem.base.rank)
    expected = variance * np.linalg.inv(W.T @ W)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((covariance_of(estimate) - expected) / scale).max() < 1e-6


def own_spreads(problem: Problem, Y: Array, B: Array) -> Array:
    """Noise (rows,) of each row by a fit of it alone, without the columns that are rounding error
    there; silent rows get the largest."""
    sigma = np.zeros(len(problem.rows))
    largest = np.linalg.norm(Y, axis=0).max(axis=0)
    for i, factor in enumerate(problem.factors):
        norms = np.linalg.norm(Y[:, i, factor.columns], axis=0)
        felt = norms > 1e-10 * largest[factor.columns]
        unit = Y[:, i, factor.columns[felt]] / norms[felt]
        U, values, _ = np.linalg.svd(unit, full_matrices=False)
        U = U[:, values > 1e-9 * values.max(initial=0.0)]
        rest = B[:, i] - U @ (U.T @ B[:, i])
        sigma[i] = np.linalg.norm(rest) / np.sqrt(len(B) - U.shape[1])
    return np.where(sigma > 0, sigma, sigma.max())


@pytest.mark.parametrize("iterations", [1, 3])
@pytest.mark.parametrize("place", PROBLEMS, ids=str)
def test_wls_is_least_squares_on_rows_divided_by_their_sigma(
    place: tuple[str, str, str], iterations: int
) -> None:
    """sigma_j: first the RMS of joint j's own least squares with N_j - b_j degrees of freedom, then
    that of the weighted fit with N_j - tr(H_jj)."""
    problem = noisy(*place)
    Y, B = dense(problem)
    sigma = own_spreads(problem, Y, B)
    np.testing.assert_allclose(row_noise(problem), sigma, rtol=1e-6)
    for _ in range(iterations):
        weight = 1.0 / sigma[None, :]
        scaled = (Y * weight[..., None]).reshape(-1, problem.base.rank)
        beta = np.linalg.lstsq(scaled, (B * weight).ravel())[0]
        leverage = (np.linalg.qr(scaled)[0] ** 2).sum(axis=1).reshape(B.shape).sum(axis=0)
        squares = ((B - Y @ beta) ** 2).sum(axis=0)
        sigma = np.where(squares > 0, np.sqrt(squares / (len(B) - leverage)), sigma)
    estimate = WLS(iterations=iterations).solve(problem)
    np.testing.assert_allclose(beta_of(estimate), beta, rtol=1e-6, atol=1e-8)
    expected = np.linalg.inv(scaled.T @ scaled)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((covariance_of(estimate) - expected) / scale).max() < 1e-5


def test_the_row_residuals_are_those_of_the_dense_rows() -> None:
    problem = noisy("panda", "box-2kg")
    Y, B = dense(problem)
    beta = np.random.default_rng(0).normal(size=problem.base.rank)
    expected = np.linalg.norm(B - Y @ beta, axis=0)
    np.testing.assert_allclose(residual_norm(problem, beta), expected, rtol=1e-10)


# --- Covariance against the spread of repeats ---------------------------------------------------

REPEATS = 600


def repeats(estimator: OLS | WLS, spreads: Array) -> tuple[Array, Array, Array]:
    """Estimates (REPEATS, r), mean covariance (r, r) and truth of a problem with white noise."""
    rng = np.random.default_rng(11)
    W = rng.normal(size=(60, 2, 4))
    W[:, 0, 3] = 0.0  # a parameter that the first row does not feel
    truth = np.array([1.0, -2.0, 0.5, 3.0])
    betas, covariances = [], []
    for _ in range(REPEATS):
        b = W @ truth + spreads * rng.normal(size=(60, 2))
        estimate = estimator.solve(problem_of(W, b))
        betas.append(beta_of(estimate))
        covariances.append(covariance_of(estimate))
    return np.array(betas), np.mean(covariances, axis=0), truth


@pytest.mark.parametrize(
    ("estimator", "spreads"),
    [(OLS(), [0.3, 0.3]), (WLS(), [0.3, 0.2]), (WLS(iterations=3), [0.3, 0.03])],
    ids=str,
)
def test_the_covariance_is_the_spread_of_repeats(
    estimator: OLS | WLS, spreads: list[float]
) -> None:
    betas, covariance, truth = repeats(estimator, np.array(spreads))
    std = np.sqrt(np.diag(covariance))
    # Five standard errors; a weighting by estimated sigmas adds about one per cent of its own.
    bound = 5 / np.sqrt(2 * REPEATS) + 0.02
    assert np.abs(betas.std(axis=0) / std - 1).max() < bound
    assert np.abs((betas.mean(axis=0) - truth) / std).max() < 5 / np.sqrt(REPEATS)
    correlation = covariance / np.outer(std, std)
    assert np.abs(np.corrcoef(betas.T) - correlation).max() < 5 / np.sqrt(REPEATS)


def test_weights_help_where_joints_differ() -> None:
    spreads = np.array([0.3, 0.03])
    plain, _, truth = repeats(OLS(), spreads)
    weighted, _, _ = repeats(WLS(), spreads)
    error = [np.sqrt(((betas - truth) ** 2).mean(axis=0)) for betas in (plain, weighted)]
    assert (error[1] < 0.5 * error[0])[:3].all()  # only the exact joint feels the fourth
    assert error[1][3] < error[0][3]


# --- What they refuse, and what they keep -------------------------------------------------------


@pytest.mark.parametrize("estimator", [OLS(), WLS()], ids=str)
def test_a_motion_that_does_not_excite_is_refused_with_its_rank(estimator: OLS | WLS) -> None:
    """One joint alone moves (one_joint.py)."""
    made = ready(excitation={"use": f"file:{Path(__file__).parent}/one_joint.py:OneJoint"})
    r = made.problem.base.rank
    with pytest.raises(EstimationError, match=rf"excites (\d+) of {r} base parameters") as error:
        estimator.solve(made.problem)
    rank = int(str(error.value).split("excites ")[1].split()[0])
    values = np.linalg.svd(made.problem.W / norms(made.problem.W), compute_uv=False)
    assert rank == (values > 1e-9 * values[0]).sum()
    assert 0 < rank < r


def norms(W: Array) -> Array:
    lengths = np.linalg.norm(W, axis=0)
    return np.where(lengths > 0, lengths, 1.0)


@pytest.mark.parametrize("estimator", [OLS(), WLS()], ids=str)
def test_a_problem_without_any_torque_or_motion_is_refused(estimator: OLS | WLS) -> None:
    with pytest.raises(EstimationError, match="excites 0 of 3"):
        estimator.solve(problem_of(np.zeros((20, 2, 3)), np.zeros((20, 2))))


@given(power=st.integers(-6, 6), seed=st.integers(0, 99))
@settings(max_examples=25)
def test_estimates_follow_the_units_of_torque_and_parameters(power: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    W = rng.normal(size=(40, 2, 3))
    b = W @ np.array([1.0, -2.0, 0.5]) + 0.1 * rng.normal(size=(40, 2))
    scale = 10.0**power
    units = 10.0 ** np.array([-7, *rng.integers(-7, 8, size=2)])  # far apart, and yet excited
    for estimator in (OLS(), WLS(iterations=2)):
        plain = estimator.solve(problem_of(W, b))
        torque = estimator.solve(problem_of(W, scale * b))
        columns = estimator.solve(problem_of(W * units, b))
        assert_close(beta_of(torque), scale * beta_of(plain), 1e-8)
        assert_close(beta_of(columns) * units, beta_of(plain), 1e-8)
        ratio = covariance_of(torque) / covariance_of(plain)
        np.testing.assert_allclose(ratio, scale**2, rtol=1e-6)
        ratio = covariance_of(columns) * np.outer(units, units) / covariance_of(plain)
        np.testing.assert_allclose(ratio, 1.0, rtol=1e-6)


@given(factor=st.floats(1e-3, 1e3), seed=st.integers(0, 99))
@settings(max_examples=15)
def test_wls_is_invariant_to_the_unit_of_a_joint(factor: float, seed: int) -> None:
    """A slide in N or in kN: the weights take the unit out again."""
    rng = np.random.default_rng(seed)
    W = rng.normal(size=(60, 2, 3))
    b = W @ np.array([1.0, -2.0, 0.5]) + np.array([0.1, 0.2]) * rng.normal(size=(60, 2))
    units = np.array([1.0, factor])
    one = WLS().solve(problem_of(W, b))
    other = WLS().solve(problem_of(W * units[:, None], b * units))
    assert_close(beta_of(one), beta_of(other), 1e-9)


@pytest.mark.parametrize("estimator", [OLS(), WLS()], ids=str)
def test_rows_without_columns_change_nothing(estimator: OLS | WLS) -> None:
    rng = np.random.default_rng(5)
    W = rng.normal(size=(40, 2, 3))
    b = W @ np.array([1.0, -2.0, 0.5]) + 0.1 * rng.normal(size=(40, 2))
    wider = np.concatenate([W, np.zeros((40, 1, 3))], axis=1)
    quiet = np.concatenate([b, np.zeros((40, 1))], axis=1)
    one, other = estimator.solve(problem_of(W, b)), estimator.solve(problem_of(wider, quiet))
    assert_close(beta_of(one), beta_of(other), 1e-12)
    assert_close(covariance_of(one), covariance_of(other), 1e-9)


def test_exact_data_keep_weights_finite() -> None:
    rng = np.random.default_rng(5)
    W = rng.normal(size=(40, 2, 3))
    truth = np.array([1.0, -2.0, 0.5])
    estimate = WLS(iterations=3).solve(problem_of(W, W @ truth))
    assert_close(beta_of(estimate), truth, 1e-10)
    assert np.isfinite(covariance_of(estimate)).all()


def test_settings_that_ask_for_no_iteration_ask_for_one() -> None:
    problem = noisy()
    np.testing.assert_array_equal(
        beta_of(replace(WLS(), iterations=0).solve(problem)), beta_of(WLS().solve(problem))
    )


@pytest.mark.parametrize("place", PROBLEMS, ids=str)
def test_weights_by_the_largest_torque_are_dense_least_squares(place: tuple[str, str, str]) -> None:
    problem = noisy(*place)
    W, b = (part.reshape(problem.samples, len(problem.rows), -1) for part in problem.stacked)
    size = np.abs(b[..., 0]).max(axis=0)
    size = np.where(size > 0, size, size.max())
    A, z = (W / size[:, None]).reshape(-1, W.shape[2]), (b[..., 0] / size).ravel()
    beta, *_ = np.linalg.lstsq(A, z)
    estimate = WLS(weights="max-torque").solve(problem)
    scale = np.linalg.norm(A @ beta)
    assert np.linalg.norm(A @ (beta_of(estimate) - beta)) <= 1e-8 * scale
    variance = ((z - A @ beta) ** 2).sum() / (len(z) - len(beta))
    expected = np.sqrt(variance * np.diag(np.linalg.inv(A.T @ A)))
    np.testing.assert_allclose(np.sqrt(np.diag(covariance_of(estimate))), expected, rtol=1e-4)


@pytest.mark.parametrize("place", PROBLEMS, ids=str)
def test_weights_by_the_rms_torque_are_dense_least_squares(place: tuple[str, str, str]) -> None:
    problem = noisy(*place)
    W, b = (part.reshape(problem.samples, len(problem.rows), -1) for part in problem.stacked)
    size = np.sqrt((b[..., 0] ** 2).mean(axis=0))
    assert (size > 0).all()
    A, z = (W / size[:, None]).reshape(-1, W.shape[2]), (b[..., 0] / size).ravel()
    beta, *_ = np.linalg.lstsq(A, z)
    estimate = WLS(weights="rms-torque").solve(problem)
    assert np.linalg.norm(A @ (beta_of(estimate) - beta)) <= 1e-8 * np.linalg.norm(A @ beta)


def test_unknown_weights_are_refused() -> None:
    with pytest.raises(UsageError, match="Did you mean 'max-torque'"):
        WLS(weights="max_torque")


@pytest.mark.parametrize("place", PROBLEMS, ids=str)
def test_a_column_of_rounding_errors_explains_no_noise(place: tuple[str, str, str]) -> None:
    """Gravity about a vertical axis is zero but for rounding, which must not fit the torque."""
    problem = noisy(*place)
    *others, last = problem.factors
    absent = np.setdiff1d(np.arange(problem.base.rank), last.columns)[:1]
    tiny = 1e-16 * np.random.default_rng(0).normal(size=(len(last.R), len(absent)))
    wider = np.hstack([last.R[:, :-1], tiny, last.R[:, -1:]])
    R = qr_factor([wider, np.zeros((len(absent), wider.shape[1]))])
    more = replace(last, columns=np.concatenate([last.columns, absent]), R=R)
    rounded = replace(problem, factors=(*others, more))
    np.testing.assert_allclose(row_noise(rounded), row_noise(problem), rtol=1e-9)
