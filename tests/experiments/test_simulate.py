"""The simulator of methods: true parameters reproduce the recording, others do not."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import EstimationError, UnsupportedError
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.types import Recording
from tests.experiments.experiment_world import (
    CLOSED_LOOP,
    RICH,
    SMOOTH,
    executed,
    ready,
    ready_once,
    smooth_loop,
    spec,
)

PLUGINS = "tests.experiments.plugins"
CASES: dict[str, dict[str, Any]] = {
    "UR5": {"robot": SMOOTH, "payload": "box-2kg"},
    "Coulomb friction": {"robot": "ur5"},
    "all terms": {"robot": RICH, "payload": "rod-1kg"},
    "only some are unknown": {"robot": RICH, "terms": ("viscous",)},
    "payload": {"robot": SMOOTH, "payload": "sphere-offset-1kg", "task": "payload"},
    "link": {"robot": RICH, "payload": "box-2kg", "task": "link"},
}


def gap(one: Recording, other: Recording) -> float:
    """The largest difference of two recordings, each signal relative to its maximum."""
    worst = 0.0
    for field in ("q", "v", "a", "tau"):
        ours, theirs = getattr(one, field), getattr(other, field)
        worst = max(worst, float(np.abs(ours - theirs).max() / np.abs(theirs).max()))
    return worst


@pytest.mark.parametrize("case", CASES)
def test_the_true_parameters_reproduce_the_recording(case: str) -> None:
    made = ready(simulation=CLOSED_LOOP, **CASES[case])
    simulated = made.experiment.simulate(made.source.truth.theta)
    np.testing.assert_array_equal(simulated.t, made.experiment.raw.t)
    assert gap(simulated, made.experiment.raw) <= 1e-9


def test_the_prior_moves_otherwise_and_stays_stable() -> None:
    made = smooth_loop()
    prior = made.problem.prior
    assert prior is not None
    simulated = made.experiment.simulate(prior.theta)
    raw = made.experiment.raw
    assert 1e-5 < np.abs(simulated.q - raw.q).max() < 0.1
    assert gap(simulated, raw) > 1e-3
    # Accelerations may jump: the prior has Coulomb friction where the robot has none.
    assert simulated.a is not None
    assert np.isfinite(simulated.a).all()
    for field in ("v", "tau"):
        ours, theirs = getattr(simulated, field), getattr(raw, field)
        assert np.abs(ours - theirs).max() < np.abs(theirs).max()


def test_a_simulation_knows_no_noise_and_is_the_same_twice() -> None:
    noise = {"q": 1e-4, "tau_relative": 0.01}
    noisy = ready(robot=RICH, simulation=CLOSED_LOOP, noise=noise)
    exact = ready(robot=RICH, simulation=CLOSED_LOOP)
    one, two = (noisy.experiment.simulate(noisy.source.truth.theta) for _ in range(2))
    for field in ("q", "v", "a", "tau"):
        np.testing.assert_array_equal(getattr(one, field), getattr(two, field))
    assert gap(one, exact.experiment.raw) <= 1e-9
    assert gap(noisy.experiment.raw, exact.experiment.raw) > 1e-4


def changed(made: ExperimentData[SimulatedSource], name: str, value: float) -> np.ndarray:
    theta = made.source.truth.theta.copy()
    theta[made.source.truth.parameters.index(name)] = value
    return theta


@pytest.mark.parametrize(
    ("name", "value"),
    [("forearm_link.m", -1.0), ("forearm_link.Ixx", -1.0), ("forearm_link.m", np.nan)],
)
def test_bodies_that_cannot_exist_cannot_be_simulated(name: str, value: float) -> None:
    made = smooth_loop()
    with pytest.raises(EstimationError, match="forearm_link"):
        made.experiment.simulate(changed(made, name, value))


@pytest.mark.parametrize("shape", [(), (3,), (1, 61)])
def test_theta_of_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(EstimationError, match="shape"):
        smooth_loop().experiment.simulate(np.ones(shape))


def test_without_a_controller_there_is_nothing_to_simulate() -> None:
    made = ready_once("ur5")
    with pytest.raises(UnsupportedError, match="controller"):
        made.experiment.simulate(made.source.truth.theta)


def test_parameters_that_no_motion_distinguishes_simulate_the_same() -> None:
    """Base parameters are all that matters: a null direction of K moves no joint."""
    made = ready(robot=RICH, simulation=CLOSED_LOOP)
    K, theta = made.problem.base.K, made.source.truth.theta
    step = np.random.default_rng(0).normal(size=len(theta)) * 1e-5
    null = step - np.linalg.lstsq(K, K @ step)[0]
    assert np.abs(null).max() > 1e-6
    assert np.abs(K @ null).max() < 1e-12
    moved = made.experiment.simulate(theta + null)
    assert gap(moved, made.experiment.raw) <= 1e-8


@pytest.mark.parametrize("noise", [{}, {"q": 1e-4, "tau_relative": 0.01}], ids=str)
def test_a_method_that_simulates_improves_on_its_start(noise: dict[str, float]) -> None:
    """DIDIM in twenty lines, as a plug-in, in a whole experiment; noise: the mean over draws."""
    made = spec(
        robot=SMOOTH, payload="box-2kg", task="payload", simulation=CLOSED_LOOP, noise=noise
    )
    ratios = []
    for repeat in range(3 if noise else 1):
        drawn = replace(made, repeat=repeat)
        prior, found = executed(drawn, f"{PLUGINS}:PriorMean", f"{PLUGINS}:Output")
        assert prior["status"] == found["status"] == "ok", found["reason"]
        assert prior["payload_error"] > 0.05
        assert found["stats"] == {"iterations": 8.0}
        for figure in ("payload_error", "torque_error"):
            assert noise or found[figure] < 1e-4
            ratios.append(found[figure] / prior[figure])
    assert np.exp(np.log(ratios).mean()) < 0.5


def test_without_a_controller_it_says_so() -> None:
    (row,) = executed(spec(), f"{PLUGINS}:Output")
    assert row["status"] == "unsupported"
    assert "controller" in row["reason"]
