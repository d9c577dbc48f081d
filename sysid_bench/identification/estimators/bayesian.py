"""Estimates drawn towards a prior, or towards zero; and the null model that all others are compared
with."""

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from scipy.linalg import pinv

from sysid_bench.errors import UnsupportedError
from sysid_bench.identification.feasibility.feasible_set import find_prior
from sysid_bench.identification.linear.cross_validation import (
    WeightedPrior,
    check_weight,
    held_out_errors,
    with_weight,
)
from sysid_bench.identification.linear.least_squares import (
    EXCITED,
    check_rank,
    covariance,
    direction_deviations,
    row_noise,
    scaled_fit,
    stacked_factor,
    torque_rms,
)
from sysid_bench.types import Array, Estimate, Problem


@dataclass(frozen=True)
class PriorMean:
    """theta = theta0, the mean of the prior; covariance K diag(std^2) K' of the declared spread.

    The row against which a table shows what the data have added: a method that loses to it has
    made a good prior worse.
    """

    bias: ClassVar[str] = "the error of the prior, whatever the data"
    uses_data: ClassVar[bool] = False

    def solve(self, problem: Problem) -> Estimate:
        """Return the prior; raises EstimationError without one."""
        prior = find_prior(problem)
        root = problem.base.K * prior.std
        return Estimate(theta=np.array(prior.theta), covariance=root @ root.T)


def body_columns(problem: Problem) -> Array:
    """Mask (p,) of the parameters of bodies; all others are joint terms and features."""
    inertial = {column for body in problem.bodies for column in body.columns}
    return np.array([name in inertial for name in problem.parameters], dtype=bool)


@dataclass(frozen=True)
class FileFriction:
    """Bodies of the model file, joint terms by weighted least squares: the null model of tables.

    theta = theta0 for the bodies, in simulated experiments the mean of the prior; friction, offsets
    and rotor inertia minimise |S^-1/2 (W K theta - b)|, S the noise per joint (as `wls`), with the
    least norm on unit columns where the motion leaves them open. Who identifies bodies has to
    predict better than who only fits friction. Closed form, no settings.
    """

    bias: ClassVar[str] = "the error of the prior's bodies, whatever the data"

    def solve(self, problem: Problem) -> Estimate:
        """Return theta; raises EstimationError without the values of a model file, UnsupportedError
        without joint terms."""
        theta, is_body = np.array(file_values(problem)), body_columns(problem)
        if is_body.all():
            raise UnsupportedError(
                "There are no joint terms to fit: this null model is the prior itself; use the "
                "method 'prior'."
            )
        theta[~is_body] = 0.0
        R = stacked_factor(problem, (1.0 / row_noise(problem)).tolist())
        terms = R[:, :-1] @ problem.base.K[:, ~is_body]
        size = np.linalg.norm(terms, axis=0)
        size = np.where(size > 0, size, 1.0)
        known = R[:, -1] - R[:, :-1] @ (problem.base.K @ theta)
        theta[~is_body] = pinv(terms / size, rtol=EXCITED) @ known / size
        return Estimate(theta=theta)


def file_values(problem: Problem) -> Array:
    """Return theta (p,) of the model file; where the problem has none, the mean of its prior."""
    return find_prior(problem).theta if problem.file is None else problem.file


