"""A simulated cost within a budget: its best point so far is the answer at any time."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final, Protocol

import numpy as np

from sysid_bench.errors import EstimationError, SimulationError, UnsupportedError
from sysid_bench.identification.optimisers.budget import BudgetError, BudgetUse
from sysid_bench.types import Array

FAR: Final = 1e3
"""Residual of a point that cannot be simulated, in units of the largest residual of the start."""

STEP: Final = 1e-4
"""Finite-difference step of methods that need derivatives: simulations are exact to about 1e-8."""


@dataclass(frozen=True, eq=False)
class SimulatedCost:
    """|residuals(x)|^2, residuals (M,), of x (d,) between the bounds `low` and `high` (d,), from
    `start` (d,). The residuals raise EstimationError or SimulationError where x has none."""

    residuals: Callable[[Array], Array]
    start: Array
    low: Array
    high: Array


@dataclass(eq=False)
class Search:
    """Evaluations of a cost: the best x (d,) so far, its cost, and the iterations of the method."""

    cost: SimulatedCost
    meter: BudgetUse
    best: Array
    residuals: Array
    value: float
    iterations: int = 0

    def evaluate(self, x: Array) -> Array:
        """Return the residuals (M,) at x (d,), large ones where it cannot be simulated.

        Raises BudgetError where the budget is.
        """
        self.meter.count()
        try:
            found = self.cost.residuals(x)
        except (EstimationError, SimulationError):
            return np.full_like(self.residuals, FAR * max(np.abs(self.residuals).max(), 1e-9))
        value = float(found @ found)
        if value < self.value:
            self.best, self.residuals, self.value = x.copy(), found, value
        return found


@dataclass(frozen=True)
class SearchStatus:
    """The end of a search: whether the method has converged, and the reason."""

    converged: bool
    reason: str


class Optimiser(Protocol):
    """A method that evaluates a search until it stops by itself."""

    def run(self, search: Search) -> SearchStatus:
        """Search from the start of the cost, and count iterations in the search."""
        ...


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The best point (d,) of a search, its cost and that of the start, and how the search ended."""

    x: Array
    value: float
    start_value: float
    stop: SearchStatus
    iterations: int
    simulations: int


def run_search(optimiser: Optimiser, cost: SimulatedCost, meter: BudgetUse) -> SearchResult:
    """Return the best point that an optimiser finds within what a meter leaves.

    Raises EstimationError or SimulationError where the start cannot be simulated.
    """
    meter.count()
    first = cost.residuals(cost.start)
    start = float(first @ first)
    search = Search(cost, meter, cost.start, first, start)
    try:
        stop = optimiser.run(search)
    except BudgetError as spent:
        stop = SearchStatus(False, str(spent))
    return SearchResult(
        search.best, search.value, start, stop, search.iterations, meter.simulations
    )


def residual_jacobian(search: Search, x: Array, residuals: Array) -> Array:
    """Return the derivative (M, d) of the residuals (M,) at x (d,), with steps between the
    bounds."""
    search.iterations += 1
    columns = []
    for i in range(len(x)):
        step = STEP if x[i] + STEP <= search.cost.high[i] else -STEP
        further = x.copy()
        further[i] += step
        columns.append((search.evaluate(further) - residuals) / step)
    return np.stack(columns, axis=1)


def load_optimiser(name: str) -> Any:
    """Return a module of the extra `peers`; UnsupportedError where it is not installed."""
    try:
        return import_module(name)
    except ImportError as error:
        raise UnsupportedError(
            f"This method needs {name}: pip install 'sysid-bench[peers]'."
        ) from error
