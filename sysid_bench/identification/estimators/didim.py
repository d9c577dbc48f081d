"""DIDIM: least squares of the measured torque on the regressor of the simulated motion."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.signal import decimate

from sysid_bench.errors import UsageError
from sysid_bench.identification.linear.least_squares import scaled_fit, solve
from sysid_bench.identification.optimisers import parse_budget, with_budget
from sysid_bench.identification.simulation_based.controller_model import (
    check_controller,
    controller_model,
)
from sysid_bench.identification.simulation_based.gauss_newton import (
    covariance,
    error_noise,
    floor_of,
    regressor_of,
    residual_factor,
    rows_of,
    simulatable_start,
)
from sysid_bench.identification.simulation_based.published_fit import (
    LinearFit,
    PublishedFit,
)
from sysid_bench.types import Array, Estimate, Experiment, Recording


@dataclass(frozen=True)
class DIDIM:
    """Direct and inverse dynamic identification models (Gautier, Janot, Vandanjon 2013).

    beta_(k+1) = argmin |S^-1/2 (tau - W(q_s, v_s, a_s) beta)|^2, W the regressor along the motion
    that the model simulates with beta_k under the same controller and commanded motion, S the
    residual variance per joint. tau is the raw measured torque; `decimation` > 1 filters and
    decimates tau and W alike (parallel decimation). Neither the measured motion nor its derivatives
    enter.

    `gains` "updated" (the default, as published) multiplies the controller's gains by the joint
    inertias of the simulated parameters over those of the actual robot, so that the closed-loop
    poles stay; "kept" takes them as declared. Starts from the prior, else from least squares along
    the commanded motion. Stops where the residual norm and the significant parameters change by at
    most `tolerance` = 2.5 %, or after 10 iterations, as published.

    Deviations: the simulator needs physically consistent bodies, so that the nearest to beta_k are
    simulated; beta itself is never constrained. The published change of the parameters is over
    essential ones, here those with a relative standard deviation below 10 %. The actual inertias,
    which the paper takes from the design of the controller, are those of least squares on the
    measured motion. Where beta_k cannot be simulated, the previous iterate is the estimate; at the
    end of a `budget`, "10 s" of CPU time or "5 simulations" (None: no limit), the last one.
    """

    bias: ClassVar[str] = "ten iterations leave a part of the start, even with exact data"
    gains: str = "updated"
    decimation: int = 1
    tolerance: float = 0.025
    iterations: int = 10
    budget: str | None = None

    def __post_init__(self) -> None:
        """Raise UsageError for unknown gains, for a decimation or iterations below 1, and for a
        budget that there is not."""
        parse_budget(self.budget)
        check_controller(self.gains)
        if min(self.decimation, self.iterations) < 1:
            raise UsageError("decimation and iterations are whole numbers of 1 or more.")

    def fit(self, experiment: Experiment) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the first iterate cannot be
        simulated or the iteration diverges, UnsupportedError where the recording declares no
        controller."""
        experiment = with_budget(experiment, self.budget)
        simulatable, start = simulatable_start(experiment)
        actual, _, _ = scaled_fit(experiment.problem)
        model = controller_model(experiment, self.gains, actual)
        fit = _Fit(experiment, self.decimation)
        return PublishedFit(simulatable, model.simulate, fit, self.tolerance, self.iterations).run(
            start
        )


@dataclass(frozen=True, eq=False)
class _Fit:
    """Weighted least squares of the measured torque on the regressor of a simulated motion."""

    experiment: Experiment
    decimation: int

    def __call__(self, simulated: Recording) -> LinearFit:
        experiment, motion = self.experiment, simulated.motion
        W = self._decimated(regressor_of(experiment, motion))
        tau = rows_of(experiment, experiment.raw.tau)
        b = self._decimated(tau - experiment.known(motion))
        size = error_noise(b, floor_of(b))
        sigma = size
        for _ in range(2):  # the second with the residual variance of the first
            R = residual_factor(W / sigma[:, None], b / sigma)
            beta = solve(R)
            rest = b - W @ beta
            sigma = error_noise(rest, floor_of(b))
        R = residual_factor(W / sigma[:, None], rest / sigma)
        residual = float(np.linalg.norm(rest / size) / np.linalg.norm(b / size))
        return LinearFit(beta, covariance(R), R[:-1, :-1], residual)

    def _decimated(self, x: Array) -> Array:
        """Values x (N, ...) through a zero-phase low-pass filter, every `decimation`-th."""
        return x if self.decimation == 1 else np.asarray(decimate(x, self.decimation, axis=0))