@dataclass(frozen=True)
class APriori(WeightedPrior):
    """min |S^-1/2 (W K theta - b)|^2 + weight |(theta - theta0) / std|^2 over all p parameters.

    theta0 and std are mean and standard deviations of the prior, so that no unit is favoured; S is
    the noise variance per joint (as `wls`). Closed form by SVD. The default weight 1 gives the
    maximum a posteriori estimate, and the covariance of its posterior; "cross-validated" chooses
    the weight (cross_validation.py). Physical consistency is not imposed. Assumes W exact and white
    noise per joint. Tarantola (2005).
    """

    frame_dependent: ClassVar[str] = (
        "the prior has deviations of single parameters, which other frames of the links correlate"
    )
    bias: ClassVar[str] = "drawn towards the prior, less so the more exact the data are"

    def _fit(self, problem: Problem, weight: float) -> Estimate:
        prior = find_prior(problem)
        K, std = problem.base.K, prior.std / np.sqrt(weight)
        R = stacked_factor(problem, (1.0 / row_noise(problem)).tolist())
        # In x = (theta - theta0) / std the prior is the unit ball, and the data a rank-r map of it.
        U, values, Vt = np.linalg.svd(R[:, :-1] @ (K * std), full_matrices=False)
        projected = U.T @ (R[:, -1] - R[:, :-1] @ (K @ prior.theta))
        theta = prior.theta + std * (Vt.T @ (values / (values**2 + 1.0) * projected))
        # Excited directions keep 1 / (s^2 + 1) of the prior's variance, all others the whole of it.
        excited = (K * std) @ Vt.T
        unexcited = K * std - excited @ Vt
        root = np.hstack([excited / np.sqrt(values**2 + 1.0), unexcited])
        return Estimate(theta=theta, covariance=root @ root.T)


WEIGHTS = tuple(10.0**k for k in range(-8, 1))
"""Weights that are tried: as many as of other methods (cross_validation.py)."""


