"""Physically consistent fits: bounds, linear matrix inequalities, and distances to a prior."""

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from sysid_bench.identification.estimators.linear import WLS
from sysid_bench.identification.feasibility.cholesky_coordinates import coordinates, newton_fit
from sysid_bench.identification.feasibility.completion import completed_parameters
from sysid_bench.identification.feasibility.divergence import divergence, newton
from sysid_bench.identification.feasibility.feasible_set import (
    feasible_prior,
    feasible_set_of,
    find_prior,
    scaled_coordinates,
    spread_of,
    start_of,
)
from sysid_bench.identification.feasibility.lmi_fit import Limits, estimate_of, fit
from sysid_bench.identification.linear.cross_validation import WeightedPrior
from sysid_bench.identification.linear.least_squares import (
    RESIDUALS,
    check_rank,
    check_weights,
    stacked_factor,
)
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class Bounded:
    """min |S^-1/2 (W K theta - b)|^2 with linear inequalities on theta; S as in `wls`.

    Masses within `mass` (kg), moments of inertia non-negative with the triangle inequality, joint
    terms non-negative: necessary for physical consistency, not sufficient, since products of
    inertia and centres of mass are free. A quadratic program, solved by Clarabel to a duality gap
    of 1e-7. Returns beta alone, since many theta within the bounds share it. The default bounds
    exclude only what no body has. Assumes W exact and white noise per joint.
    """

    mass: tuple[float, float] = (0.0, np.inf)

    def solve(self, problem: Problem) -> Estimate:
        """Return beta; raises EstimationError where the motion does not excite every direction, or
        where Clarabel does not solve the program."""
        check_rank(stacked_factor(problem))
        feasible = feasible_set_of(problem)
        solution = fit(
            feasible,
            problem,
            Limits(None, (self.mass[0], self.mass[1])),
            start_of(feasible, problem.prior),
        )
        stats = {"duality_gap": solution.gap, "excess": solution.excess}
        return Estimate(problem.base.K @ (feasible.scale * solution.x), stats=stats)


@dataclass(frozen=True)
class LMI:
    """min |S^-1/2 (W K theta - b)|^2 with pseudo-inertias J_i >= margin tr(J_i) 1, S as in `wls`.

    Friction and rotor inertia are non-negative (`Problem.signed`); masses (kg) and centres of mass
    (m from the body frame) lie within limits. A semidefinite program, solved by Clarabel;
    `duality_gap` and `roundness` (smallest eigenvalue of any J over its trace) are the certificate.
    Unobservable parameters come from the prior, else from spheres of 1 kg, and mean nothing by
    themselves. margin = 1e-7 exceeds Clarabel's tolerance. Sousa and Cortesao (2014, 2019);
    Wensing, Kim, Slotine (2018).
    """

    margin: float = 1e-7
    mass: tuple[float, float] = (0.0, np.inf)
    com: float = field(default=np.inf, metadata={"unit": "m"})

    def solve(self, problem: Problem) -> Estimate:
        """Return theta, also where the motion does not excite every direction; raises
        EstimationError where Clarabel does not solve the program."""
        feasible = feasible_set_of(problem)
        limits = Limits(self.margin, (self.mass[0], self.mass[1]), self.com)
        return estimate_of(
            feasible, fit(feasible, problem, limits, start_of(feasible, problem.prior))
        )


@dataclass(frozen=True)
class _FeasiblePrior(WeightedPrior):
    """Physically consistent fit that a prior draws with a weight."""

    bias: ClassVar[str] = (
        "drawn towards the prior; torques are taken to have 0.001 % of noise at least"
    )


@dataclass(frozen=True)
class LMIEuclidean(_FeasiblePrior):
    """min |S^-1/2 (W K theta - b)|^2 + weight |(theta - theta0) / std|^2 under the LMIs of `lmi`.

    Parameters are scaled by the standard deviations of the prior: a plain norm would add kg to kg
    m^2. With the default weight 1 it is the maximum a posteriori estimate within the constraints;
    "cross-validated" chooses the weight (cross_validation.py). Solved by Clarabel to a duality gap
    of 1e-7; margin as in `lmi`. Assumes W exact and white noise per joint. Lee, Wensing, Park
    (2020).
    """

    margin: float = 1e-7
    frame_dependent: ClassVar[str] = (
        "the prior has deviations of single parameters, which other frames of the links correlate"
    )

    def _fit(self, problem: Problem, weight: float) -> Estimate:
        feasible, prior = feasible_set_of(problem), find_prior(problem)
        pull = weight * np.diag(1 / spread_of(feasible, prior) ** 2)
        return estimate_of(
            feasible,
            fit(feasible, problem, Limits(self.margin), prior.theta / feasible.scale, pull),
        )


