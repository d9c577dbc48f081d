"""Recursive estimation by square-root updates: least squares with forgetting, Kalman filters.

On-line estimates use whitened rows G_k = W_k / sigma, g_k = f_k / sigma of one sample, and start
from a prior: without one the estimate diverges before the motion excites (measured on the iCub's
arm: 7 N m of torque error where the CAD model has 0.03)."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from sysid_bench.errors import EstimationError, UsageError
from sysid_bench.identification.feasibility.feasible_set import find_prior
from sysid_bench.identification.linear.least_squares import (
    check_rank,
    covariance,
    inverse_of,
    row_noise,
    solve_factor,
    stacked_factor,
)
from sysid_bench.numerics import qr_factor
from sysid_bench.types import Array, Estimate, Problem


def update(problem: Problem, sigma: Array, forgetting: float) -> Array:
    """R (r + 1, r + 1) of all samples, rows divided by `sigma` (rows,), sample k of N times
    forgetting^((N - 1 - k) / 2): exponential forgetting of the squares."""
    R = np.zeros((problem.base.rank + 1,) * 2)
    for Y, b in problem.blocks():
        # R holds square roots of weights: hence half of the exponent.
        R = rank_update(R * forgetting ** (0.5 * len(b)), Y, b, sigma, forgetting)
    return R


def rank_update(R: Array, Y: Array, b: Array, sigma: Array, forgetting: float = 1.0) -> Array:
    """R (r + 1, r + 1) updated by the rows (n, rows, r) and torques (n, rows) of one block."""
    root = forgetting ** (0.5 * np.arange(len(b) - 1, -1, -1))[:, None] / sigma
    rows = np.concatenate([Y * root[..., None], (b * root)[..., None]], axis=-1)
    return qr_factor([R, rows.reshape(-1, len(R))])


@dataclass(frozen=True)
class RLS:
    """Recursive least squares; sample k of N counts with the weight forgetting^(N - k).

    Square-root form (QR update of [R | z] per block): no start value, no accumulated rounding. Rows
    are divided by the noise of their joint (as `wls`, which forgetting = 1 reproduces). The default
    0.999 remembers about 1000 samples. Covariance for white noise and constant parameters. Assumes
    W exact. Ljung and Soederstroem (1983); Haykin, Adaptive Filter Theory.
    """

    forgetting: float = 0.999

    def solve(self, problem: Problem) -> Estimate:
        """Return beta after the last sample and its covariance; raises EstimationError where the
        remembered samples do not excite every direction, UsageError for an invalid forgetting
        factor."""
        _check_forgetting(self.forgetting)
        sigma = row_noise(problem)
        R = update(problem, sigma, self.forgetting)
        check_rank(R)
        # Weights g^(N - k) make the covariance H^-1 H2 H^-1, H2 with the weights squared.
        squared = update(problem, sigma, self.forgetting**2)[:-1, :-1]
        spread = covariance(R) @ squared.T
        memory = float(np.sum(self.forgetting ** np.arange(problem.samples)))
        return Estimate(solve_factor(R), covariance=spread @ spread.T, stats={"memory": memory})


@dataclass(frozen=True)
class Kalman:
    """beta_(k+1) = beta_k + w_k, b_k = W_k beta_k + v_k; returns beta after the last sample.

    v has the noise of each joint (as `wls`). `drift`: standard deviation of the walk over the whole
    recording relative to that of the prior, parameter by parameter; the default 0 gives `wls`,
    since the start is diffuse. Square-root information filter (Bierman 1977, chapter 5); the walk
    takes a step every `hold` samples (20: parameters drift slowly against the sampling). Assumes W
    exact, white noise. Gautier and Poignet (2001).
    """

    drift: float = 0.0
    hold: int = 20

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the motion does not excite
        every direction, or where a drift has no prior to scale it; UsageError for invalid settings.
        """
        if self.drift < 0 or self.hold < 1:
            raise UsageError(f"{self} is invalid: drift must be 0 or more, hold at least 1.")
        check_rank(stacked_factor(problem))
        sigma, r = row_noise(problem), problem.base.rank
        walk = None
        if self.drift > 0:
            # Square root S (r, r) of the covariance S S' of one step of the walk.
            steps = max(problem.samples / self.hold, 1.0)
            spread = problem.base.K * find_prior(problem).std
            walk = qr_factor([spread.T]).T * self.drift / np.sqrt(steps)
        R, still = np.zeros((r + 1, r + 1)), np.eye(r, 2 * r + 1)
        for Y, b in problem.blocks():
            for start in range(0, len(b), self.hold):
                if walk is not None:
                    # One step beta + S u of the walk: u is eliminated by QR from the rows
                    # [1, 0; -R S, R] of (u, beta + S u).
                    moved = np.hstack([-R[:, :r] @ walk, R])
                    R = qr_factor([np.vstack([still, moved])])[r:, r:]
                part = slice(start, start + self.hold)
                R = rank_update(R, Y[part], b[part], sigma)
        return Estimate(solve_factor(R), covariance=covariance(R))


@dataclass(frozen=True, eq=False)
class ParameterCurves:
    """Estimates over time: `beta` and its standard deviations `std` (K, r) after the samples
    `indices` (K,), the last sample included; which samples are `used` (N,), and the normalised
    innovation squared `gap` (N,) of each sample, per row."""

    indices: Array
    beta: Array
    std: Array
    covariance: Array
    used: Array
    gap: Array

    @property
    def estimate(self) -> Array:
        """The estimate (r,) after the last sample."""
        return np.asarray(self.beta[-1])


