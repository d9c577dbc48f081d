"""Closed-loop simulations fitted by a general optimiser within a budget.

All of them search the same coordinates, from the same start, with the same candidate simulator and
the same cost. A point is a combination of the log-Cholesky coordinates (Rucker and Wensing 2022)
that changes the base parameters, so that every point has bodies that can exist."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.apps.peers.optimisers import CmaEs, MujocoSysid
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.identification.feasibility.cholesky_coordinates import Coordinates, coordinates
from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.identification.optimisers import (
    BudgetUse,
    LeastSquares,
    Optimiser,
    Residuals,
    SimulatedCost,
    parse_budget,
    run_search,
    simulate_many,
)
from sysid_bench.identification.simulation_based.gauss_newton import rows_of, simulatable_start
from sysid_bench.types import Array, Estimate, Experiment, Recording

SIGNALS: Final = ("torque", "position")

REACH: Final = 3.0
"""Bound of every coordinate, on either side of the start: a mass may change by a factor of 20."""


@dataclass(frozen=True)
class SimulatedFit(ABC):
    """Base of the peers: `budget`, "10 s" of CPU time or "500 simulations" (None: no limit), and
    the compared `signal`, "torque" or "position"."""

    budget: str | None = "10 s"
    signal: str = "torque"

    @property
    @abstractmethod
    def optimiser(self) -> Optimiser:
        """The optimiser of the cost."""

    def __post_init__(self) -> None:
        """Raise UsageError for a budget or a signal that there is not."""
        parse_budget(self.budget)
        if self.signal not in SIGNALS:
            raise unknown_name("signal", self.signal, SIGNALS)

    def fit(self, experiment: Experiment) -> Estimate:
        """Return the best theta that was simulated within the budget, at worst the start.

        Raises UnsupportedError where the recording declares no controller, or the optimiser is not
        installed; SimulationError where the start cannot be simulated.
        """
        budget = parse_budget(self.budget)
        meter = BudgetUse(budget)
        _, start = simulatable_start(experiment)
        problem = experiment.problem
        feasible = feasible_set_of(problem)
        chart = coordinates(feasible, start / feasible.scale)
        slopes = (problem.base.K * feasible.scale) @ chart.jacobian(chart.eta0)
        r = problem.base.rank
        if r == 0:
            raise UsageError("No parameter of this problem is identifiable: nothing to fit.")
        # The row space of d beta / d eta: moves along all other coordinates change no torque, and
        # would cost simulations in vain. Unit rows leave it, and make its basis accurate.
        size = np.linalg.norm(slopes, axis=1, keepdims=True)
        _, _, Vt = np.linalg.svd(slopes / np.where(size > 0, size, 1.0), full_matrices=False)
        candidates = Candidates(experiment, chart, Vt[:r].T, self.signal)
        found = run_search(self.optimiser, candidates.cost, meter)
        return Estimate(
            theta=candidates.parameters(found.x),
            stats={
                "cost_ratio": found.value / found.start_value if found.start_value > 0 else 1.0,
                "at_bound": float((np.abs(found.x) >= 0.999 * REACH).sum()),
                "clock_dependent": float(budget.seconds is not None and not found.stop.converged),
            },
            converged=found.stop.converged,
            iterations=found.iterations,
            simulations=found.simulations,
            stop=found.stop.reason,
        )


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidates x (r,) of an experiment: eta = eta0 + directions x, directions (p, r)."""

    experiment: Experiment
    chart: Coordinates
    directions: Array
    signal: str

    def parameters(self, x: Array) -> Array:
        """Return the parameters (p,) of a candidate."""
        chart = self.chart
        return np.asarray(chart.feasible.scale * chart.x(chart.eta0 + self.directions @ x))

    @property
    def cost(self) -> SimulatedCost:
        """Mean square of measured minus simulated signal, channels in units of their RMS."""
        r = self.directions.shape[1]
        low, high = np.full(r, -REACH), np.full(r, REACH)
        return SimulatedCost(self._residuals, np.zeros(r), low, high, self._residuals_of_many)

    @cached_property
    def _measured(self) -> Array:
        return self._of(self.experiment.raw)

    @cached_property
    def _size(self) -> Array:
        measured = self._measured
        if self.signal == "position":
            # About the mean: a joint far from zero would count for nothing.
            measured = measured - measured.mean(axis=0)
        size = np.sqrt((measured**2).mean(axis=0))
        return np.asarray(np.where(size > 0, size, 1.0) * np.sqrt(measured.size))

    def _residuals(self, x: Array) -> Array:
        (found,) = self._residuals_of_many([x])
        if isinstance(found, np.ndarray):
            return found
        raise found

    def _residuals_of_many(self, points: Sequence[Array]) -> Iterator[Residuals]:
        # Exponentials of a far candidate may overflow; it then cannot be simulated, which has a
        # cost.
        with np.errstate(over="ignore", invalid="ignore"):
            thetas = [self.parameters(x) for x in points]
        for outcome in simulate_many(self.experiment.simulate, thetas):
            if isinstance(outcome, Recording):
                yield ((self._measured - self._of(outcome)) / self._size).ravel()
            else:
                yield outcome

    def _of(self, recording: Recording) -> Array:
        """The compared signal (N, channels)."""
        if self.signal == "position":
            return recording.q
        return rows_of(self.experiment, recording.tau)


