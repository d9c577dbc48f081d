"""Iteration of DIDIM and IV as published: simulate the closed loop, fit linearly, repeat."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError, SimulationError
from sysid_bench.identification.feasibility.simulatable import SimulatableSet
from sysid_bench.identification.linear.least_squares import stacked_factor, torque_rms
from sysid_bench.identification.optimisers import BudgetError
from sysid_bench.types import Array, Estimate, Problem, Recording

SIGNIFICANT: Final = 0.1
"""Largest relative standard deviation of a parameter whose change counts: that of an essential
parameter (Pham and Gautier 1991). A parameter that is zero has no relative change."""

SAME: Final = 1e-9
"""Residual, relative to the torque, below which it is rounding and its change does not count."""


@dataclass(frozen=True, eq=False)
class LinearFit:
    """Linear fit of one iteration: beta and its covariance; R (r, r) of the whitened regressor; the
    norm of the residual relative to that of the torque, rows divided by their RMS."""

    beta: Array  # (r,)
    covariance: Array  # (r, r)
    R: Array
    residual: float


@dataclass(frozen=True, eq=False)
class PublishedFit:
    """beta_(k+1) = fit(simulate(theta_k)), theta_k the physically consistent parameters nearest to
    beta_k.

    Converged where the residual norm and every significant parameter change by at most `tolerance`,
    relative (Gautier, Janot, Vandanjon 2013; Janot, Vandanjon, Gautier 2014). Else the estimate is
    the last iterate: that of the last iteration, or the last one that could be simulated.
    """

    simulatable: SimulatableSet
    simulate: Callable[[Array], Recording]
    fit: Callable[[Recording], LinearFit]
    tolerance: float
    iterations: int

    def run(self, start: Array) -> Estimate:
        """Return the estimate from a start (p,).

        Raises EstimationError where the first iterate cannot be simulated, or where the last one is
        not usable (`check_estimate`).
        """
        theta, before = start, None
        for count in range(1, self.iterations + 1):
            try:
                found = self.fit(self.simulate(theta))
            except BudgetError as spent:
                return self._at_end_of_budget(before, count - 1, str(spent), start)
            except (EstimationError, SimulationError) as error:
                if before is None or count == 2:
                    raise
                return self._unconverged(before, count - 1, f"no further iterate: {error}", start)
            if before is not None and self._is_met(found, before):
                return _estimate(found, count, True, self._reason)
            theta, before = self._simulatable(theta, found), found
        stop = f"the limit of {self.iterations} iterations"
        return self._unconverged(found, self.iterations, stop, start)

    def _at_end_of_budget(
        self, before: LinearFit | None, count: int, stop: str, start: Array
    ) -> Estimate:
        """The last iterate; the start where there is none."""
        if before is not None:
            return self._unconverged(before, count, stop, start)
        beta = self.simulatable.problem.base.K @ start
        return Estimate(beta, converged=False, iterations=0, stop=stop)

    @property
    def _reason(self) -> str:
        share = f"{100 * self.tolerance:g} %"
        return f"residual norm and significant parameters change by at most {share}"

    def _is_met(self, fit: LinearFit, before: LinearFit) -> bool:
        norm, norm_before = (max(one.residual, SAME) for one in (fit, before))
        if abs(norm - norm_before) > self.tolerance * norm_before:
            return False
        counted = np.sqrt(np.diag(fit.covariance)) <= SIGNIFICANT * np.abs(fit.beta)
        change = np.abs(fit.beta - before.beta)
        return bool((change <= self.tolerance * np.abs(before.beta))[counted].all())

    def _simulatable(self, theta: Array, found: LinearFit) -> Array:
        """Physically consistent parameters (p,) with the beta of a fit, or nearest to it."""
        exact = self.simulatable.with_base(theta, found.beta)
        return exact if exact is not theta else self.simulatable.nearest(found.beta, found.R)

    def _unconverged(self, fit: LinearFit, count: int, stop: str, start: Array) -> Estimate:
        problem = self.simulatable.problem
        check_estimate(problem, fit.beta, problem.base.K @ start)
        return _estimate(fit, count, False, stop)


def _estimate(fit: LinearFit, count: int, converged: bool, stop: str) -> Estimate:
    return Estimate(
        fit.beta, covariance=fit.covariance, converged=converged, iterations=count, stop=stop
    )


def check_estimate(problem: Problem, beta: Array, start: Array) -> None:
    """Raise EstimationError for an iterate beta (r,) that is not finite, or that explains the
    measured torques worse than both the start (r,) and no model at all."""
    rms = torque_rms(problem)
    R = stacked_factor(problem, (1.0 / np.where(rms > 0, rms, 1.0)).tolist())
    errors = [np.linalg.norm(R @ np.append(one, -1.0)) for one in (beta, start, 0.0 * start)]
    if not np.isfinite(errors[0]) or errors[0] > max(errors[1:]):
        raise EstimationError(
            "The method diverges: its last iterate explains the torques worse than its start and "
            "than no model at all. The noise is too large, or the model does not fit the data."
        )
