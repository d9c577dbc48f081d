"""Parameters on-line: recursive least squares and a Kalman filter, sample after sample.

Both work on whitened rows G_k = W_k / sigma, g_k = f_k / sigma of one sample each, several rows at
a time, in covariance form, which starts from a prior: without one the estimate runs wild before the
motion excites (measured on the iCub's arm: 7 N m of torque error where the CAD model has 0.03).
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from sysid_bench.errors import EstimationError, UsageError
from sysid_bench.types import Array, Problem


@dataclass(frozen=True, eq=False)
class Track:
    """How the estimate went: `beta` (K, r) and its standard deviations `std` (K, r) after the
    samples `places` (K,), the last one among them; `used` of the samples (N,), and the `gap` (N,)
    between each sample and its forecast, as chi-square per row."""

    places: Array
    beta: Array
    std: Array
    covariance: Array
    used: Array
    gap: Array

    @property
    def last(self) -> Array:
        """The estimate (r,) after the last sample."""
        return np.asarray(self.beta[-1])


@dataclass(frozen=True)
class Recursion:
    """Recursive least squares, or a Kalman filter where parameters wander.

    `forgetting`: weight of all that came before, per sample. `walk`: standard deviation of a random
    walk per root sample, as a share of the prior's (the Kalman version). With `gate`, forgetting
    and walk make nothing less certain than the prior: without excitation the covariance would blow
    up; and the answer stays the prior until more directions are told than one posture at rest can
    tell, the rows of a sample: fitting that posture alone may spoil all others. `reject`: samples
    whose forecast misses by more than this chi-square per row are left out, as contacts are, once
    the filter is `settled` (samples). `every`: history kept.
    """

    forgetting: float = 1.0
    walk: float = 0.0
    gate: bool = True
    reject: float | None = None
    settled: int = 500
    every: int = 25

    def run(
        self,
        W: Array,
        f: Array,
        sigma: Array,
        prior: Array,
        std: Array,
        free: Array | None = None,
    ) -> Track:
        """The track of f (N, m) = W (N, m, r) beta + noise of `sigma` (m,), from beta = `prior`
        (r,) with a covariance: (r,) standard deviations or (r, r). `free` (N,): samples without
        contact; the others are left out. Raises UsageError for settings that make no filter."""
        self._check()
        G, g = W / sigma[:, None], f / sigma
        P = np.diag(std**2) if std.ndim == 1 else std.copy()
        start, beta = P.copy(), prior.astype(float).copy()
        used = np.ones(len(f), dtype=bool) if free is None else np.asarray(free, dtype=bool).copy()
        gap = np.empty(len(f))
        places, betas, stds, last = [], [], [], len(f) - 1
        held = self.gate and len(beta) > f.shape[1]
        m, root = g.shape[1], np.linalg.cholesky(start)
        for k in range(len(f)):
            if self.walk > 0 or self.forgetting < 1:
                P = self._aged(P, root)
            PG = P @ G[k].T
            S = G[k] @ PG + np.eye(m)
            e = g[k] - G[k] @ beta
            factor = cho_factor(S, lower=True, check_finite=False)
            gap[k] = e @ cho_solve(factor, e, check_finite=False) / m
            if self.reject is not None and k >= self.settled and not gap[k] <= self.reject:
                used[k] = False
            if used[k]:
                L = cho_solve(factor, PG.T, check_finite=False).T
                beta = beta + L @ e
                # Joseph's form: stays positive definite where the short one drifts.
                keep = np.eye(len(beta)) - L @ G[k]
                P = keep @ P @ keep.T + L @ L.T
            if k % self.every == 0 or k == last:
                held = held and _told(P, start) <= f.shape[1]
                places.append(k)
                betas.append(prior if held else beta)
                stds.append(np.sqrt(np.diag(P)))
        if not betas:
            raise EstimationError("There are no samples to estimate from.")
        return Track(np.array(places), np.array(betas), np.array(stds), P, used, gap)

    def _aged(self, P: Array, root: Array) -> Array:
        """The covariance before the next sample; root root' is the prior's. In the directions in
        which both are diagonal, shares of the prior's variance grow: with the gate, to one."""
        inverse = solve_triangular(root, np.eye(len(root)), lower=True)
        shares, V = np.linalg.eigh(inverse @ P @ inverse.T)
        shares = shares / self.forgetting + self.walk**2
        if self.gate:
            shares = np.minimum(shares, 1.0)
        axes = root @ V
        return np.asarray(axes * shares @ axes.T)

    def _check(self) -> None:
        if not 0 < self.forgetting <= 1:
            raise UsageError(f"Forgetting is {self.forgetting}; it lies above 0 and up to 1.")
        if self.walk < 0 or self.every < 1:
            raise UsageError(f"{self} is no filter: walk is 0 or more, every at least 1.")


def _told(P: Array, start: Array) -> int:
    """How many directions have less than half of the deviation they started with."""
    shares = np.linalg.eigvals(np.linalg.solve(start, P)).real
    return int((shares < 0.25).sum())


def rows_of(problem: Problem) -> tuple[Array, Array]:
    """W (N, m, r) and f (N, m) of a problem, all samples."""
    parts = list(problem.blocks())
    return np.concatenate([W for W, _ in parts]), np.concatenate([f for _, f in parts])


def batch(
    W: Array, f: Array, sigma: Array, prior: Array, std: Array, free: Array | None = None
) -> Array:
    """What the recursion without forgetting ends with (r,), in one least-squares solution."""
    keep = slice(None) if free is None else np.asarray(free, dtype=bool)
    G, g = (W / sigma[:, None])[keep], (f / sigma)[keep]
    root = np.diag(1.0 / std) if std.ndim == 1 else np.linalg.inv(np.linalg.cholesky(std))
    stack = np.vstack([G.reshape(-1, G.shape[-1]), root])
    told = np.concatenate([g.ravel(), root @ prior])
    return np.asarray(np.linalg.lstsq(stack, told, rcond=None)[0])
