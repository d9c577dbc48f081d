"""Methods that simulate within a budget: exact recovery, and the last accepted iterate."""

from functools import cache
from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.identification.identify import identify
from sysid_bench.plugin_names import build
from sysid_bench.types import Array, Estimate
from tests.closeness import assert_close
from tests.experiments.experiment_world import dense, ready

PEERS = ("scipy-least-squares", "mujoco-sysid", "cma-es")
SIMULATING = (*PEERS, "cloe", "clie", "didim")
PENDULUM = "example-robot-data:double_pendulum_description/urdf/double_pendulum_continuous.urdf"


@cache
def pendulum() -> ExperimentData[Any]:
    """A noise-free closed loop of two links, from a prior that is 20 % off."""
    return ready(
        robot=PENDULUM,
        excitation={"use": "fourier", "period": "2 s", "cycles": 1},
        simulation={"use": "closed-loop", "rate": "200 Hz", "substeps": 1},
    )


def answer(name: str, **settings: Any) -> Estimate:
    made = pendulum()
    found = identify(build("estimator", {"use": name, **settings}), made.problem, made.experiment)
    if found.status == "unsupported":
        pytest.skip(found.reason)
    assert found.status == "ok", found.reason
    return found


def error_of(found: Estimate) -> float:
    """Error of the predicted torques, relative."""
    W, b = dense(pendulum().problem)
    return float(np.linalg.norm(W @ beta_of(found) - b) / np.linalg.norm(b))


def beta_of(found: Estimate) -> Array:
    beta = found.beta if found.theta is None else pendulum().problem.base.K @ found.theta
    assert beta is not None
    return beta


def prior_of() -> Array:
    problem = pendulum().problem
    assert problem.prior is not None
    return np.asarray(problem.base.K @ problem.prior.theta)


@pytest.mark.parametrize(
    ("name", "most", "limit"),
    [
        ("scipy-least-squares", 80, 1e-3),
        ("mujoco-sysid", 80, 1e-3),
        pytest.param("cma-es", 1500, 1e-3, marks=pytest.mark.long),
    ],
)
def test_peers_recover_a_pendulum_without_noise(name: str, most: int, limit: float) -> None:
    found = answer(name, budget=f"{most} simulations")
    assert error_of(found) < limit
    assert error_of(Estimate(prior_of())) > 0.05


@pytest.mark.parametrize("name", SIMULATING)
@pytest.mark.parametrize("most", [1, 12])
def test_the_end_of_a_budget_is_an_answer(name: str, most: int) -> None:
    found = answer(name, budget=f"{most} simulations")
    assert found.simulations is not None
    assert found.simulations <= most
    assert found.converged or f"{most} simulation" in found.stop or "limit" in found.stop
    if not found.iterations and name not in PEERS:
        assert found.beta is not None
        assert_close(found.beta, prior_of(), 1e-6)


@pytest.mark.parametrize("name", SIMULATING)
def test_answers_at_a_number_of_simulations_repeat(name: str) -> None:
    one, other = (answer(name, budget="9 simulations") for _ in range(2))
    assert np.array_equal(beta_of(one), beta_of(other))


@pytest.mark.parametrize("name", PEERS)
def test_clock_dependent_answers_are_marked(name: str) -> None:
    assert answer(name, budget="0.02 s").stats["clock_dependent"] == 1.0
    assert answer(name, budget="5 simulations").stats["clock_dependent"] == 0.0


@pytest.mark.parametrize("name", PEERS)
def test_positions_can_be_compared(name: str) -> None:
    assert answer(name, signal="position", budget="30 simulations").stats["cost_ratio"] < 0.9


@pytest.mark.parametrize("name", SIMULATING)
def test_wrong_budgets_are_refused_at_once(name: str) -> None:
    with pytest.raises(UsageError, match="500 simulations"):
        build("estimator", {"use": name, "budget": "ten seconds"})


@pytest.mark.parametrize("name", PEERS)
def test_unknown_signals_are_refused_at_once(name: str) -> None:
    with pytest.raises(UsageError, match="torque"):
        build("estimator", {"use": name, "signal": "current"})