@dataclass(frozen=True)
class Ridge:
    """min |S^-1/2 (W beta - b)|^2 + k |D beta|^2, D scaling the weighted columns to unit norm.

    S is the noise variance per joint (as `wls`), so that kg and kg m^2 are not mixed. `weight` is
    k; the default None takes r / |D beta|^2 of weighted least squares (Hoerl, Kennard, Baldwin
    1975), which vanishes for exact data; "cross-validated" chooses it from 1e-8 to 1, since k adds
    to squared singular values of unit columns (cross_validation.py). Closed form by SVD; the
    covariance is the variance without the bias. Assumes W exact and white noise per joint. Hoerl
    and Kennard (1970).
    """

    weight: float | str | None = None
    frame_dependent: ClassVar[str] = (
        "it depends on the choice of base parameters, and so on the frames of the links"
    )
    bias: ClassVar[str] = (
        "drawn towards zero by the weight; unbiased for exact data without a weight"
    )

    def __post_init__(self) -> None:
        """Raise UsageError for a weight that is not positive, nor a word that has a rule."""
        if self.weight is not None:
            check_weight(self.weight)

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and its covariance; with a weight also where the motion does not excite every
        direction, without one EstimationError is raised there."""
        if self.weight is None:
            return self._fit(problem, None)
        return with_weight(self._fit, problem, self.weight, WEIGHTS)

    def _fit(self, problem: Problem, weight: float | None) -> Estimate:
        R = stacked_factor(problem, (1.0 / row_noise(problem)).tolist())
        norms = np.linalg.norm(R[:, :-1], axis=0)
        # Unit columns: one k acts alike on kg, kg m and kg m^2.
        norms = np.where(norms > 0, norms, 1.0)
        U, values, Vt = np.linalg.svd(R[:, :-1] / norms, full_matrices=False)
        projected = U.T @ R[:, -1]
        if weight is None:
            check_rank(stacked_factor(problem))
            # projected / values are the least-squares coefficients D beta in the singular basis.
            weight = problem.base.rank / max(float(np.sum((projected / values) ** 2)), 1e-300)
        gains = values / (values**2 + weight)
        root = Vt.T * gains / norms[:, None]
        beta = Vt.T @ (gains * projected) / norms
        return Estimate(beta, covariance=root @ root.T, stats={"weight": float(weight)})


WEAK: Final = 0.1
"""Deviation of a direction over the whole answer from which noise may decide it: by white noise, of
which correlated residuals have several times as much (measured: 3), in three deviations."""

GUARDS: Final = (0.0, *(4.0**k for k in range(6)), 1e6)
"""Weights of the prior of bodies: from none, which is least squares, to its bodies alone."""

LEAST_NOISE: Final = 0.01
"""Share of the torque of its joint that a row errs by at least beside a prior: rigid models of real
joints err by more (measured: 2 %), and rows with as many parameters as samples show no noise."""

GAIN: Final = 0.02
"""Least relative reduction of the error on left-out parts for which least squares is given up."""


@dataclass(frozen=True)
class GuardedWLS:
    """Weighted least squares (`wls`); where the motion determines some direction weakly, the weight
    of a prior beside it that predicts left-out parts of the motion best.

    beta = (W' S^-1 W)^-1 W' S^-1 b, S as in `wls`, unless noise moves a direction by more than a
    tenth of the answer (WEAK). Then min |S^-1/2 (W K theta - b)|^2 + |(theta - theta0) / std|^2,
    the deviations of bodies over sqrt(w): w of GUARDS has the least error on five blocks of time
    that are left out in turn, relative to the torque of each joint, and w = 0 (`wls`) stays unless
    that error falls by GAIN. Large w is `file-friction`. Without a prior theta0 is zero, and each
    base parameter has the deviation with which it alone would explain the whole torque. The
    covariance holds noise and the declared deviations of the prior. Closed form by SVD. Assumes W
    exact and white noise per joint. Stone (1974); Tarantola (2005).
    """

    frame_dependent: ClassVar[str] = (
        "the prior has deviations of single parameters, which other frames of the links correlate"
    )
    bias: ClassVar[str] = "drawn towards the prior where the motion determines a direction weakly"

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and its covariance, also where the motion does not excite every direction;
        `stats["weight"]`: the weight of the prior, 0 for least squares."""
        sigma, weight = row_noise(problem), 0.0
        weakest = float(direction_deviations(problem)[0].max(initial=0.0))
        if weakest > WEAK:

            def fit(part: Problem, tried: float) -> Estimate:
                return _guarded(part, sigma, tried)

            # As answers are judged: joints with little noise would else decide alone.
            errors = held_out_errors(fit, problem, GUARDS, torque_rms(problem))
            best = int(np.argmin(errors))
            # At equal errors the method without an assumption.
            weight = GUARDS[best] if errors[best] < (1 - GAIN) ** 2 * errors[0] else 0.0
        return _guarded(problem, sigma, weight)


def _guarded(problem: Problem, sigma: Array, weight: float) -> Estimate:
    """Estimate with a weight of the prior of bodies; 0: least squares, which raises EstimationError
    for a motion that does not excite every direction."""
    if weight == 0.0:
        beta, R, _ = scaled_fit(problem, sigma)
        return Estimate(beta, covariance=covariance(R), sigma=sigma, stats={"weight": 0.0})
    sigma = np.maximum(sigma, LEAST_NOISE * torque_rms(problem))
    R = stacked_factor(problem, (1.0 / sigma).tolist())
    W, b, prior = R[:, :-1], R[:, -1], problem.prior
    K, center, is_drawn = problem.base.K, np.zeros(len(W.T)), np.ones(len(W.T), dtype=bool)
    if prior is not None:
        center, std, is_drawn = prior.theta, prior.std, body_columns(problem)
    else:
        norms = np.linalg.norm(W, axis=0)
        K, std = np.eye(len(norms)), np.linalg.norm(b) / np.where(norms > 0, norms, np.inf)
    scales = np.where(is_drawn, np.sqrt(weight), 1.0)
    root = K * (std / scales)
    U, s, Vt = np.linalg.svd(W @ root, full_matrices=False)
    gains = s / (s**2 + 1.0)
    beta = K @ center + root @ (Vt.T @ (gains * (U.T @ (b - W @ (K @ center)))))
    # What the fit makes of an error of the prior, with its declared deviations, and of noise.
    drawn = (root @ (Vt.T * (gains * s)) @ Vt - root) * scales
    spread = np.hstack([drawn, root @ (Vt.T * gains)])
    return Estimate(beta, covariance=spread @ spread.T, stats={"weight": weight})
