"""Derivatives that methods integrate beside a simulation, against finite differences."""

from functools import cache
from typing import Any

import numpy as np
import pytest

from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.identification.estimators.closed_loop import OutputError, output_error
from sysid_bench.identification.simulation_based.forward_model import (
    AccelerationModel,
    SensitivityModel,
    start_state,
)
from sysid_bench.identification.simulation_based.gauss_newton import (
    GaussNewton,
    Model,
    rows_of,
    simulatable_start,
    step_rms,
)
from sysid_bench.identification.simulation_based.measured_motion import measured_motion
from sysid_bench.identification.simulation_based.tracking_sensitivity import (
    TrackingSensitivity,
    has_sensitivity,
)
from sysid_bench.types import Array, Experiment, Recording
from tests.experiments.experiment_world import RICH, SMOOTH, ready

ROBOTS = (RICH, "random:1", "scara")
WITHOUT_COULOMB = (RICH, SMOOTH)
NOISE = {"q": 1e-5, "tau_relative": 0.01}


def torques(experiment: Experiment, recording: Recording) -> Array:
    return rows_of(experiment, recording.tau)


def positions(_: Experiment, recording: Recording) -> Array:
    return recording.q


SIGNALS = {"torques": torques, "positions": positions}


@cache
def made(robot: str) -> ExperimentData[SimulatedSource]:
    return ready(
        robot=robot,
        rate=100.0,
        noise=NOISE,
        simulation={"use": "closed-loop", "rate": "1 kHz"},
        excitation={"use": "fourier", "period": "2 s", "cycles": 1},
        signals={"filter": "butter 4 20 Hz zero-phase", "derivatives": "from q"},
    )


def states_of(
    robot: str, seed: int
) -> tuple[AccelerationModel, Array, Array, Array, tuple[Any, Any]]:
    """A model with beta (4, r), q, v and torques (4, n) of four states."""
    experiment = made(robot).experiment
    K, prior = experiment.problem.base.K, experiment.problem.prior
    assert prior is not None
    n, rng = len(experiment.raw.rows), np.random.default_rng(seed)
    beta = (K @ prior.theta) * (1 + 0.01 * rng.standard_normal((4, len(K))))
    q, v, one, two = rng.uniform(-1.0, 1.0, (4, 4, n))
    return AccelerationModel(experiment, 0.002), beta, q, v, (one, two)


@pytest.mark.parametrize("robot", ROBOTS)
def test_states_step_together_as_each_alone(robot: str) -> None:
    model, beta, q, v, tau = states_of(robot, 0)
    q[2], v[2] = q[0], v[0]  # as sigma points that differ in beta
    together = model.step(beta, q, v, tau)
    for k in range(4):
        part = slice(k, k + 1)
        alone = model.step(beta[part], q[part], v[part], (tau[0][part], tau[1][part]))
        for all_of_them, one in zip(together, alone, strict=True):
            np.testing.assert_allclose(all_of_them[part], one, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("robot", [RICH, SMOOTH, "random:1"])
def test_a_step_has_the_derivatives_of_its_differences(robot: str) -> None:
    forward, beta, *_ = states_of(robot, 1)
    measured, at = measured_motion(forward.experiment), np.array([3])
    q, v = measured.motion.q[at], measured.motion.v[at]
    n, beta = q.shape[1], beta[:1]

    def after(change: Array) -> Array:
        state = (q + change[:n], v + change[n : 2 * n])
        following = forward.along(measured, at, beta + change[2 * n :], state)
        return np.asarray(np.concatenate(following, axis=1)[0])

    x = SensitivityModel(forward, measured, beta[0]).step(start_state(q, v, beta.shape[1]), at)
    slopes = np.concatenate([x.dq[0], x.dv[0]])
    sizes = np.concatenate([np.full(2 * n, 1e-5), 1e-4 * (np.abs(beta[0]) + 1e-3)])
    for j, size in enumerate(sizes):
        change = size * np.eye(len(sizes))[j]
        difference = (after(change) - after(-change)) / (2 * size)
        assert np.linalg.norm(slopes[:, j] - difference) <= 1e-5 * (1 + np.linalg.norm(difference))


@pytest.mark.parametrize("robot", WITHOUT_COULOMB)
def test_the_closed_loop_has_nearly_the_derivatives_of_its_differences(robot: str) -> None:
    """To 2 %: torques that motors hold are not in the equations."""
    experiment = made(robot).experiment
    assert has_sensitivity(experiment)
    simulatable, start = simulatable_start(experiment)
    for k, signal in enumerate(SIGNALS.values()):
        model = OutputError(experiment, simulatable, signal)
        trial = model.evaluate(start)
        assert trial.recording is not None
        slopes = TrackingSensitivity(experiment, trial.recording, trial.beta).jacobian()
        differences = model.jacobian(trial)
        size = np.sqrt((differences**2).mean(axis=(0, 2)))[:, None]
        columns = np.linalg.norm(differences / size, axis=(0, 1))
        wrong = np.linalg.norm((slopes[1 - k] - differences) / size, axis=(0, 1)) / columns
        assert np.median(wrong) <= 0.02


@pytest.mark.parametrize("signal", SIGNALS)
@pytest.mark.parametrize("robot", ROBOTS)
def test_the_answer_is_that_of_finite_differences_alone(robot: str, signal: str) -> None:
    """Both stop at a step below 0.1 standard deviations."""
    experiment = made(robot).experiment
    simulatable, start = simulatable_start(experiment)
    plain = OutputError(experiment, simulatable, SIGNALS[signal])
    models: tuple[Model, Model] = plain, output_error(experiment, simulatable, SIGNALS[signal])
    alone, quick = (GaussNewton(20).run(model, simulatable, start) for model in models)
    assert alone.converged
    assert quick.converged
    assert alone.covariance is not None
    assert alone.beta is not None
    assert quick.beta is not None
    R = np.linalg.inv(np.linalg.cholesky(alone.covariance))
    assert step_rms(R, quick.beta - alone.beta) <= 0.2
