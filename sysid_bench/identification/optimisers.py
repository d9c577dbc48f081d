"""Optimisers of costs that are simulated within a budget: CPU time, or a number of simulations.

The best point so far is the answer at any time. That at the end of a CPU time depends on the clock
and does not repeat bit for bit; that at the end of a number of simulations does."""

import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import wraps
from importlib import import_module
from typing import Any, Final, Protocol

import numpy as np

from sysid_bench.errors import (
    EstimationError,
    SimulationError,
    SysidBenchError,
    UnsupportedError,
    UsageError,
)
from sysid_bench.types import Array, Experiment, Recording
from sysid_bench.units import quantity

_COUNT = re.compile(r"\s*(\d+)\s+simulations?\s*")


class BudgetError(SysidBenchError):
    """The budget is spent: the best answer so far is the answer."""


@dataclass(frozen=True)
class Budget:
    """Most CPU seconds, or most simulations; None: not limited."""

    seconds: float | None = None
    simulations: int | None = None

    def __str__(self) -> str:
        """Return the budget in words."""
        if self.simulations is not None:
            return f"{self.simulations} simulations"
        return "no limit" if self.seconds is None else f"{self.seconds:g} s of CPU time"


def parse_budget(text: str | None) -> Budget:
    """Return the budget of a text, "10 s" of CPU time or "500 simulations"; None: no limit.

    Raises UsageError for another text, and for a budget that is not positive.
    """
    if text is None:
        return Budget()
    try:
        count = _COUNT.fullmatch(text)
        budget = Budget(simulations=int(count[1])) if count else Budget(quantity(text, "s"))
    except (TypeError, UsageError) as error:
        raise UsageError(_wrong(text)) from error
    if not (budget.seconds or budget.simulations or 0) > 0:
        raise UsageError(_wrong(text))
    return budget


def _wrong(text: object) -> str:
    return f"budget = {text!r}: write a CPU time, '10 s', or a number, '500 simulations'."


@dataclass(eq=False)
class BudgetUse:
    """CPU time and simulations that a method has used since the meter was made."""

    budget: Budget
    simulations: int = 0
    began: float = field(default_factory=time.process_time)

    def count(self) -> None:
        """Count a simulation that is about to run; raises BudgetError where there is none left."""
        seconds, most = self.budget.seconds, self.budget.simulations
        # CPU time of this process: what others on the machine do spends nothing of the budget.
        late = seconds is not None and time.process_time() - self.began >= seconds
        if late or (most is not None and self.simulations >= most):
            raise BudgetError(f"the budget of {self.budget}")
        self.simulations += 1

    def with_count(self, simulate: Callable[..., Any]) -> Callable[..., Any]:
        """Return a simulation that counts its calls, and the candidates of `simulate_many`."""

        @wraps(simulate)
        def counted(*arguments: Any) -> Any:
            self.count()
            return simulate(*arguments)

        def many(thetas: Sequence[Array]) -> Iterator[SimulatedRecording]:
            outcomes = simulate_many(simulate, thetas)
            for _ in thetas:
                self.count()
                yield next(outcomes)

        vars(counted)["many"] = many
        return counted


SimulatedRecording = Recording | EstimationError | SimulationError
"""Recording of a candidate, or why it cannot be simulated."""


def one_by_one(function: Callable[[Array], Any], points: Sequence[Array]) -> Iterator[Any]:
    """Yield the value of a function at each point, or its EstimationError or SimulationError."""
    for x in points:
        try:
            yield function(x)
        except (EstimationError, SimulationError) as error:
            yield error


def simulate_many(
    simulate: Callable[..., Recording], thetas: Sequence[Array]
) -> Iterator[SimulatedRecording]:
    """Return the recordings of many candidates theta (p,), or their errors, in order; at once where
    the simulation has the function `many`."""
    many = getattr(simulate, "many", None)
    return one_by_one(simulate, thetas) if many is None else iter(many(thetas))


FAR: Final = 1e3
"""Residual of a point that cannot be simulated, in units of the largest residual of the start."""

STEP: Final = 1e-4
"""Finite-difference step of methods that need derivatives: simulations are exact to about 1e-8."""


Residuals = Array | EstimationError | SimulationError
"""Residuals (M,) of a point, or why it has none."""


@dataclass(frozen=True, eq=False)
class SimulatedCost:
    """|residuals(x)|^2, residuals (M,), of x (d,) between the bounds `low` and `high` (d,), from
    `start` (d,). The residuals raise EstimationError or SimulationError where x has none; `many`
    yields those of each of several x, or its error."""

    residuals: Callable[[Array], Array]
    start: Array
    low: Array
    high: Array
    many: Callable[[Sequence[Array]], Iterator[Residuals]] | None = None


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

        Raises BudgetError where the budget is spent.
        """
        return next(self.evaluate_many([x]))

    def evaluate_many(self, points: Sequence[Array]) -> Iterator[Array]:
        """Yield the residuals (M,) at each point (d,), as `evaluate`."""
        many = self.cost.many
        outcomes = one_by_one(self.cost.residuals, points) if many is None else many(points)
        for x in points:
            self.meter.count()
            found = next(outcomes)
            if not isinstance(found, np.ndarray):
                # A wall of finite height: an optimiser of squares turns back at it, and would stop
                # at infinity.
                yield np.full_like(self.residuals, FAR * max(np.abs(self.residuals).max(), 1e-9))
                continue
            value = float(found @ found)
            if value < self.value:
                self.best, self.residuals, self.value = x.copy(), found, value
            yield found


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
    # Backwards at the upper bound, beyond which there may be nothing to simulate.
    steps = np.where(x + STEP <= search.cost.high, STEP, -STEP)
    found = search.evaluate_many(x + np.diag(steps))
    return np.stack(
        [(column - residuals) / step for column, step in zip(found, steps, strict=True)], axis=1
    )


def load_optimiser(name: str) -> Any:
    """Return a module of the extra `peers`; UnsupportedError where it is not installed."""
    try:
        return import_module(name)
    except ImportError as error:
        raise UnsupportedError(
            f"This method needs {name}: pip install 'sysid-bench[peers]'."
        ) from error


@dataclass(frozen=True)
class LeastSquares:
    """`scipy.optimize.least_squares`, method "trf" (Branch, Coleman, Li 1999), with its default
    tolerances, columns scaled by the Jacobian, and forward differences."""

    def run(self, search: Search) -> SearchStatus:
        """Search from the start."""
        cost, last = search.cost, [search.cost.start, search.residuals]

        def residuals(x: Array) -> Array:
            # SciPy asks for the start again, which is known.
            if not np.array_equal(x, last[0]):
                last[:] = x.copy(), search.evaluate(x)
            return last[1]

        def jacobian(x: Array) -> Array:
            return residual_jacobian(search, x, residuals(x))

        from scipy.optimize import least_squares  # 0.1 s that linear methods need not wait for

        found = least_squares(
            residuals, cost.start, jacobian, (cost.low, cost.high), x_scale="jac", method="trf"
        )
        return SearchStatus(bool(found.status > 0), str(found.message).rstrip("."))


def with_budget(experiment: Experiment, budget: str | None) -> Experiment:
    """Return an experiment whose simulation raises BudgetError after a budget, "10 s" of CPU time
    from now on, or "500 simulations"; None: no limit. Raises UsageError for another text."""
    if budget is None:
        return experiment
    return replace(
        experiment, simulate=BudgetUse(parse_budget(budget)).with_count(experiment.simulate)
    )
