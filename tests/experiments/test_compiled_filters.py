"""Compiled filters and steps along measured torques against their Python counterparts."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import EstimationError, SimulationError
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.identification.estimators.filters import UKF, JointFilter, joint_filter
from sysid_bench.identification.identify import identify
from sysid_bench.identification.simulation_based.compiled_filters import (
    filters_library,
    run_filter,
)
from sysid_bench.identification.simulation_based.forward_model import (
    SensitivityModel,
    StateSlopes,
    check_code,
    compiled_step,
    compiled_steps,
    start_state,
)
from sysid_bench.plugin_names import build
from sysid_bench.simulation.plant_batch import lanes_library
from sysid_bench.types import Array, Trajectory
from tests.experiments.experiment_world import RICH, SMOOTH, ready

pytestmark = pytest.mark.skipif(
    isinstance(lanes_library(), str) or filters_library() is None, reason="nothing is compiled"
)

LOOP = {"use": "closed-loop", "rate": "1 kHz", "substeps": 1}
SHORT = {"use": "fourier", "period": "0.5 s", "cycles": 1}
SIGNALS = {"filter": "butter 4 20 Hz zero-phase", "derivatives": "from q"}
CASES: dict[str, dict[str, Any]] = {
    "two hinges and a slide": {"robot": RICH, "terms": ()},
    "joint terms": {"robot": RICH},
    "a random tree": {"robot": "random:1"},
    "an arm": {"robot": SMOOTH},
    "a payload, friction known": {"robot": "ur5", "payload": "box-2kg", "task": "payload"},
}


@cache
def made(case: str) -> ExperimentData[SimulatedSource]:
    noise = {"q": 2e-6, "tau_relative": 0.02}
    return ready(
        simulation=LOOP, excitation=SHORT, rate=200.0, noise=noise, signals=SIGNALS, **CASES[case]
    )


def model(case: str, substeps: int = 2) -> JointFilter:
    return joint_filter(made(case).experiment, "A filter", substeps)


def with_friction(one: JointFilter) -> JointFilter:
    """The same filter as on a recording: columns that follow the motion, and joints that stand."""
    rng, measured = np.random.default_rng(3), one.measured_motion
    r = made_rank(one)
    columns = np.sort(rng.choice(r, 2, replace=False))
    friction = rng.normal(size=(len(measured), one.n, 2))
    standing = rng.random((len(measured), one.n)) < 0.5
    changed = replace(
        measured, columns=columns, friction=friction, standing=standing, jumps=columns
    )
    return replace(one, measured_motion=changed)


def made_rank(one: JointFilter) -> int:
    return int(one.experiment.problem.base.rank)


def subjects() -> Iterator[tuple[str, JointFilter]]:
    for case in CASES:
        yield case, model(case)
        yield f"{case}, standing", with_friction(model(case))


def states(one: JointFilter, count: int) -> Array:
    """Positions and rates of samples, and physical parameters near the prior."""
    problem, motion = one.experiment.problem, one.measured_motion.motion
    assert problem.prior is not None
    rng = np.random.default_rng(0)
    beta = problem.base.K @ problem.prior.theta
    betas = beta * (1 + 1e-3 * rng.normal(size=(count, len(beta))))
    at = rng.integers(0, len(motion), count)
    return np.hstack([motion.q[at], motion.v[at], betas])


def test_steps_and_their_derivatives_are_those_in_python() -> None:
    for name, one in subjects():
        steps = compiled_steps(one.forward, one.measured_motion)
        assert steps is not None, name
        x, n = states(one, 11), one.n
        moved, inverse = np.empty((len(x), 2 * n)), np.empty((n, n))
        check_code(steps.call("predict", len(x), 5, x, moved, inverse))
        expected = one.step(x, 5)[:, : 2 * n]
        np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
        at, beta = np.array([3, 8, 4]), x[0, 2 * n :]
        begin = start_state(x[:3, :n], x[:3, n : 2 * n], len(beta))
        found = compiled_step(steps, beta, begin, at)
        wanted = SensitivityModel(one.forward, one.measured_motion, beta).step(begin, at)
        assert_slopes_close(found, wanted)


def assert_slopes_close(found: StateSlopes, wanted: StateSlopes) -> None:
    """Finite differences carry rounding errors of the torque over their step, 1e-16 / 1e-6."""
    for name, atol in (("q", 1e-12), ("v", 1e-10), ("dq", 1e-8), ("dv", 1e-7)):
        a, b = getattr(found, name), getattr(wanted, name)
        np.testing.assert_allclose(a, b, rtol=0, atol=atol * max(1.0, np.abs(b).max()))


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize(("name", "share"), [("ekf", 1e-5), ("ukf", 1e-2)])
def test_a_compiled_filter_gives_the_estimate_of_the_one_in_python(
    name: str, share: float, case: str
) -> None:
    """In deviations; sigma points stand so near that Python's covariance loses eight digits."""
    data = made(case)
    found = identify(build("estimator", name), data.problem, data.experiment)
    plain = replace(data.experiment, forward=None)
    wanted = identify(build("estimator", name), data.problem, plain)
    assert found.beta is not None, found.reason
    assert found.covariance is not None
    assert wanted.covariance is not None
    std = np.sqrt(np.diag(wanted.covariance))
    assert (np.abs(found.beta - wanted.beta) <= share * std).all()
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), std, rtol=share)


def test_another_regressor_is_not_that_of_the_compiled_steps() -> None:
    one = model("an arm")

    def regress(motion: Trajectory) -> Iterator[Array]:
        for Y in one.experiment.regress(motion):
            yield 1.0001 * Y

    other = replace(one.experiment, regress=regress)
    forward = replace(one.forward, experiment=other)
    assert compiled_steps(one.forward, one.measured_motion) is not None
    assert compiled_steps(forward, one.measured_motion) is None


def test_singular_masses_divergence_and_indefinite_covariances_are_errors() -> None:
    one = model("an arm")
    steps, x = compiled_steps(one.forward, one.measured_motion), states(one, 1)
    n, moved = one.n, np.empty((1, 2 * one.n))
    nothing, far = x.copy(), x.copy()
    nothing[:, 2 * n :] = 0.0
    far[:, 0] = 2e6
    with pytest.raises(EstimationError, match="singular"):
        check_code(steps.call("predict", 1, 0, nothing, moved, None))
    with pytest.raises(SimulationError, match="diverges"):
        check_code(steps.call("predict", 1, 0, far, moved, None))
    P, noise = -np.eye(x.shape[1]), (one.q_noise, one.tau_noise)
    for unscented in (None, UKF().weights(x.shape[1])):
        with pytest.raises(EstimationError, match="positive definite"):
            run_filter(steps, one.q, noise, (x[0], P), unscented)
