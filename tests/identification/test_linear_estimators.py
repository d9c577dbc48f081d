"""Each method against its definition, written densely and without its tricks."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sysid_bench.errors import EstimationError, UsageError
from sysid_bench.identification.estimators.bayesian import APriori, PriorMean, Ridge
from sysid_bench.identification.estimators.linear import TLS, WLS, Essential
from sysid_bench.identification.estimators.recursive import RLS, Kalman
from sysid_bench.identification.estimators.robust import IRLS, ArGls, Huber, Tukey
from sysid_bench.identification.linear.least_squares import row_noise, stacked_factor
from sysid_bench.types import Array, Estimate, Problem
from tests.closeness import assert_close
from tests.experiments.experiment_world import dense, ready
from tests.identification.test_least_squares import problem_of

PLACES = [("ur5", "robot"), ("random:12", "robot"), ("solo12", "robot")]
TRUTH = np.array([1.0, -2.0, 0.5, 3.0])


@cache
def noisy(robot: str, task: str = "robot") -> Problem:
    return ready(robot=robot, task=task, noise={"tau_relative": 0.02}).problem


def beta_of(estimate: Estimate) -> Array:
    assert estimate.status == "ok"
    assert estimate.beta is not None
    return estimate.beta


def deviations(estimate: Estimate) -> Array:
    assert estimate.covariance is not None
    return np.sqrt(np.diag(estimate.covariance))


def scaled(problem: Problem, root: Array | float = 1.0) -> tuple[Array, Array]:
    """Dense rows (M, r) and torques (M,) over the noise of their joint, times `root` (N, rows)."""
    Y, b = dense(problem)
    weight = root / row_noise(problem) * np.ones_like(b)
    return (Y * weight[..., None]).reshape(-1, Y.shape[2]), (b * weight).ravel()


def close(problem: Problem, one: Array, other: Array, share: float = 1e-7) -> None:
    """Assert that the torques of two estimates agree within a share of them."""
    R = stacked_factor(problem)[:-1, :-1]
    assert np.linalg.norm(R @ (one - other)) <= share * np.linalg.norm(R @ other)


def small(seed: int, noise: Array, count: int = 300) -> tuple[Array, Array]:
    """Rows W (count, 2, 4) and torques with noise (count, 2)."""
    W = np.random.default_rng(seed).normal(size=(count, 2, 4))
    return W, W @ TRUTH + noise


# --- Recursions ---------------------------------------------------------------------------------


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_recursions_without_forgetting_equal_wls(place: tuple[str, str]) -> None:
    problem = noisy(*place)
    batch = WLS().solve(problem)
    for method in (RLS(forgetting=1.0), Kalman(), Kalman(hold=7)):
        estimate = method.solve(problem)
        close(problem, beta_of(estimate), beta_of(batch))
        np.testing.assert_allclose(deviations(estimate), deviations(batch), rtol=1e-6)


@pytest.mark.parametrize("forgetting", [0.99, 0.995])
def test_forgetting_is_an_exponential_weight(forgetting: float) -> None:
    problem = noisy("ur5")
    age = np.arange(problem.samples)[::-1]
    A, z = scaled(problem, np.sqrt(forgetting**age)[:, None])
    estimate = RLS(forgetting=forgetting).solve(problem)
    close(problem, beta_of(estimate), np.linalg.lstsq(A, z)[0])
    inverse = np.linalg.inv(A.T @ A)
    twice, _ = scaled(problem, (forgetting**age)[:, None])
    expected = np.sqrt(np.diag(inverse @ twice.T @ twice @ inverse))
    np.testing.assert_allclose(deviations(estimate), expected, rtol=1e-5)


@pytest.mark.parametrize(("drift", "hold"), [(0.3, 20), (5.0, 9)])
def test_the_kalman_filter_equals_generalised_least_squares(drift: float, hold: int) -> None:
    """Generalised least squares on all samples at once, each missing the steps that came later."""
    problem = noisy("ur5")
    Y, b = dense(problem)
    assert problem.prior is not None
    spread = drift * problem.base.K * problem.prior.std
    W, step = Y.reshape(-1, problem.base.rank), np.arange(len(b)) // hold
    step = np.repeat(step, b.shape[1])
    later = step.max() - np.maximum(step[:, None], step)
    walked = W @ spread
    C = later * (walked @ walked.T) / (len(b) / hold)
    C += np.diag(np.tile(row_noise(problem) ** 2, len(b)))
    information = W.T @ np.linalg.solve(C, W)
    beta = np.linalg.solve(information, W.T @ np.linalg.solve(C, b.ravel()))
    estimate = Kalman(drift=drift, hold=hold).solve(problem)
    close(problem, beta_of(estimate), beta, 1e-6)
    expected = np.sqrt(np.diag(np.linalg.inv(information)))
    np.testing.assert_allclose(deviations(estimate), expected, rtol=1e-5)


def test_a_filter_that_may_drift_follows_a_change() -> None:
    rng = np.random.default_rng(0)
    W = rng.normal(size=(400, 2, 4))
    later = np.where(np.arange(400)[:, None] < 200, TRUTH, 2 * TRUTH)
    b = np.einsum("nir,nr->ni", W, later) + 0.1 * rng.normal(size=(400, 2))
    followed = beta_of(RLS(forgetting=0.95).solve(problem_of(W, b)))
    assert np.abs(followed - 2 * TRUTH).max() < 0.2
    assert np.abs(beta_of(WLS().solve(problem_of(W, b))) - 2 * TRUTH).max() > 0.3


# --- Robust methods -----------------------------------------------------------------------------


@pytest.mark.parametrize("method", [Huber(), Tukey(), IRLS()], ids=str)
def test_m_estimates_reject_outliers(method: Huber | Tukey | IRLS) -> None:
    rng = np.random.default_rng(1)
    noise = 0.1 * rng.normal(size=(300, 2))
    noise[rng.uniform(size=noise.shape) < 0.1] += 8.0
    problem = problem_of(*small(2, noise))
    plain = np.abs(beta_of(WLS().solve(problem)) - TRUTH).max()
    assert np.abs(beta_of(method.solve(problem)) - TRUTH).max() < 0.3 * plain
    assert np.abs(beta_of(Tukey().solve(problem)) - TRUTH).max() < 0.02


@pytest.mark.parametrize("method", [Huber(cut=1e6), Tukey(cut=1e6)], ids=str)
def test_m_estimates_with_a_large_cut_are_least_squares(method: Huber | Tukey) -> None:
    noise = np.random.default_rng(3).normal(size=(300, 2)) * [0.1, 0.5]
    problem = problem_of(*small(4, noise))
    W, b = dense(problem)
    scales = np.ones(2)
    for _ in range(50):  # the fixed point of weights by the median of residuals
        root = 1 / scales
        beta = np.linalg.lstsq((W * root[:, None]).reshape(-1, 4), (b * root).ravel())[0]
        scales = np.median(np.abs(b - W @ beta), axis=0) / 0.6745
    assert_close(beta_of(method.solve(problem)), beta, 1e-3)


@pytest.mark.parametrize(
    ("method", "influence"),
    [
        (Huber(), lambda u: np.clip(u, -1.345, 1.345)),
        (Tukey(), lambda u: np.where(np.abs(u) < 4.685, u * (1 - (u / 4.685) ** 2) ** 2, 0.0)),
    ],
    ids=["huber", "tukey"],
)
def test_influences_balance(method: Huber | Tukey, influence) -> None:  # type: ignore[no-untyped-def]
    """W' psi(r / s) / s = 0: the definition of an M-estimate."""
    rng = np.random.default_rng(5)
    problem = problem_of(*small(6, 0.1 * rng.standard_t(3, size=(300, 2))))
    W, b = dense(problem)
    residual = b - W @ beta_of(method.solve(problem))
    start = b - W @ beta_of(Huber().solve(problem))
    scales = np.median(np.abs(start), axis=0) / 0.6745
    psi = influence(residual / scales) / scales
    forces = np.abs(np.einsum("nir,ni->r", W, psi))
    assert forces.max() < 0.02 * np.einsum("nir,ni->r", np.abs(W), np.abs(psi)).max()