@dataclass(frozen=True)
class RecursiveEstimator:
    """Recursive least squares, or a Kalman filter for drifting parameters.

    `forgetting`: weight of all earlier samples, per sample. `walk`: standard deviation of a random
    walk per root sample, relative to the prior's. `gate`: forgetting and walk never exceed the
    prior variance (no covariance wind-up), and the estimate stays the prior until more directions
    are informed than the rows of one sample can, since fitting one posture may spoil all others.
    `reject`: samples with a larger normalised innovation, as contacts have, are left out after
    `settled` samples. `every`: history kept.
    """

    forgetting: float = 1.0
    walk: float = 0.0
    gate: bool = True
    reject: float | None = None
    settled: int = 500
    every: int = 25

    def run(
        self, W: Array, f: Array, sigma: Array, prior: Array, std: Array, free: Array | None = None
    ) -> ParameterCurves:
        """Return the track of f (N, m) = W (N, m, r) beta + noise of standard deviation `sigma`
        (m,).

        `prior` (r,) and `std`, standard deviations (r,) or a covariance (r, r), start it; samples
        that are not `free` (N,) of contact are left out. Raises UsageError for invalid settings,
        EstimationError without samples.
        """
        self._check()
        G, g = W / sigma[:, None], f / sigma
        start, r, m = _factor_of(prior, std), len(prior), f.shape[1]
        used = np.ones(len(f), dtype=bool) if free is None else np.asarray(free, dtype=bool).copy()
        gap = np.empty(len(f))
        indices, betas, stds, last = [], [], [], len(f) - 1
        held, R, beta = self.gate and r > m, start, prior
        for k in range(len(f)):
            R = self._aged(R, start, beta)
            gap[k] = _innovation(R, G[k], g[k] - G[k] @ beta)
            if self._looks_like_contact(k, gap[k]):
                used[k] = False
            if used[k]:
                R = qr_factor([R, np.column_stack([G[k], g[k]])])
                beta = solve_factor(R)
            if k % self.every == 0 or k == last:
                # Once released, the estimate stays released, also where forgetting loses
                # information again.
                held = held and _informed_directions(R, start) <= m
                indices.append(k)
                betas.append(prior if held else beta)
                stds.append(np.linalg.norm(inverse_of(R), axis=1))
        if not betas:
            raise EstimationError("There are no samples to estimate from.")
        return ParameterCurves(
            np.array(indices), np.array(betas), np.array(stds), covariance(R), used, gap
        )

    def _looks_like_contact(self, k: int, gap: float) -> bool:
        """True for an innovation beyond the limit, or NaN, once the estimate has settled."""
        return self.reject is not None and k >= self.settled and not gap <= self.reject

    def _check(self) -> None:
        _check_forgetting(self.forgetting)
        if self.walk < 0 or self.every < 1:
            raise UsageError(f"{self} is invalid: walk must be 0 or more, every at least 1.")

    def _aged(self, R: Array, start: Array, beta: Array) -> Array:
        """[R | z] before the next sample. In the basis where it and the prior are both diagonal,
        the variances relative to the prior grow, with the gate to at most one."""
        if self.walk == 0 and self.forgetting == 1:
            return R
        r = len(beta)
        root = inverse_of(start)
        _, singular, Vt = np.linalg.svd(R[:r, :r] @ root)
        # Singular values of R R0^-1 are ratios of prior to present standard deviations.
        shares = singular**-2 / self.forgetting + self.walk**2
        if self.gate:
            shares = np.minimum(shares, 1.0)
        older = (Vt / np.sqrt(shares)[:, None]) @ start[:r, :r]
        return qr_factor([np.column_stack([older, older @ beta]), np.zeros((1, r + 1))])


def _check_forgetting(forgetting: float) -> None:
    if not 0 < forgetting <= 1:
        raise UsageError(f"forgetting is {forgetting}; it must be above 0 and at most 1.")


def _innovation(R: Array, G: Array, e: Array) -> float:
    """Normalised innovation squared e' (1 + G P G')^-1 e / m of one sample: G (m, r), e (m,), and
    P = (R'R)^-1 the covariance of beta."""
    r, m = len(R) - 1, len(e)
    # G P G' = V' V with V = R^-T G': P itself is never formed.
    V = solve_triangular(R[:r, :r], G.T, trans="T", check_finite=False)
    return float(e @ np.linalg.solve(np.eye(m) + V.T @ V, e) / m)


def _factor_of(prior: Array, std: Array) -> Array:
    """[R | z] (r + 1, r + 1) of a prior with standard deviations (r,) or a covariance (r, r)."""
    r = len(prior)
    # With P = L L', rows L^-1 [1, prior] have unit noise, as measured rows have.
    root = np.diag(std) if std.ndim == 1 else np.linalg.cholesky(std)
    whitened = solve_triangular(root, np.column_stack([np.eye(r), prior]), lower=True)
    return qr_factor([whitened, np.zeros((1, r + 1))])


def _informed_directions(R: Array, start: Array) -> int:
    """Number of directions whose standard deviation is below half of the prior's."""
    r = len(R) - 1
    singular = np.linalg.svd(R[:r, :r] @ inverse_of(start), compute_uv=False)
    return int((singular > 2.0).sum())
