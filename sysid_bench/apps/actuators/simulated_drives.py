"""Actuators fitted to simulated positions by a general optimiser, as other tools do it.

The simulation, the parameters and their split are those of the bounded linear fit; the optimisers
and their budgets those of methods that simulate.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.apps.actuators.rollout import Drives, simulated_positions
from sysid_bench.identification.optimisers import (
    BudgetUse,
    Optimiser,
    SearchResult,
    SimulatedCost,
    parse_budget,
    run_search,
)
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.position_control import Commands
from sysid_bench.types import Array

UNIT: Final = np.array([0.01, 0.1, 0.1, 0.5])
"""Coordinate 1 of armature, viscous and Coulomb friction and offset (SI units)."""

LOW: Final = np.array([0.0, 0.0, 0.0, -20.0])
HIGH: Final = np.array([20.0, 20.0, 50.0, 20.0])
"""Bounds of the coordinates: no negative armature or friction, and far beyond those of legs."""


@dataclass(frozen=True, eq=False)
class SimulatedDrives:
    """The best drives that a search has simulated, the indices of the values on a bound (k, 4),
    and how the search ended."""

    drives: Drives
    at_bound: Array
    optimum: SearchResult


@dataclass(frozen=True, eq=False)
class SimulatedPart:
    """A section `rows` of recorded commands that is simulated from its first state."""

    robot: RobotModel
    commands: Commands
    rows: slice

    def fit(self, optimiser: Optimiser, start: Drives, budget: str | None) -> SimulatedDrives:
        """Return the drives of least squared position error, from a `start` whose delay is kept,
        within a budget, "10 s" of CPU time or "500 simulations" (None: no limit).

        Raises SimulationError where the start cannot be simulated, UsageError for another budget.
        """
        k = len(start.joints)
        low, high = (np.tile(x, k) for x in (LOW, HIGH))
        first = np.clip((start.values / UNIT).ravel(), low, high)

        def drives(x: Array) -> Drives:
            return Drives(start.joints, x.reshape(k, 4) * UNIT, start.delay)

        def residuals(x: Array) -> Array:
            return self._error(drives(x))

        found = run_search(
            optimiser, SimulatedCost(residuals, first, low, high), BudgetUse(parse_budget(budget))
        )
        near = 1e-3 * (high - low)
        at_bound = (found.x <= low + near) | (found.x >= high - near)
        return SimulatedDrives(drives(found.x), at_bound.reshape(k, 4), found)

    def _error(self, drives: Drives) -> Array:
        """Position errors, over the root of their number: the cost is their mean square."""
        simulated = simulated_positions(self.robot, drives, self.commands, self.rows)
        error = simulated - self.commands.q[self.rows]
        return np.asarray(error.ravel() / np.sqrt(error.size))
