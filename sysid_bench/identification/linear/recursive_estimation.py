"""On-line estimation: recursive least squares and a Kalman filter, sample by sample.

Both use whitened rows G_k = W_k / sigma, g_k = f_k / sigma of one sample, with square-root updates
(recursive_qr.py), and start from a prior: without one the estimate diverges before the motion
excites (measured on the iCub's arm: 7 N m of torque error where the CAD model has 0.03).
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from sysid_bench.errors import EstimationError, UsageError
from sysid_bench.identification.linear.least_squares import inverse_of, solve_factor
from sysid_bench.qr_factor import qr_factor
from sysid_bench.types import Array, Problem


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
            used[k] = used[k] and not self._rejects(k, gap[k])
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
        inverse = inverse_of(R)
        return ParameterCurves(
            np.array(indices), np.array(betas), np.array(stds), inverse @ inverse.T, used, gap
        )

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

    def _rejects(self, k: int, innovation: float) -> bool:
        """True for a sample k that looks like a contact; NaN does, too."""
        return self.reject is not None and k >= self.settled and not innovation <= self.reject

    def _check(self) -> None:
        if not 0 < self.forgetting <= 1:
            raise UsageError(f"forgetting is {self.forgetting}; it must be above 0 and at most 1.")
        if self.walk < 0 or self.every < 1:
            raise UsageError(f"{self} is invalid: walk must be 0 or more, every at least 1.")


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


def rows_of(problem: Problem) -> tuple[Array, Array]:
    """W (N, m, r) and f (N, m) of a problem, all samples."""
    parts = list(problem.blocks())
    return np.concatenate([W for W, _ in parts]), np.concatenate([f for _, f in parts])
