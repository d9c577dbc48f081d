"""One estimator on one problem, guarded: an estimate always comes back."""

import time
from dataclasses import replace
from typing import Any

import numpy as np

from sysid_bench.errors import EstimationError, SimulationError, UnsupportedError, UsageError
from sysid_bench.types import Estimate, Experiment, Problem


def identify(estimator: Any, problem: Problem, experiment: Experiment | None = None) -> Estimate:
    """The estimate of `solve(problem)`, or of `fit(experiment)` where the method needs one.

    A method that says why not (EstimationError, UnsupportedError) answers with a status; a wrong
    shape or a number that is not finite is a failure with its reason. `stats["seconds"]` is set.
    """
    start = time.perf_counter()
    try:
        estimate = _call(estimator, problem, experiment)
        estimate = _checked(estimate, problem)
    except UnsupportedError as error:
        estimate = Estimate(status="unsupported", reason=str(error))
    except (EstimationError, SimulationError, UsageError, np.linalg.LinAlgError) as error:
        estimate = Estimate(status="failed", reason=str(error))
    seconds = time.perf_counter() - start
    return replace(estimate, stats={**estimate.stats, "seconds": seconds})


def _call(estimator: Any, problem: Problem, experiment: Experiment | None) -> Any:
    if hasattr(estimator, "solve"):
        return estimator.solve(problem)
    if hasattr(estimator, "fit"):
        if experiment is None:
            raise UnsupportedError(f"{estimator!r} needs an experiment, and there is only a problem.")
        return estimator.fit(experiment)
    raise UsageError(f"{estimator!r} is no estimator: it has neither solve(problem) nor fit(experiment).")


def _checked(estimate: Any, problem: Problem) -> Estimate:
    if not isinstance(estimate, Estimate):
        raise EstimationError(f"The method answered {type(estimate).__name__}, not an Estimate.")
    if estimate.status != "ok":
        return estimate
    if estimate.theta is not None:
        _check_numbers("theta", estimate.theta, len(problem.parameters))
        estimate = replace(estimate, beta=problem.base.K @ estimate.theta)
    if estimate.beta is None:
        raise EstimationError("The method answered neither beta nor theta.")
    _check_numbers("beta", estimate.beta, problem.base.rank)
    return estimate


def _check_numbers(name: str, values: Any, size: int) -> None:
    if np.shape(values) != (size,):
        raise EstimationError(f"The method's {name} has the shape {np.shape(values)}; expected ({size},).")
    if not np.isfinite(values).all():
        bad = int((~np.isfinite(values)).sum())
        raise EstimationError(f"{bad} of {size} numbers of the method's {name} are not finite.")
