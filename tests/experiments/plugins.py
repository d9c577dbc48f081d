"""Plug-ins of users: an effect, an excitation, and estimators of both kinds."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from sysid_bench.errors import EstimationError, UnsupportedError
from sysid_bench.excitation.design_problem import MARGIN, DesignProblem
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import (
    Array,
    Estimate,
    Experiment,
    Prior,
    Problem,
    Recording,
    Trajectory,
)

ANSWER = object()
"""A name that is not an estimator."""


@dataclass(frozen=True)
class Drag:
    """Quadratic drag on every joint."""

    size: float = field(default=0.5, metadata={"unit": "N m"})

    def prepare(self, robot: RobotModel) -> Callable[[Array, Array, Array], Array]:
        return lambda t, q, v: self.size * v * np.abs(v)


@dataclass(frozen=True)
class Hops:
    """Sines of one frequency per joint, none a multiple of another's."""

    duration: float = field(default=4.0, metadata={"unit": "s"})

    def design(self, problem: DesignProblem, rng: np.random.Generator) -> Trajectory:
        t = problem.times(self.duration)
        w = 2.0 + np.sqrt(np.arange(problem.nv)) + 0.1 * rng.uniform(size=problem.nv)
        half_range = 0.5 * (problem.high - problem.low)
        size = MARGIN * np.minimum.reduce([half_range, problem.v / w, problem.a / w**2])
        size, angle = 0.5 * size, np.outer(t, w)
        x = 0.5 * (problem.low + problem.high) + size * (np.sin(angle) + np.cos(1.7 * angle) / 3)
        dx = size * w * (np.cos(angle) - 1.7 / 3 * np.sin(1.7 * angle))
        ddx = -size * w**2 * (np.sin(angle) + 1.7**2 / 3 * np.cos(1.7 * angle))
        return problem.trajectory(t, x, dx, ddx, "hops")


@dataclass(frozen=True)
class Ridge:
    """Least squares with a small ridge."""

    weight: float = 1e-12

    def solve(self, problem: Problem) -> Estimate:
        W, b = problem.W, problem.b
        normal = W.T @ W + self.weight * np.eye(W.shape[1])
        return Estimate(np.linalg.solve(normal, W.T @ b), stats={"weight": self.weight})


@dataclass(frozen=True)
class Halving:
    """Steps of half the way to least squares, until the largest residual is at most `limit`."""

    limit: float = 0.0

    def solve(self, problem: Problem) -> Estimate:
        for steps in range(1, 40):
            if self.residual(problem, steps) <= self.limit:
                break
        return Estimate(self._beta(problem, steps), converged=True, iterations=steps)

    def residual(self, problem: Problem, steps: int) -> float:
        W, b = problem.stacked
        return float(np.abs(b - W @ self._beta(problem, steps)).max())

    def _beta(self, problem: Problem, steps: int) -> Array:
        W, b = problem.stacked
        return np.asarray((1.0 - 0.5**steps) * np.linalg.lstsq(W, b)[0])


class PriorMean:
    """Return the prior."""

    def solve(self, problem: Problem) -> Estimate:
        if problem.prior is None:
            raise EstimationError("There is no prior.")
        return Estimate(theta=problem.prior.theta)


@dataclass(frozen=True)
class Output:
    """Gauss-Newton on simulated motions, as DIDIM does (Gautier, Janot, Vandanjon 2013): the
    regressor is taken along the method's own simulation, never along noisy measurements. The prior
    says what the motion does not; a step to bodies that cannot exist is halved."""

    iterations: int = 8

    def fit(self, experiment: Experiment) -> Estimate:
        prior = experiment.problem.prior
        if prior is None:
            raise UnsupportedError("Output error starts from a prior, and there is none.")
        theta, simulated = prior.theta, experiment.simulate(prior.theta)
        for _ in range(self.iterations):
            step = self.better(experiment, prior, theta, simulated) - theta
            theta, simulated = self.possible(experiment, theta, step)
        return Estimate(theta=theta, stats={"iterations": float(self.iterations)})

    def better(
        self, experiment: Experiment, prior: Prior, theta: Array, simulated: Recording
    ) -> Array:
        blocks = [Y @ experiment.problem.base.K for Y in experiment.regress(simulated.motion)]
        W = np.concatenate(blocks).reshape(-1, len(theta))
        known = simulated.tau.ravel() - W @ theta  # what the task knows, along the same motion
        rest = experiment.recording.tau.ravel() - known
        free = np.linalg.lstsq(W, rest)[0]
        noise = max(float(np.std(rest - W @ free)), 1e-9 * float(np.std(rest)))
        pull = 1.0 / np.maximum(prior.std, 1e-9)
        stack = np.concatenate([W / noise, np.diag(pull)])
        return np.asarray(
            np.linalg.lstsq(stack, np.concatenate([rest / noise, pull * prior.theta]))[0]
        )

    def possible(
        self, experiment: Experiment, theta: Array, step: Array
    ) -> tuple[Array, Recording]:
        for _ in range(20):
            try:
                return theta + step, experiment.simulate(theta + step)
            except EstimationError:
                step = 0.5 * step
        return theta, experiment.simulate(theta)  # on the boundary of bodies that can exist


class Raising:
    """An estimator with a mistake."""

    def solve(self, problem: Problem) -> Estimate:
        raise ZeroDivisionError("a mistake in the method")


class Chatty:
    """Return statistics that JSON cannot store."""

    def solve(self, problem: Problem) -> Estimate:
        estimate = Estimate(np.zeros(problem.base.rank))
        # Past the checks of shapes that tests switch on: plug-ins run without them.
        object.__setattr__(estimate, "stats", {"model": object()})
        return estimate


class Infinite:
    """Return statistics that are not finite."""

    def solve(self, problem: Problem) -> Estimate:
        stats = {"last_step": float("nan"), "condition": float("inf")}
        return Estimate(np.zeros(problem.base.rank), stats=stats)


class Vandal:
    """Write into its input."""

    def solve(self, problem: Problem) -> Estimate:
        problem.factors[0].R[...] = 0.0
        return Estimate(np.zeros(problem.base.rank))


@dataclass(frozen=True)
class Wordy:
    """A method whose texts hold five million characters."""

    where: str = "stop"

    def solve(self, problem: Problem) -> Estimate:
        """Return the text as the reason of the stop or of a failure, or raise it."""
        text = 5_000_000 * "x"
        if self.where == "error":
            raise ValueError(text)
        if self.where == "reason":
            return Estimate(status="failed", reason=text)
        return Estimate(beta=np.zeros(problem.base.rank), stop=text)