def test_irls_weighs_by_the_covariance_across_joints() -> None:
    rng = np.random.default_rng(7)
    mixing = np.array([[0.3, 0.0], [0.29, 0.05]])
    noise = rng.normal(size=(2000, 2)) @ mixing.T
    W, b = small(8, noise, 2000)
    whiten = np.linalg.inv(mixing)
    best = np.linalg.lstsq((whiten @ W).reshape(-1, 4), (b @ whiten.T).ravel())[0]
    estimate = IRLS(cut=30.0).solve(problem_of(W, b))
    std = np.sqrt(np.diag(np.linalg.inv(np.einsum("nir,nis->rs", whiten @ W, whiten @ W))))
    assert np.abs((beta_of(estimate) - best) / std).max() < 0.2
    np.testing.assert_allclose(deviations(estimate), std, rtol=0.05)
    assert (deviations(estimate) < 0.5 * deviations(WLS().solve(problem_of(W, b)))).all()


def test_the_covariance_of_ar_gls_holds_for_coloured_noise() -> None:
    """Spread of repeats over the stated deviation: one, while that of WLS is far too small."""
    t = np.arange(400) / 100
    base = np.stack([np.sin(t), np.cos(2 * t), np.sin(5 * t), np.ones_like(t)], axis=-1)
    W = np.stack([base, base[:, ::-1]], axis=1)
    found: dict[str, list[Array]] = {"ar": [], "wls": []}
    stated: dict[str, list[Array]] = {"ar": [], "wls": []}
    for seed in range(60):
        white = np.random.default_rng(seed).normal(size=(600, 2))
        noise = np.zeros((600, 2))
        for k in range(1, 600):
            noise[k] = 0.9 * noise[k - 1] + 0.1 * white[k]
        problem = problem_of(W, W @ TRUTH + noise[200:])
        for name, method in (("ar", ArGls(order=1)), ("wls", WLS())):
            estimate = method.solve(problem)
            found[name].append(beta_of(estimate))
            stated[name].append(deviations(estimate))
    ratio = {
        name: np.std(found[name], axis=0).mean() / np.mean(stated[name], axis=0).mean()
        for name in found
    }
    assert 0.75 < ratio["ar"] < 1.35
    assert ratio["wls"] > 2


