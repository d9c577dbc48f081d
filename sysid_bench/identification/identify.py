"""Run one estimator on one problem and return an estimate in any case."""

import time
from dataclasses import replace
from typing import Any, get_args

import numpy as np

from sysid_bench.errors import (
    LONGEST_TEXT,
    EstimationError,
    SimulationError,
    UnsupportedError,
    UsageError,
)
from sysid_bench.identification.optimisers import Budget, BudgetUse
from sysid_bench.types import Array, Estimate, EstimateStatus, Experiment, Problem


def identify(estimator: Any, problem: Problem, experiment: Experiment | None = None) -> Estimate:
    """Return the estimate of `solve(problem)`, or of `fit(experiment)` for methods that simulate. A
    method with both fits an experiment of one motion, and else solves the problem.

    EstimationError and UnsupportedError become the status "failed" or "unsupported" with their
    reason; so does an estimate with a wrong shape or a value that is not finite. An iterate that
    has not converged is an estimate. Sets `stats["seconds"]` and `stats["seconds_cpu"]`, and
    `simulations` where the method has not. A method in a process of its own has `used_seconds`,
    those that its calls have taken there: wall clock and CPU.
    """
    used = getattr(estimator, "used_seconds", _used_seconds)
    start, cpu_start = used()
    meter = BudgetUse(Budget())  # no limit: it counts alone
    if experiment is not None:
        experiment = replace(experiment, simulate=meter.with_count(experiment.simulate))
    try:
        estimate = _call(estimator, problem, experiment)
        estimate = _checked(estimate, problem)
    # That a method refuses or fails is a result of a benchmark, not the end of it.
    except UnsupportedError as error:
        estimate = Estimate(status="unsupported", reason=str(error))
    except (EstimationError, SimulationError, UsageError, np.linalg.LinAlgError) as error:
        estimate = Estimate(status="failed", reason=str(error))
    end, cpu_end = used()
    simulations = estimate.simulations
    if simulations is None:
        simulations = meter.simulations
    stats = {**estimate.stats, "seconds": end - start, "seconds_cpu": cpu_end - cpu_start}
    return replace(estimate, stats=stats, simulations=simulations)


def _used_seconds() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()


def fit_fields(estimate: Estimate) -> dict[str, Any]:
    """Return the fields `converged`, `iterations`, `simulations` and `stop` of a row."""
    return {
        "converged": estimate.converged,
        "iterations": estimate.iterations,
        "simulations": estimate.simulations,
        "stop": estimate.stop,
    }


def _call(estimator: Any, problem: Problem, experiment: Experiment | None) -> Any:
    both = hasattr(estimator, "fit") and hasattr(estimator, "solve")
    if both and experiment is not None and not problem.motions:
        return estimator.fit(experiment)
    if hasattr(estimator, "solve"):
        return estimator.solve(problem)
    if hasattr(estimator, "fit"):
        if experiment is None:
            raise UnsupportedError(f"{estimator!r} needs an experiment; only a problem is given.")
        # An estimate from the first motion alone would be compared with those from all of them.
        if problem.motions:
            raise UnsupportedError(
                f"{type(estimator).__name__} simulates one recorded motion, and the training data "
                f"are {len(problem.motions)} motions: give it one (motions = 1, one training log)."
            )
        return estimator.fit(experiment)
    raise UsageError(
        f"{estimator!r} is not an estimator: it has neither solve(problem) nor fit(experiment)."
    )


def _checked(estimate: Any, problem: Problem) -> Estimate:
    if not isinstance(estimate, Estimate):
        raise EstimationError(f"The method returned {type(estimate).__name__}, not an Estimate.")
    if estimate.status == "ok":
        r = problem.base.rank
        theta = _numbers("theta", estimate.theta, (len(problem.parameters),))
        # theta decides where both are given: a beta of its own could contradict it.
        beta = _numbers("beta", estimate.beta if theta is None else problem.base.K @ theta, (r,))
        if beta is None:
            raise EstimationError("The method returned neither beta nor theta.")
        covariance = _numbers("covariance", estimate.covariance, (r, r))
        if covariance is not None and (np.diag(covariance) < 0).any():
            raise EstimationError("The method's covariance has a negative variance.")
        sigma = _numbers("sigma", estimate.sigma, (len(problem.rows),))
        if sigma is not None and (sigma <= 0).any():
            raise EstimationError("The method's sigma has a value that is not positive.")
        plain = _plain_convergence(estimate)
        return replace(
            estimate, theta=theta, beta=beta, covariance=covariance, sigma=sigma, **plain
        )
    known = get_args(EstimateStatus)
    if estimate.status not in known:
        raise EstimationError(
            f"The method's status is {estimate.status!r}; expected one of {', '.join(known)}."
        )
    return replace(estimate, reason=str(estimate.reason)[:LONGEST_TEXT])


def _plain_convergence(estimate: Estimate) -> dict[str, Any]:
    """Return the estimate's flag, counts and reason as Python's types, also where they are
    NumPy's; raise EstimationError for another type than declared."""
    kinds = {"converged": bool, "iterations": int, "simulations": int, "stop": str}
    plain = {name: getattr(estimate, name) for name in kinds}
    plain = {k: v.item() if isinstance(v, np.generic) else v for k, v in plain.items()}
    for name, kind in kinds.items():
        value = plain[name]
        exact = isinstance(value, bool) == (kind is bool)  # Python counts True as a number
        if value is not None and not (isinstance(value, kind) and exact):
            raise EstimationError(
                f"The method's {name} is {value!r}; expected {kind.__name__} or None."
            )
    if plain["stop"] is not None:
        plain["stop"] = plain["stop"][:LONGEST_TEXT]
    return plain


def _numbers(name: str, values: Any, shape: tuple[int, ...]) -> Array | None:
    """Convert a plug-in's numbers, if given, to an array of this shape; raise EstimationError
    otherwise."""
    if values is None:
        return None
    numbers = np.asarray(values)
    if numbers.dtype.kind not in "fiu":
        raise EstimationError(
            f"The method's {name} has the type {numbers.dtype}, not real numbers."
        )
    if numbers.shape != shape:
        raise EstimationError(
            f"The method's {name} has the shape {numbers.shape}; expected {shape}."
        )
    bad = int((~np.isfinite(numbers)).sum())
    if bad:
        raise EstimationError(
            f"{bad} of {numbers.size} values of the method's {name} are not finite."
        )
    return numbers.astype(float)
