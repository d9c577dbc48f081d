"""Optimisers find minima, keep their budgets and answer at any time."""

import time
from collections.abc import Callable
from typing import Final

import numpy as np
import pytest

from sysid_bench.apps.peers.optimisers import CmaEs, MujocoSysid
from sysid_bench.errors import SimulationError, UnsupportedError, UsageError
from sysid_bench.identification.optimisers import (
    Budget,
    BudgetUse,
    LeastSquares,
    Optimiser,
    SimulatedCost,
    parse_budget,
    run_search,
)
from sysid_bench.types import Array

OPTIMISERS: Final[dict[str, Optimiser]] = {
    "scipy": LeastSquares(),
    "cma": CmaEs(),
    "mujoco.sysid": MujocoSysid(),
}


@pytest.fixture(params=OPTIMISERS)
def optimiser(request: pytest.FixtureRequest) -> Optimiser:
    """An optimiser that is installed."""
    found = OPTIMISERS[request.param]
    try:
        run_search(found, quadratic(np.zeros(2)), BudgetUse(Budget(simulations=3)))
    except UnsupportedError as error:
        pytest.skip(str(error))
    return found


def quadratic(at: Array) -> SimulatedCost:
    """Curved residuals with one zero, at a point between bounds of +- 1; the start is 0."""
    d = len(at)
    A = np.random.default_rng(d).standard_normal((3 * d, d))

    def residuals(x: Array) -> Array:
        return np.asarray(np.concatenate([A @ (x - at), np.expm1(x - at)]))

    return SimulatedCost(residuals, np.zeros(d), np.full(d, -1.0), np.full(d, 1.0))


@pytest.mark.parametrize("d", [1, 2, 6])
def test_a_minimum_is_found(optimiser: Optimiser, d: int) -> None:
    at = np.random.default_rng(d).uniform(-0.5, 0.5, d)
    found = run_search(optimiser, quadratic(at), BudgetUse(Budget()))
    assert found.stop.converged
    assert np.abs(found.x - at).max() < 1e-5
    # One column of differences looks like one point.
    assert found.iterations > 0 or d == 1


def test_a_minimum_outside_the_bounds_is_found_on_them(optimiser: Optimiser) -> None:
    cost = SimulatedCost(
        lambda x: np.asarray(x - np.array([3.0, 0.2])), np.zeros(2), -np.ones(2), np.ones(2)
    )
    found = run_search(optimiser, cost, BudgetUse(Budget(simulations=2000)))
    assert found.x == pytest.approx([1.0, 0.2], abs=1e-4)
    assert (np.abs(found.x) <= 1.0).all()


@pytest.mark.parametrize("most", [1, 2, 7, 23])
def test_a_number_of_simulations_is_kept_and_repeats(optimiser: Optimiser, most: int) -> None:
    at = np.full(4, 0.3)
    points: list[tuple[float, ...]] = []

    def recorded(x: Array) -> Array:
        points.append(tuple(x))
        return quadratic(at).residuals(x)

    cost = SimulatedCost(recorded, np.zeros(4), -np.ones(4), np.ones(4))
    found = run_search(optimiser, cost, BudgetUse(Budget(simulations=most)))
    assert found.simulations == len(points) == most
    assert not found.stop.converged
    assert str(most) in found.stop.reason
    values = [float(np.sum(quadratic(at).residuals(np.array(x)) ** 2)) for x in points]
    assert found.value == pytest.approx(min(values))
    assert found.value == pytest.approx(np.sum(quadratic(at).residuals(found.x) ** 2))
    again = run_search(optimiser, quadratic(at), BudgetUse(Budget(simulations=most)))
    assert np.array_equal(again.x, found.x)


def test_a_cpu_time_ends_a_search_that_would_go_on(optimiser: Optimiser) -> None:
    def slow(x: Array) -> Array:
        end = time.process_time() + 2e-3
        while time.process_time() < end:
            pass
        return np.concatenate([[10.0 * (x[1] - x[0] ** 2)], 1 - x])

    cost = SimulatedCost(slow, np.array([-1.2, 1.0]), np.full(2, -3.0), np.full(2, 3.0))
    found = run_search(optimiser, cost, BudgetUse(Budget(seconds=0.02)))
    assert not found.stop.converged
    assert 1 <= found.simulations <= 11
    assert "CPU" in found.stop.reason


def test_points_that_cannot_be_simulated_are_left(optimiser: Optimiser) -> None:
    def residuals(x: Array) -> Array:
        if x[0] > 0.5:
            raise SimulationError("diverged")
        return np.asarray(x - np.array([0.4, -0.2]))

    cost = SimulatedCost(residuals, np.zeros(2), -np.ones(2), np.ones(2))
    found = run_search(optimiser, cost, BudgetUse(Budget(simulations=1000)))
    assert found.x == pytest.approx([0.4, -0.2], abs=1e-3)


def test_a_start_that_cannot_be_simulated_is_an_error() -> None:
    def residuals(x: Array) -> Array:
        raise SimulationError("diverged")

    cost = SimulatedCost(residuals, np.zeros(1), -np.ones(1), np.ones(1))
    with pytest.raises(SimulationError, match="diverged"):
        run_search(LeastSquares(), cost, BudgetUse(Budget()))


@pytest.mark.parametrize(
    ("text", "budget"),
    [
        ("10 s", Budget(10.0)),
        ("2 min", Budget(120.0)),
        ("500 simulations", Budget(simulations=500)),
        (" 1 simulation", Budget(simulations=1)),
        (None, Budget()),
    ],
)
def test_budgets_are_read(text: str | None, budget: Budget) -> None:
    assert parse_budget(text) == budget


@pytest.mark.parametrize(
    "text", ["", "10 kg", "-1 s", "0 s", "0 simulations", "1.5 simulations", "s", 5, "nan s"]
)
def test_other_budgets_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="500 simulations"):
        parse_budget(text)


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> Callable[..., None]:
        raise ImportError(name)

    monkeypatch.setattr("sysid_bench.identification.optimisers.import_module", missing)
    for name in ("cma", "mujoco.sysid"):
        with pytest.raises(UnsupportedError, match=r"pip install 'sysid-bench\[peers\]'"):
            run_search(OPTIMISERS[name], quadratic(np.zeros(2)), BudgetUse(Budget()))