# --- Shrinking, choosing, errors in the regressor -----------------------------------------------


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_a_priori_is_the_most_probable_theta(place: tuple[str, str]) -> None:
    problem = noisy(*place)
    assert problem.prior is not None
    A, z = scaled(problem)
    A = A @ problem.base.K * problem.prior.std
    rest = z - A @ (problem.prior.theta / problem.prior.std)
    x = np.linalg.solve(A.T @ A + np.eye(A.shape[1]), A.T @ rest)
    estimate = APriori().solve(problem)
    assert estimate.theta is not None
    assert estimate.covariance is not None
    np.testing.assert_allclose(
        (estimate.theta - problem.prior.theta) / problem.prior.std, x, atol=1e-5
    )
    spread = problem.base.K * problem.prior.std
    posterior = spread @ np.linalg.solve(A.T @ A + np.eye(A.shape[1]), spread.T)
    np.testing.assert_allclose(
        np.sqrt(np.diag(estimate.covariance)), np.sqrt(np.diag(posterior)), rtol=1e-5
    )


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_the_null_model_is_the_prior_whatever_the_data(place: tuple[str, str]) -> None:
    problem = noisy(*place)
    assert problem.prior is not None
    estimate = PriorMean().solve(problem)
    assert estimate.covariance is not None
    assert estimate.theta is not None
    np.testing.assert_array_equal(estimate.theta, problem.prior.theta)
    spread = problem.base.K * problem.prior.std
    assert_close(estimate.covariance, spread @ spread.T)
    # Data of no weight leave Bayesian least squares at the null model.
    drawn = APriori(weight=1e30).solve(problem).theta
    assert drawn is not None
    np.testing.assert_allclose(drawn, problem.prior.theta, atol=1e-9)
    with pytest.raises(EstimationError, match="needs a prior"):
        PriorMean().solve(replace(problem, prior=None))


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_a_weak_ridge_is_least_squares_and_a_strong_one_is_zero(place: tuple[str, str]) -> None:
    problem = noisy(*place)
    close(problem, beta_of(Ridge(weight=1e-9).solve(problem)), beta_of(WLS().solve(problem)), 1e-4)
    least = np.linalg.norm(beta_of(WLS().solve(problem)))
    assert np.linalg.norm(beta_of(Ridge(weight=1e6).solve(problem))) < 1e-3 * least
    with pytest.raises(UsageError, match="positive"):
        Ridge(weight=-1.0).solve(problem)


