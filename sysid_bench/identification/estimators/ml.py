"""Maximum likelihood with noise on positions and torques."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import cholesky_banded, lapack
from scipy.sparse import bsr_array, csr_array, diags_array, eye_array, kron

from sysid_bench.errors import EstimationError
from sysid_bench.identification.estimators.didim_iv import check_estimate
from sysid_bench.identification.linear.least_squares import covariance, solve, stacked_factor
from sysid_bench.identification.simulation_based.forward_model import scalar_joints
from sysid_bench.identification.simulation_based.gauss_newton import (
    SMALL,
    has_converged,
    regressor_of,
    residual_factor,
    rows_of,
    step_rms,
)
from sysid_bench.identification.simulation_based.measured_motion import white_noise
from sysid_bench.types import Array, Estimate, Experiment, Trajectory

NOISE_FLOOR: Final = (1e-13, 1e-10)
"""Least noise of positions and torques, relative to their RMS: rounding."""

RELATIVE_STEP: Final = 1e-6
"""Finite-difference step of the torque, relative to the largest q, v and a."""

SHRINKS: Final = 0.7
"""A step longer than this share of the previous one oscillates: the step length is halved."""


@dataclass(frozen=True)
class ML:
    """Maximum likelihood of beta and the motion under white noise on q and tau, per joint.

    Errors in variables (Olsen, Swevers, Verdonck 2002; Britt, Luecke 1973): the true positions are
    nuisance parameters, v and a their central differences. Each iteration linearises the torque
    about the current motion, weighs its residual with (S_tau + A S_q A')^-1, A = d tau / d q
    (banded), and corrects the motion; no filter is needed. S_q comes from sixth differences of q,
    S_tau from the residual.

    Converged at a step below 0.1 standard deviations, an error that noise hides; a step longer than
    0.7 of the previous one halves the step length, since the published Gauss-Newton steps oscillate
    where positions are noisy. After 30 iterations (the problems of the conformance kit take 3) the
    last iterate is the estimate.
    """

    iterations: int = 30

    def fit(self, experiment: Experiment) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the iteration diverges,
        UnsupportedError for joints without scalar positions."""
        scalar_joints(experiment, "Maximum likelihood")
        # First and second central differences as matrices (N, N), zero at both ends.
        N, rate = len(experiment.raw), experiment.raw.rate
        inside = np.ones(N)
        inside[[0, -1]] = 0
        first = diags_array([-0.5 * rate, 0.5 * rate], offsets=[-1, 1], shape=(N, N))
        second = diags_array([rate**2, -2 * rate**2, rate**2], offsets=[-1, 0, 1], shape=(N, N))
        keep = diags_array(inside)
        data = _Data(experiment, ((keep @ first).tocsr(), (keep @ second).tocsr()))
        beta = start = solve(stacked_factor(experiment.problem))
        q, line = data.q, data.line(beta, data.q)
        sigma = line.torque_noise(line.error.reshape(-1, line.rows), np.zeros(line.rows))
        share, before = 1.0, np.inf
        for count in range(1, self.iterations + 1):
            line = data.line(beta, q)
            R, step, q_new, rest = line.solved(sigma)
            size = step_rms(R, step)
            if has_converged(R, step, beta):
                return Estimate(
                    beta + step, covariance=covariance(R), converged=True, iterations=count,
                    stop=SMALL,
                )  # fmt: skip
            if size > SHRINKS * before:
                share *= 0.5
            before = size
            beta, q = beta + share * step, q + share * (q_new - q)
            sigma = line.torque_noise(rest, sigma)
            if not np.isfinite(beta).all():
                break
        check_estimate(experiment.problem, beta, start)
        stop = f"the limit of {self.iterations} iterations; the last step was {size:.3g} standard"
        return Estimate(
            beta, covariance=covariance(R), converged=False, iterations=count,
            stop=f"{stop} deviations",
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Data:
    """Measured positions and torques, and the difference matrices (N, N) that give v and a."""

    experiment: Experiment
    rates: tuple[csr_array, csr_array]

    @property
    def q(self) -> Array:
        return self.experiment.raw.q

    def motion(self, q: Array) -> Trajectory:
        raw = self.experiment.raw
        if raw.v is not None and raw.a is not None:
            return Trajectory(raw.t, q, raw.v, raw.a)
        return Trajectory(raw.t, q, *(D @ q for D in self.rates))

    def line(self, beta: Array, q: Array) -> "_Line":
        """Torque residual of beta along a motion, linearised in beta and q."""
        experiment, motion = self.experiment, self.motion(q)
        inner = slice(1, len(q) - 1)  # the ends have no differences
        W = regressor_of(experiment, motion)[inner]
        model = W @ beta + experiment.known(motion)[inner]
        tau = rows_of(experiment, experiment.raw.tau)
        exact = experiment.raw.v is not None  # then v and a do not follow from q
        A = self._torque_slope(beta, motion, 0, eye_array(len(q), format="csr")[inner])
        for which, D in enumerate(() if exact else self.rates, 1):
            A = A + self._torque_slope(beta, motion, which, D[inner])
        at_least = NOISE_FLOOR[0] * np.sqrt((self.q**2).mean(axis=0)).max()
        noise = np.maximum(white_noise(self.q), at_least)
        error, away = (tau[inner] - model).ravel(), (self.q - q).ravel()
        return _Line(W, error, A, away, noise, q=q, tau=tau)

    def _torque_slope(self, beta: Array, motion: Trajectory, which: int, D: csr_array) -> csr_array:
        """Share (M rows, N n) of d tau / d q through q, v or a (`which` 0, 1, 2), which is D q."""
        count, n = D.shape[0], motion.q.shape[1]
        arrays, blocks = [motion.q, motion.v, motion.a], []
        for j in range(n):  # derivative (N, rows) of the torque by q, v or a of joint j
            size = RELATIVE_STEP * max(float(np.abs(arrays[which][:, j]).max()), 1e-3)
            sides = []
            for sign in (1, -1):
                moved = [x.copy() for x in arrays]
                moved[which][:, j] += sign * size
                there = Trajectory(motion.t, moved[0], moved[1], moved[2])
                torque = regressor_of(self.experiment, there) @ beta
                sides.append(torque + self.experiment.known(there))
            slope = (sides[0] - sides[1]) / (2 * size)
            if which == 1:  # the jump of Coulomb friction at standstill has no derivative
                slope[np.abs(motion.v[:, j]) <= size] = 0.0
            blocks.append(slope[1:-1])
        # Block-diagonal: a sample's torque depends on the same sample of q, v and a.
        B = bsr_array((np.stack(blocks, axis=-1), np.arange(count), np.arange(count + 1)))
        return csr_array(B @ kron(D, eye_array(n), format="csr"))


@dataclass(frozen=True, eq=False)
class _Line:
    """Linearisation about (beta, q): e = W dbeta + A dq + noise."""

    W: Array  # (M, rows, r)
    error: Array  # (M rows,)
    A: csr_array  # (M rows, N n)
    away: Array  # (N n,) measured less present positions
    q_noise: Array  # (n,)
    q: Array
    tau: Array

    @property
    def rows(self) -> int:
        return int(self.W.shape[1])

    def solved(self, sigma: Array) -> tuple[Array, Array, Array, Array]:
        """QR factor of the whitened rows, the step of beta, the corrected motion and the residual
        (M, rows)."""
        r, M = self.W.shape[-1], len(self.W)
        spread = np.tile(self.q_noise**2, len(self.q))
        weighted = csr_array(self.A @ diags_array(spread))
        # Errors of neighbouring samples are correlated through the differences: C is banded.
        C = weighted @ self.A.T + diags_array(np.tile(sigma**2, M))
        L = _banded_root(C.tocsr(), 3 * self.rows)
        e = self.error - self.A @ self.away
        white = _whiten(L, np.column_stack([self.W.reshape(-1, r), e]))
        R = residual_factor(white[:, None, :r], white[:, r:])
        step = solve(R)
        rest = e - self.W.reshape(-1, r) @ step
        # Positions given the residual: dq = S_q A' C^-1 rest with C = L L'.
        found = _whiten(L, _whiten(L, rest[:, None]), transposed=True)[:, 0]
        q = self.q + (self.away + weighted.T @ found).reshape(self.q.shape)
        return R, step, q, rest.reshape(M, -1)

    def torque_noise(self, rest: Array, before: Array) -> Array:
        """Standard deviation (rows,) of the residual beyond what position noise explains."""
        spread = np.tile(self.q_noise**2, len(self.q))
        explained = (self.A.multiply(self.A) @ spread).reshape(-1, self.rows).mean(axis=0)
        total = (rest**2).mean(axis=0)
        floor = NOISE_FLOOR[1] ** 2 * (self.tau**2).mean(axis=0)
        # Position noise may explain more than there is, by chance.
        left = np.maximum(total - explained, 0.01 * total)
        return np.asarray(np.sqrt(np.maximum(left, np.maximum(floor, floor.max() * 1e-6))))


def _banded_root(C: csr_array, width: int) -> Array:
    """Lower Cholesky factor of a banded matrix, in LAPACK's band storage."""
    coo = C.tocoo()
    band = np.zeros((width, C.shape[0]))
    low = coo.row >= coo.col
    band[(coo.row - coo.col)[low], coo.col[low]] = coo.data[low]
    try:
        return cholesky_banded(band, lower=True)
    except np.linalg.LinAlgError as error:
        raise EstimationError("The covariance of the residuals is singular.") from error


def _whiten(L: Array, rows: Array, transposed: bool = False) -> Array:
    """L^-1 rows, or L'^-1 rows."""
    solved, info = lapack.dtbtrs(L, rows, uplo="L", trans="T" if transposed else "N")
    if info != 0:
        raise np.linalg.LinAlgError(f"dtbtrs refused its argument {info}.")
    return np.asarray(solved)