@dataclass(frozen=True)
class FitScipy(SimulatedFit):
    """min sum ((x - x_s(theta)) / RMS(x))^2 by `scipy.optimize.least_squares` (Branch, Coleman, Li
    1999), x_s the `signal` "torque" or "position" of the simulated closed loop.

    Coordinates, start and simulator as all peers (SimulatedFit); forward differences, r
    simulations per Jacobian. Stops by SciPy's default tolerances, or at the end of the `budget`,
    "10 s" of CPU time or "500 simulations" (None: no limit): then the best candidate simulated is
    the answer, `converged` is false, and that of a CPU time depends on the clock. It has no
    covariance. Assumes the controller as declared.
    """

    @property
    def optimiser(self) -> Optimiser:
        """The optimiser, with its default tolerances."""
        return LeastSquares()


@dataclass(frozen=True)
class FitCmaEs(SimulatedFit):
    """min sum ((x - x_s(theta)) / RMS(x))^2 by the covariance matrix adaptation evolution strategy
    (Hansen 2016, package `cma`, extra `peers`), x_s the `signal` "torque" or "position" of the
    simulated closed loop.

    Coordinates, start and simulator as all peers (SimulatedFit), without derivatives: 4 + 3 ln
    r simulations per generation. `sigma` is the first deviation of every coordinate; 0.1 is about
    10 % of a mass. Stops by the package's default tolerances, or at the end of the `budget`, "10 s"
    of CPU time or "500 simulations" (None: no limit): then the best candidate simulated is the
    answer, `converged` is false, and that of a CPU time depends on the clock. It has no covariance.
    Assumes the controller as declared.
    """

    sigma: float = 0.1
    seed: int = 1

    def __post_init__(self) -> None:
        """Raise UsageError for a budget or a signal that there is not, a sigma that is not
        positive, or a seed below 1."""
        super().__post_init__()
        if not (self.sigma > 0 and self.seed >= 1):
            raise UsageError("sigma is a positive number, and seed a whole number of 1 or more.")

    @property
    def optimiser(self) -> Optimiser:
        """The optimiser, with its default tolerances."""
        return CmaEs(self.sigma, self.seed)


@dataclass(frozen=True)
class FitMujocoSysid(SimulatedFit):
    """min sum ((x - x_s(theta)) / RMS(x))^2 by `mujoco.sysid.optimize` (extra `peers`), x_s the
    `signal` "torque" or "position" of the simulated closed loop.

    Gauss-Newton with Levenberg-Marquardt damping between bounds, the toolbox's default, with
    forward differences, r simulations per Jacobian. Coordinates, start and simulator as all peers
    (SimulatedFit), in place of the toolbox's own rollouts of recorded torques, which are
    unstable over a whole motion. Stops by its default tolerances, or at the end of the `budget`,
    "10 s" of CPU time or "500 simulations" (None: no limit): then the best candidate simulated is
    the answer, `converged` is false, and that of a CPU time depends on the clock. It has no
    covariance. Assumes the controller as declared.
    """

    @property
    def optimiser(self) -> Optimiser:
        """The optimiser, with its default tolerances."""
        return MujocoSysid()
