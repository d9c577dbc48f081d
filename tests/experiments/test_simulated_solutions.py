"""Plain loops and SciPy give the answers of the estimators that simulate or filter."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.optimize import approx_fprime, least_squares

from sysid_bench.errors import UsageError
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.identification.estimators.didim_iv import joint_inertia
from sysid_bench.identification.estimators.filters import UKF, JointFilter, joint_filter
from sysid_bench.identification.feasibility.simulatable import simulatable_set
from sysid_bench.identification.identify import identify
from sysid_bench.plugin_names import build
from sysid_bench.types import Array, Estimate, Experiment, Recording
from tests.closeness import assert_close
from tests.experiments.experiment_world import RICH, SMOOTH, executed, ready, spec

pytestmark = pytest.mark.long  # simulations by the hundred

STEP = 0.1
"""Stop tolerance of the statistical rules, in standard deviations."""

PUBLISHED = 0.025
"""Stop tolerance of the published rules."""

LOOP = {"use": "closed-loop", "rate": "2 kHz", "substeps": 1}
SIGNALS = {"filter": "butter 4 20 Hz zero-phase", "derivatives": "from q"}
NOISE = {"q": 2e-6, "tau_relative": 0.02}
SHORT = {"use": "fourier", "period": "2 s", "cycles": 1}


@cache
def noisy(
    robot: str = SMOOTH, payload: str = "box-2kg", task: str = "payload"
) -> ExperimentData[SimulatedSource]:
    return ready(
        robot=robot, payload=payload, task=task, simulation=LOOP, excitation=SHORT, rate=100.0,
        noise=NOISE, signals=SIGNALS,
    )  # fmt: skip


@cache
def coarse() -> ExperimentData[SimulatedSource]:
    """Fifty samples of three joints."""
    return ready(
        robot=RICH, simulation=LOOP, noise={"q": 1e-5, "tau": 0.01}, rate=50.0, signals=SIGNALS,
        excitation={"use": "fourier", "period": "1 s", "cycles": 1},
    )  # fmt: skip


def fit(name: Any, made: ExperimentData[SimulatedSource]) -> Any:
    found = identify(build("estimator", name), made.problem, made.experiment)
    assert found.status == "ok", found.reason
    return found


def miss(found: Any, beta: Array) -> float:
    """RMS difference in standard deviations of the estimate."""
    half = np.linalg.cholesky(found.covariance)
    return float(np.linalg.norm(np.linalg.solve(half, found.beta - beta)) / np.sqrt(len(beta)))


def regressor(experiment: Experiment, recording: Recording, samples: Any = slice(None)) -> Array:
    Y = np.concatenate(list(experiment.regress(recording.motion)))
    return np.asarray(Y[samples])


def weighted(Z: Array, W: Array, b: Array) -> Array:
    """(Z' S^-1 W)^-1 Z' S^-1 b, S from the residuals of a first solution with S the mean square."""
    sigma = np.sqrt((b**2).mean(axis=0))
    for _ in range(2):
        one, two, rest = Z / sigma[:, None], W / sigma[:, None], b / sigma
        r = W.shape[2]
        normal = one.reshape(-1, r).T @ two.reshape(-1, r)
        beta = np.linalg.solve(normal, one.reshape(-1, r).T @ rest.ravel())
        sigma = np.sqrt(((b - W @ beta) ** 2).mean(axis=0))
    return np.asarray(beta)


def whitened(W: Array, b: Array, beta: Array) -> Array:
    """R factor (r, r) of rows divided by the deviation of their residuals."""
    sigma = np.sqrt(((b - W @ beta) ** 2).mean(axis=0))
    return np.asarray(np.linalg.qr((W / sigma[:, None]).reshape(-1, W.shape[2]), mode="r"))


def iterated(made: ExperimentData[SimulatedSource], method: str, count: int) -> Array:
    """DIDIM or IV by a plain loop, from the prior, with the gains declared."""
    experiment = made.experiment
    simulatable = simulatable_set(made.problem)
    theta = simulatable.centre
    inside = np.searchsorted(experiment.raw.t, experiment.recording.t - 1e-6)
    for _ in range(count):
        simulated = experiment.simulate(theta)
        W = regressor(experiment, simulated)
        b = experiment.raw.tau - experiment.known(simulated.motion)
        if method == "iv":
            blocks = list(made.problem.blocks())
            measured = (np.concatenate([each[k] for each in blocks]) for k in (0, 1))
            W, (measured_W, b) = experiment.filter_rows(W[inside]), measured
            beta = weighted(W, measured_W, b)
        else:
            beta = weighted(W, W, b)
        # The nearest bodies that can be simulated, found from the whitened rows of the data.
        moved = simulatable.with_base(theta, beta)
        theta = simulatable.nearest(beta, whitened(W, b, beta)) if moved is theta else moved
    return np.asarray(beta)


@pytest.mark.parametrize("name", ["iv", {"use": "didim", "gains": "kept"}], ids=str)
def test_a_plain_loop_gives_the_published_iterations(name: Any) -> None:
    made = noisy()
    found = fit(name, made)
    assert found.converged
    assert found.simulations == found.iterations
    method = name if isinstance(name, str) else "didim"
    beta = iterated(made, method, found.iterations)
    W = made.problem.W
    size = np.linalg.norm(W @ beta)
    # Bodies nearest to an infeasible beta depend a little on the metric.
    assert np.linalg.norm(W @ (found.beta - beta)) <= 1e-4 * size
    late = iterated(made, method, found.iterations + 5)
    assert np.linalg.norm(W @ (late - beta)) <= PUBLISHED * size


def test_updated_gains_keep_the_poles() -> None:
    """Gains over the inertia of each joint are those of least squares, for any parameters."""
    made = noisy(RICH, "none", "robot")
    gains: list[tuple[Array, Array]] = []
    simulate = made.experiment.simulate

    def watched(theta: Array, controller: Any) -> Recording:
        inertia = joint_inertia(made.experiment, made.problem.base.K @ theta)
        gains.append((controller.kp / inertia, controller.kd / inertia))
        return simulate(theta, controller)

    experiment = made.experiment.__class__(**{**vars(made.experiment), "simulate": watched})
    found = identify(build("estimator", "didim"), made.problem, experiment)
    assert found.status == "ok", found.reason
    assert len(gains) > 1
    for kp, kd in gains[1:]:
        np.testing.assert_allclose(kp, gains[0][0], rtol=1e-9)
        np.testing.assert_allclose(kd, gains[0][1], rtol=1e-9)


def test_gains_of_another_word_are_refused() -> None:
    with pytest.raises(UsageError, match="kept, updated"):
        build("estimator", {"use": "didim", "gains": "fixed"})


@pytest.mark.long
@pytest.mark.parametrize(("name", "signal"), [("cloe", "q"), ("clie", "tau")])
def test_scipy_finds_the_same_output_error(name: str, signal: str) -> None:
    made = noisy()
    found = fit(name, made)
    measured = getattr(made.experiment.raw, signal)
    theta = np.linalg.solve(made.problem.base.K, found.beta)
    sigma = (measured - getattr(made.experiment.simulate(theta), signal)).std(axis=0)

    def error(scaled: Array) -> Array:
        simulated = made.experiment.simulate(theta * (1 + scaled))
        return np.asarray(((measured - getattr(simulated, signal)) / sigma).ravel())

    better = least_squares(
        error, np.full(len(theta), 1e-3), diff_step=np.full(len(theta), 1e-4), max_nfev=6
    )
    assert miss(found, made.problem.base.K @ (theta * (1 + better.x))) < STEP


# --- Filters ------------------------------------------------------------------------------------


def by_loop(model: JointFilter, predict: Any) -> Array:
    """beta of a textbook filter that predicts with `predict(f, mean, P)`."""
    n = model.n
    H = np.eye(n, len(model.start().mean))
    mean, P = model.start().mean, model.start().covariance
    for k in range(len(model.q)):
        if k:
            Q = model.process_noise(mean)
            mean, P = predict(lambda x, k=k: model.step(np.atleast_2d(x), k - 1)[0], mean, P)
            P = P + Q
        S = H @ P @ H.T + np.diag(model.q_noise**2)
        gain = P @ H.T @ np.linalg.inv(S)
        mean, P = mean + gain @ (model.q[k] - H @ mean), (np.eye(len(P)) - gain @ H) @ P
    return np.asarray(mean[2 * n :])


def by_derivatives(f: Any, mean: Array, P: Array) -> tuple[Array, Array]:
    F = approx_fprime(mean, f, 1e-3 * np.sqrt(np.diag(P)) + 1e-9)
    return f(mean), F @ P @ F.T


def by_sigma_points(f: Any, mean: Array, P: Array) -> tuple[Array, Array]:
    """Scaled unscented transform, alpha = 0.5, beta = 2, kappa = 1."""
    L = len(mean)
    scaling = 0.5**2 * (L + 1) - L
    root = np.linalg.cholesky((L + scaling) * P)
    points = [mean, *(mean + root[:, i] for i in range(L)), *(mean - root[:, i] for i in range(L))]
    moved = np.array([f(point) for point in points])
    w_mean = np.full(2 * L + 1, 1 / (2 * (L + scaling)))
    w_mean[0] = scaling / (L + scaling)
    w_cov = w_mean.copy()
    w_cov[0] += 1 - 0.5**2 + 2
    centre = w_mean @ moved
    return centre, np.einsum("s,si,sj->ij", w_cov, moved - centre, moved - centre)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "predict"),
    [
        ("ekf", by_derivatives),
        ({"use": "ukf", "alpha": 0.5, "beta": 2.0, "kappa": 1.0}, by_sigma_points),
    ],
    ids=["ekf", "ukf"],
)
def test_a_textbook_filter_gives_the_same_estimate(name: Any, predict: Any) -> None:
    made = coarse()
    found = fit(name, made)
    beta = by_loop(joint_filter(made.experiment, "A test", 1), predict)
    assert miss(found, beta) < 0.01


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("alpha", [1e-3, 0.1, 1.0])
def test_the_transform_is_exact_for_squares(alpha: float, seed: int) -> None:
    """z^2 of z ~ N(0, 1) has mean 1 and variance 2; sums of squares follow."""
    rng = np.random.default_rng(seed)
    mean, P = UKF(alpha=alpha).transform(lambda z: z**2, np.zeros(1), np.eye(1))
    assert_close([mean[0], P[0, 0]], [1, 2], 1e-9)
    A, centre = rng.normal(size=(3, 3)), rng.normal(size=3)
    found = UKF(alpha=alpha).transform(lambda x: x @ A.T, centre, np.diag([1.0, 2.0, 3.0]))
    assert_close(found[0], A @ centre, 1e-7)
    np.testing.assert_allclose(found[1], A @ np.diag([1.0, 2.0, 3.0]) @ A.T, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("setting", [{"alpha": 0.0}, {"alpha": -1.0}, {"kappa": -100.0}])
def test_a_transform_without_real_points_is_refused(setting: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="give a"):
        UKF(**setting).transform(lambda x: x, np.zeros(3), np.eye(3))


# --- Rows ---------------------------------------------------------------------------------------


def test_a_row_says_whether_its_method_has_converged() -> None:
    given = spec(robot=SMOOTH, payload="box-2kg", task="payload", simulation=LOOP, noise=NOISE,
                 signals=SIGNALS, excitation=SHORT, rate=100.0)  # fmt: skip
    short = {"use": "clie", "iterations": 1}
    wls, cut, full = executed(given, "wls", short, "huber")
    assert [row["status"] for row in (wls, cut, full)] == ["ok", "ok", "ok"]
    assert [row["converged"] for row in (wls, cut, full)] == [None, False, True]
    assert wls["simulations"] == full["simulations"] == 0
    assert cut["simulations"] == 2  # the start and the step
    assert cut["iterations"] == 1
    assert "limit of 1" in cut["stop"]
    assert cut["torque_error"] > 0


@pytest.mark.parametrize(
    ("fields", "wrong"),
    [
        ({"converged": False, "iterations": 3, "simulations": 7, "stop": "enough"}, ""),
        ({"iterations": True}, "iterations"),
    ],
    ids=str,
)
def test_a_plug_in_reports_its_convergence(fields: dict[str, Any], wrong: str) -> None:
    problem = noisy().problem

    class Own:
        def solve(self, problem: Any) -> Estimate:
            return Estimate(np.ones(problem.base.rank), **fields)

    found = identify(Own(), problem)
    assert found.status == ("failed" if wrong else "ok")
    assert wrong in found.reason
    if not wrong:
        assert {name: getattr(found, name) for name in fields} == fields