@pytest.mark.parametrize("place", [("ur5", "robot"), ("z1", "robot")], ids=str)
def test_tls_is_the_smallest_singular_vector_on_unit_columns(place: tuple[str, str]) -> None:
    problem = noisy(*place)
    Z = np.column_stack([problem.W, problem.b])
    norms = np.linalg.norm(Z, axis=0)
    v = np.linalg.svd(Z / norms, full_matrices=False)[2][-1] / norms
    close(problem, beta_of(TLS().solve(problem)), -v[:-1] / v[-1], 1e-6)


def test_tls_is_consistent_where_the_regressor_has_errors() -> None:
    rng = np.random.default_rng(9)
    errors = []
    for method in (TLS(), WLS()):
        found = []
        for _ in range(40):
            W = rng.normal(size=(400, 2, 4))
            b = W @ TRUTH
            b = b + 0.3 * np.sqrt(np.mean(b**2)) * rng.normal(size=b.shape)
            found.append(beta_of(method.solve(problem_of(W + 0.3 * rng.normal(size=W.shape), b))))
        errors.append(np.linalg.norm(np.mean(found, axis=0) - TRUTH))
    assert errors[0] < 0.05
    assert errors[1] > 4 * errors[0]


def test_tls_fails_where_it_has_no_solution() -> None:
    rng = np.random.default_rng(10)
    W = rng.normal(size=(200, 2, 3))
    W[..., 2] = W[..., 1] + 1e-4 * rng.normal(size=W.shape[:2])
    with pytest.raises(EstimationError, match="no solution"):
        TLS().solve(problem_of(W, rng.normal(size=(200, 2))))


def test_essential_parameters_remove_zeros() -> None:
    truth = np.array([1.0, 0.0, 0.5, 0.0])
    kept = np.zeros(4)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        W = rng.normal(size=(300, 2, 4))
        b = W @ truth + 0.3 * rng.normal(size=(300, 2))
        estimate = Essential(ratio=5.0).solve(problem_of(W, b))
        beta = beta_of(estimate)
        assert estimate.stats["essential"] == np.count_nonzero(beta)
        assert (deviations(estimate) > 0).tolist() == (beta != 0).tolist()
        kept += beta != 0
    assert kept[0] == kept[2] == 20
    assert kept[[1, 3]].max() < 10


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_essential_parameters_keep_the_torques(place: tuple[str, str]) -> None:
    problem = noisy(*place)
    beta = beta_of(Essential().solve(problem))
    assert 0 < np.count_nonzero(beta) < len(beta)
    R = stacked_factor(problem, (1 / row_noise(problem)).tolist())
    squares = np.sum((R[:, -1] - R[:, :-1] @ beta) ** 2)
    assert squares < 1.1 * R[-1, -1] ** 2
