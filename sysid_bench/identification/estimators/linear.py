"""Closed-form least squares on the base parameters, without a prior."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.linalg import pinv, qr
from scipy.special import fdtri

from sysid_bench.errors import EstimationError, UnsupportedError
from sysid_bench.identification.linear.least_squares import (
    RESIDUALS,
    check_rank,
    check_weights,
    covariance,
    equations,
    fit_noise,
    inverse_of,
    residual_norm,
    row_std,
    scaled_fit,
    solve,
    solve_factor,
    stacked_factor,
)
from sysid_bench.identification.simulation_based.gauss_newton import (
    regressor_of,
    rows_of,
    weighted_fit,
)
from sysid_bench.types import Array, Estimate, Experiment, Problem, Recording


@dataclass(frozen=True)
class OLS:
    """beta = (W'W)^-1 W'b by QR; covariance s^2 (W'W)^-1, s^2 = |b - W beta|^2 / (M - r).

    Closed form, no settings. Assumes W exact, torque noise white and equal on all rows; physical
    consistency is not imposed. Atkeson, An, Hollerbach (1986); Gautier and Khalil (1990)."""

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the motion does not excite
        every direction."""
        R = stacked_factor(problem)
        beta = solve(R)
        freedom = equations(problem) - problem.base.rank
        squares = float((residual_norm(problem, beta) ** 2).sum())
        inverse = inverse_of(R)
        variance = squares / max(freedom, 1)
        sigma = np.ones(len(problem.rows))
        return Estimate(beta, covariance=variance * inverse @ inverse.T, sigma=sigma)


@dataclass(frozen=True)
class WLS:
    """beta = (W' S^-1 W)^-1 W' S^-1 b by QR, S = diag(sigma_j^2); covariance (W' S^-1 W)^-1.

    sigma_j comes from joint j's own least squares with N_j - b_j degrees of freedom, b_j its base
    parameters: unbiased whatever the noise of the other joints, so that one iteration suffices.
    Each further one of `iterations` uses the residuals of the weighted fit with N_j - tr(H_jj)
    degrees of freedom, H the hat matrix. `weights` "max-torque" divides each row by the largest
    torque of its joint instead, "rms-torque" by its RMS torque, with one common factor from the
    residuals: noise is then taken as the same share of each joint's torque, and `iterations` has no
    effect. Assumes W exact and white
    noise per joint. Gautier (1997); Gautier and Poignet (2001).
    """

    iterations: int = 1
    weights: str = RESIDUALS

    def __post_init__(self) -> None:
        check_weights(self.weights)

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the motion does not excite
        every direction."""
        beta, R, sigma = scaled_fit(problem, row_std(problem, self.weights))
        # Noise as a share of the torque does not depend on the fit: nothing to iterate.
        for _ in range(self.iterations - 1 if self.weights == RESIDUALS else 0):
            beta, R, sigma = scaled_fit(problem, fit_noise(problem, beta, R, sigma))
        stats = {"sigma_ratio": float(sigma.max() / sigma.min())}
        return Estimate(beta, covariance=covariance(R), sigma=sigma, stats=stats)


@dataclass(frozen=True)
class TLS:
    """beta = (W'W - s^2 1)^-1 W'b on unit columns, s the smallest singular value of [W b].

    Assumes independent errors of equal size, relative to the RMS, in all columns of W and in b: the
    result does not depend on units, but on the choice of base parameters. Encoder noise gives
    dependent errors of unequal size, and TLS is then biased. Closed form, no settings. Covariance
    (1 + |beta|^2) s^2 / M (W'W - s^2 1)^-1 to first order. Golub and Van Loan (1980); Van Huffel
    and Vandewalle (1991), section 8.3; Gautier, Vandanjon, Presse (1994).
    """

    frame_dependent: ClassVar[str] = (
        "it depends on the choice of base parameters, and so on the frames of the links"
    )

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the motion does not excite
        every direction or the errors exceed the least excited direction."""
        R = stacked_factor(problem)
        check_rank(R)
        # Unit columns, that of b among them: TLS takes equal errors in all of them, and units would
        # decide what is equal.
        norms = np.linalg.norm(R, axis=0)
        if norms[-1] == 0.0:
            return Estimate(np.zeros(problem.base.rank))
        unit = R / norms
        smallest = np.linalg.svd(unit, compute_uv=False)[-1]
        U, values, Vt = np.linalg.svd(unit[:, :-1], full_matrices=False)
        reduced = values**2 - smallest**2
        # Near zero the difference of squares has lost its digits, and what it divides is noise.
        if reduced[-1] <= 1e-3 * values[-1] ** 2:
            raise EstimationError(
                "Errors in the regressor are as large as its least excited direction: total least "
                "squares has no solution; filter the signals, or record a richer motion."
            )
        scale = norms[-1] / norms[:-1]
        # (W'W - s^2 1)^-1 W'b: noise of variance s^2 has increased every squared singular value.
        beta = Vt.T @ (values / reduced * (U.T @ unit[:, -1]))
        count = max(equations(problem), 1)
        root = Vt.T / np.sqrt(reduced) * smallest * np.sqrt((1 + beta @ beta) / count)
        root = scale[:, None] * root
        stats = {"smallest_singular_value": float(smallest)}
        return Estimate(scale * beta, covariance=root @ root.T, stats=stats)


@dataclass(frozen=True)
class MinNorm:
    """theta = Y^+ tau on all p parameters, singular values below `rcond` of the largest dropped.

    Among all theta with minimal residual it returns the one of smallest norm in SI numbers:
    unobservable parameters become zero, or a share of a sum, and the residual does not show it.
    Only parameters with the verdict "identifiable" have a meaning. rcond = 1e-10 lies between
    rounding and weak excitation. Covariance s^2 (Y'Y)^+ on the base parameters. Closed form.
    Assumes Y exact, torque noise white and equal on all rows. Penrose (1955).
    """

    rcond: float = 1e-10

    def solve(self, problem: Problem) -> Estimate:
        """Return theta and the covariance of beta, also for a rank-deficient regressor."""
        base = problem.base
        R = stacked_factor(problem)
        # Y = W K and R is the factor of [W | tau]: R K has the singular values of Y.
        inverse = pinv(R[:-1, :-1] @ base.K, rtol=self.rcond)
        theta = inverse @ R[:-1, -1]
        freedom = equations(problem) - base.rank
        squares = float((residual_norm(problem, base.K @ theta) ** 2).sum())
        spread = np.sqrt(squares / max(freedom, 1)) * base.K @ inverse
        return Estimate(theta=theta, covariance=spread @ spread.T)


@dataclass(frozen=True)
class Essential:
    """Weighted least squares with backward elimination of base parameters.

    Removes the base parameter of largest relative standard deviation, one at a time, until that is
    at most `ratio` times the smallest, or until an F-test at `level` rejects the removal. Removed
    parameters are zero with zero variance. ratio = 20 lies in the published range of 10 to 30,
    level 0.05 is the usual one. Assumes W exact and white noise per joint; the result depends on
    the choice of base parameters. Pham and Gautier (1991); Gautier and Khalil (1991).
    """

    ratio: float = 20.0
    level: float = 0.05
    frame_dependent: ClassVar[str] = (
        "it depends on the choice of base parameters, and so on the frames of the links"
    )

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the motion does not excite
        every direction."""
        _, full, _ = scaled_fit(problem)
        r = problem.base.rank
        # Rows have unit noise: the residual sum of squares that a removal adds is chi-square.
        freedom = max(equations(problem) - r, 1)
        kept, R = np.arange(r), full
        while len(kept) > 1:
            sizes = np.maximum(np.abs(solve_factor(R)), 1e-300)
            relative = np.linalg.norm(inverse_of(R), axis=1) / sizes
            worst = int(np.argmax(relative))
            if relative[worst] / relative.min() <= self.ratio:
                break
            fewer = np.delete(kept, worst)
            # The QR factor of fewer columns follows from that of all, without the samples.
            smaller = qr(full[:, [*fewer, -1]], mode="r")[0][: len(fewer) + 1]
            # The last diagonal entry of R is the norm of the residual.
            added = (smaller[-1, -1] ** 2 - full[-1, -1] ** 2) / (r - len(fewer))
            if added > fdtri(r - len(fewer), freedom, 1.0 - self.level):
                break
            kept, R = fewer, smaller
        beta, spread = np.zeros(r), np.zeros((r, r))
        beta[kept] = solve_factor(R)
        spread[np.ix_(kept, kept)] = covariance(R)
        return Estimate(beta, covariance=spread, stats={"essential": float(len(kept))})


@dataclass(frozen=True)
class Difference:
    """W beta = mean(tau with payload) - mean(tau without), W the payload's regressor.

    W is taken along the loaded motion; rows of joint j are divided by sigma_j, from the residuals
    of a first fit. The arm's own dynamics cancel where it moves alike with and without the payload;
    where it does not, its known parameters correct the difference. Recordings in the order without,
    with, with, without ("ABBA") cancel linear drift. Closed form by QR. Assumes W exact and white
    noise per joint.
    """

    def fit(self, experiment: Experiment) -> Estimate:
        """Return beta and its covariance; raises UnsupportedError without a recording of each kind,
        EstimationError where the motion does not excite every direction."""
        loaded = [run.recording for run in experiment.runs if run.loaded]
        bare = [run.recording for run in experiment.runs if not run.loaded]
        if not loaded or not bare:
            raise UnsupportedError(
                "The method needs the same motion without the payload: set "
                'signals = { runs = "AB" }, or "ABBA", and the task "payload".'
            )
        W = np.mean([regressor_of(experiment, one.motion) for one in loaded], axis=0)
        b = _mean_torque(experiment, loaded) - _mean_torque(experiment, bare)
        beta, R, _ = weighted_fit(W, b, np.ones(b.shape[1]))
        return Estimate(beta, covariance=covariance(R))


def _mean_torque(experiment: Experiment, recordings: list[Recording]) -> Array:
    """Measured torque (N, rows) minus that of the known parameters, mean over recordings."""
    parts = [rows_of(experiment, one.tau) - experiment.known(one.motion) for one in recordings]
    return np.asarray(np.mean(parts, axis=0))