@dataclass(frozen=True)
class LMIPullback(_FeasiblePrior):
    """min |S^-1/2 (W K theta - b)|^2 + weight d' M d, d = theta - theta0, under the LMIs of `lmi`.

    M_kl = tr(J0^-1 E_k J0^-1 E_l) is the affine-invariant metric of pseudo-inertias, pulled back to
    theta and held at the prior: invariant to frames and units. With the default weight 1 the prior
    counts like one sample; "cross-validated" chooses it (cross_validation.py). Solved by Clarabel
    to a duality gap of 1e-7; margin as in `lmi`. Assumes W exact and white noise per joint. Lee and
    Park (2018); Lee, Wensing, Park (2020).
    """

    margin: float = 1e-7

    def _fit(self, problem: Problem, weight: float) -> Estimate:
        feasible, x0, std = feasible_prior(problem)
        metric = divergence(feasible, x0, std).metric
        return estimate_of(
            feasible, fit(feasible, problem, Limits(self.margin), x0, weight * metric)
        )


@dataclass(frozen=True)
class Entropic(_FeasiblePrior):
    """min |S^-1/2 (W K theta - b)|^2 / 2 + weight sum_i d(J_i, J0_i), S as in `wls`, or with
    `weights` "rms-torque" or "max-torque" that torque of each joint times one common share.

    d is the log-det (Bregman) divergence of pseudo-inertias: invariant to frames and units, and
    infinite where a body is not physically consistent. Solved by a primal-dual interior-point
    method (divergence.py) to a Newton decrement of 1e-10 weight. With the default weight 1 the
    prior counts like one sample; "cross-validated" chooses it (cross_validation.py). Assumes W
    exact and white noise per joint. Lee and Park (2018); Lee, Wensing, Park (2020).
    """

    weights: str = RESIDUALS

    def __post_init__(self) -> None:
        """Raise UsageError for unknown weights."""
        super().__post_init__()
        check_weights(self.weights)

    def _fit(self, problem: Problem, weight: float) -> Estimate:
        feasible, x0, std = feasible_prior(problem)
        coordinates = scaled_coordinates(feasible, problem, x0, self.weights)
        x, iterations, decrement = newton(
            divergence(feasible, x0, std), coordinates, weight, coordinates.y(x0)
        )
        stats = {
            "iterations": float(iterations),
            "decrement": decrement,
            "roundness": feasible.roundness(x),
        }
        return Estimate(theta=feasible.scale * x, stats=stats)


STAGE = 10.0
"""Growth of the weight of the rows from one stage to the next."""


@dataclass(frozen=True)
class LogCholesky(_FeasiblePrior):
    """min |S^-1/2 (W K theta(eta) - b)|^2 + weight |eta - eta0|^2, S as in `wls`.

    J = U U', U upper triangular with exponentials on its diagonal: ten unconstrained numbers per
    body, all of them physically consistent (Rucker and Wensing 2022). Damped Newton from the prior,
    the weight of the rows growing tenfold from stage to stage: at once they form a narrow curved
    valley. The default weight 1 counts like one sample; it keeps unexcited eta finite;
    "cross-validated" chooses it (cross_validation.py). Stops at a Newton decrement of 1e-9 weight,
    within 400 iterations per stage. Assumes W exact and white noise per joint.
    """

    iterations: int = 400  # of each stage
    frame_dependent: ClassVar[str] = (
        "the weight acts on coordinates of the bodies that the frames of the links choose"
    )

    def _fit(self, problem: Problem, weight: float) -> Estimate:
        feasible, x0, _ = feasible_prior(problem)
        chart, base = coordinates(feasible, x0), scaled_coordinates(feasible, problem, x0)
        # u = inverse (x - origin), whose squares are the excess over least squares.
        inverse = np.linalg.inv(base.T)[: base.rank]
        eta, total = chart.eta0, 0
        # The first weight makes the misfit of the prior, the start, as large as one unit of noise.
        share = 1.0 / max(float(np.linalg.norm(inverse @ (x0 - base.origin))), 1.0)
        while True:
            eta, count, decrement = newton_fit(
                share * inverse, base.origin, chart, eta, weight, self.iterations
            )
            total += count
            if share == 1.0:
                break
            share = min(share * STAGE, 1.0)
        stats = {
            "iterations": float(total),
            "decrement": decrement,
            "roundness": feasible.roundness(chart.x(eta)),
        }
        return Estimate(theta=feasible.scale * chart.x(eta), stats=stats)


@dataclass(frozen=True)
class Reconstruction:
    """theta = argmin d(theta, theta0) over physically consistent theta with K theta = beta of
    `wls`.

    `distance` d: "entropic" (log-det divergence, the default, invariant to frames and units),
    "euclidean" or "pullback". The fit itself is unchanged: it fails where noise has carried beta
    out of the feasible set. Convex, with the stop rules of divergence.py and lmi_fit.py.
    Assumptions of `wls`. Sousa and Cortesao (2014); Gaz, Flacco, De Luca (2016).
    """

    distance: str = "entropic"

    def solve(self, problem: Problem) -> Estimate:
        """Return theta with the covariance of `wls`; raises EstimationError without a prior, where
        the motion does not excite every direction, or where no physically consistent body has this
        beta."""
        prior, fit = find_prior(problem), WLS().solve(problem)
        assert fit.beta is not None
        feasible = feasible_set_of(problem)
        theta = completed_parameters(feasible, problem.base, fit.beta, prior, self.distance)
        roundness = feasible.roundness(theta / feasible.scale)
        return replace(fit, theta=theta, stats={"roundness": roundness})
