"""Least squares reweighted by its residuals: outliers, noise across joints, noise in time."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import erfc, sqrt

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.special import chdtr, chdtri

from sysid_bench.errors import EstimationError
from sysid_bench.identification.linear.least_squares import with_floor
from sysid_bench.identification.linear.reweighted_rows import (
    Loss,
    Reweighting,
    ScaledRows,
    information_factor,
    m_estimate,
    m_estimate_result,
    reweighted_fit,
    row_scale,
    scaled_rows,
)
from sysid_bench.types import Array, Estimate, Experiment, Problem, RowBlock


@dataclass(frozen=True)
class Huber:
    """M-estimate with the weights min(1, cut / |r / s|), s the robust scale of each joint (MAD).

    Iteratively reweighted least squares from `wls`, until a step changes the torques by less than
    1e-10 of them; of 200 iterations the problems of the conformance kit take 18. cut = 1.345 has 95
    % of the efficiency of least squares under Gaussian noise. Assumes W exact; outliers in the
    torques alone. Huber (1964); Holland and Welsch (1977).
    """

    cut: float = 1.345
    iterations: int = 200

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the motion does not excite
        every direction."""
        rows, start = scaled_rows(problem)
        loss = huber_loss(self.cut)
        return m_estimate_result(problem, loss, *m_estimate(rows, loss, start, self.iterations))


def huber_loss(cut: float) -> Loss:
    """Return psi(u) = u for |u| <= cut, cut sign(u) beyond."""

    def weight(u: Array) -> Array:
        return np.asarray(cut / np.maximum(np.abs(u), cut))

    return Loss(weight, lambda u: (np.abs(u) < cut).astype(float))


@dataclass(frozen=True)
class Tukey:
    """M-estimate with the weights (1 - (r / s / cut)^2)^2 for |r / s| <= cut, zero beyond.

    Iteratively reweighted least squares from Huber's estimate, whose scales s it holds: the loss is
    not convex, so that the start decides between local minima. Stops where a step changes the
    torques by less than 1e-10 of them. cut = 4.685 has 95 % of the efficiency of least squares
    under Gaussian noise. Assumes W exact; outliers in the torques alone. Beaton and Tukey (1974);
    Holland, Welsch (1977).
    """

    cut: float = 4.685
    iterations: int = 200

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the motion does not excite
        every direction."""
        rows, start = scaled_rows(problem)
        first, scales = m_estimate(rows, huber_loss(Huber.cut), start, self.iterations)
        loss = tukey_loss(self.cut)
        fit = m_estimate(rows, loss, first.beta, self.iterations, scales)
        return m_estimate_result(problem, loss, *fit)


def tukey_loss(cut: float) -> Loss:
    """Return psi(u) = u (1 - (u / cut)^2)^2 for |u| <= cut, zero beyond."""

    def inside(u: Array) -> Array:
        return np.maximum(1.0 - (u / cut) ** 2, 0.0)

    return Loss(lambda u: inside(u) ** 2, lambda u: inside(u) * (1.0 - 5.0 * (u / cut) ** 2))


HOLD_AFTER = 10
"""Iterations after which the set of rejected samples is held: it could alternate forever."""


@dataclass(frozen=True)
class IRLS:
    """Samples whitened by the covariance Lambda (rows, rows) of their residuals across joints.

    Lambda is updated from the residuals until a step changes the torques by less than 1e-10 of
    them. Samples whose chi-square is as improbable as `cut` standard deviations of one variable are
    rejected (3: one of 370); Lambda is corrected for the variance that rejection removes, with
    sqrt((N - b_i)(N - b_j)) degrees of freedom, b_j base parameters on joint j. Assumes W exact and
    noise white in time. Han, Wu, Liu, Xiong (2020).
    """

    cut: float = 3.0
    iterations: int = 100

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and the covariance of the whitened rows; raises EstimationError where the
        motion does not excite every direction."""
        rows, beta = scaled_rows(problem)
        # Joints that no parameter acts on have no residual to whiten.
        felt = np.array([len(factor.columns) > 0 for factor in problem.factors])
        k = int(felt.sum())
        # Chi-square of k Gaussian variables that is exceeded as often as `cut` by one of them, and
        # the share of their variance within it.
        farthest = float(chdtri(k, erfc(self.cut / sqrt(2)))) if self.cut < 30 else np.inf
        share = float(chdtr(k + 2, farthest) / chdtr(k, farthest)) if farthest < np.inf else 1.0
        residual = rows.residual(rows.R @ beta)
        # Robust scales first: in a plain covariance an outlier would hide itself.
        whiten = np.diag(1 / row_scale(problem, residual)[felt])
        counted = np.ones(len(residual), dtype=bool)

        def weigh(residual: Array, iteration: int) -> Reweighting:
            nonlocal whiten, counted
            residual = residual[:, felt]
            if iteration <= HOLD_AFTER:
                counted = ((residual @ whiten.T) ** 2).sum(axis=1) <= farthest
            whiten = _whitening(problem, felt, residual * counted[:, None] / np.sqrt(share))
            weighted = np.zeros((len(residual), len(felt)))
            weighted[:, felt] = (residual @ whiten.T @ whiten) * counted[:, None]
            # Scaled samples, whitened across joints, without the rejected ones.
            return Reweighting(
                lambda: (whiten @ Q[kept][:, felt] for Q, kept in rows.samples(counted)), weighted
            )

        fit = reweighted_fit(rows, beta, self.iterations, weigh, HOLD_AFTER)
        root = information_factor(fit.last.blocks())
        rejected = float(len(counted) - counted.sum())
        return fit.estimate(rows.covariance(root), {"left_out": rejected})


def _whitening(problem: Problem, felt: Array, residual: Array) -> Array:
    """C^-1/2 D^-1 (k, k) of the covariance D C D of residuals (N, k), D their standard deviations.

    The symmetric root treats all joints alike; a floor above rounding keeps the covariance of exact
    data regular.
    """
    acting = np.array([len(factor.columns) for factor in problem.factors])[felt]
    freedom = np.maximum(np.count_nonzero(residual.any(axis=1)) - acting, 1.0)
    floor = with_floor(problem, np.zeros(len(problem.factors)))[felt]
    deviations = np.sqrt((residual**2).sum(axis=0) / freedom + floor**2)
    scaled = residual / np.sqrt(freedom) / deviations
    values, axes = np.linalg.eigh(scaled.T @ scaled + np.diag((floor / deviations) ** 2))
    return np.asarray((axes / np.sqrt(np.maximum(values, 1e-12))) @ axes.T / deviations)


@dataclass(frozen=True)
class ArGls:
    """Least squares on rows whitened by an AR model of each joint's noise.

    e_t = -a_1 e_(t-1) - ... - a_order e_(t-order) + w_t; the coefficients come from the residuals
    (Yule-Walker equations), then beta from the whitened rows, repeated until a step changes the
    torques by less than 1e-10 of them, at most 50 times (the problems of the conformance kit take
    16). The first `order` samples are dropped (Cochrane and Orcutt 1949).

    Where an experiment is given, b is the raw measured torque: a zero-phase filter leaves residuals
    without power beyond its cut-off, which no AR model of low order describes. Without one, or with
    several motions, b is that of the problem, and the residuals must not have been filtered. Order
    4 models two resonances. Assumes W exact and samples in the order of time at a steady rate: with
    encoder noise the errors of the filtered motion are part of the residuals, and whitening weighs
    them up, so that suites do not rank it. The raw torque has all samples, since whitening needs a
    steady rate: those at standstill, which the default pipeline leaves out of other fits, count.
    """

    order: int = 4
    iterations: int = 50

    def fit(self, experiment: Experiment) -> Estimate:
        """Return the estimate of `solve` from raw torques along the measured, filtered motion."""
        problem, raw, recording = experiment.problem, experiment.raw, experiment.recording
        # Half a step earlier: rounding of the times cannot select the next sample.
        samples = np.searchsorted(raw.t, recording.t - 0.5 / raw.rate)
        columns = [raw.rows.index(row) for row in problem.rows]
        motion = recording.motion
        b = raw.tau[samples][:, columns] - experiment.known(motion)

        def blocks() -> Iterator[RowBlock]:
            start = 0
            for W in experiment.regress(motion):
                yield W, b[start : start + len(W)]
                start += len(W)

        W = np.concatenate([block for block, _ in blocks()])
        factors = []
        for j, factor in enumerate(problem.factors):
            rows = np.column_stack([W[:, j][:, factor.columns], b[:, j]])
            R = np.asarray(np.linalg.qr(rows, mode="r"))
            factors.append(replace(factor, R=R, samples=len(b)))
        return self.solve(replace(problem, blocks=blocks, factors=tuple(factors), samples=len(b)))

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and the covariance of the whitened rows.

        Raises EstimationError where the recording is too short or does not excite every direction.
        """
        if problem.samples <= 4 * self.order:
            raise EstimationError(
                f"{problem.samples} samples are too few for noise of order {self.order}; record a "
                "longer motion, or use the method 'wls'."
            )
        rows, beta = scaled_rows(problem)
        # Columns of each row and coefficients of its filter are estimated from its samples.
        acting = np.array([len(factor.columns) for factor in problem.factors])
        freedom = np.maximum(problem.samples - 2 * self.order - acting, 1)
        taps = np.zeros((len(acting), self.order + 1))

        def weigh(residual: Array, _: int) -> Reweighting:
            nonlocal taps
            taps = np.array([_whitening_filter(column, self.order) for column in residual.T])
            white = _filtered(residual, taps)
            sigma = with_floor(problem, np.sqrt((white**2).sum(axis=0) / freedom))
            scaled, white = taps / sigma[:, None], white / sigma**2
            # v (N, rows) with v'x = white' filtered(x): the adjoint runs backwards in time.
            values = np.zeros_like(residual)
            for k in range(self.order + 1):
                start = self.order - k
                values[start : start + len(white)] += taps[:, k] * white
            return Reweighting(lambda: _filtered_blocks(rows, scaled), values)

        fit = reweighted_fit(rows, beta, self.iterations, weigh)
        root = information_factor(fit.last.blocks())
        poles = [float(np.abs(np.roots(tap)).max(initial=0.0)) for tap in taps]
        return fit.estimate(rows.covariance(root), {"largest_pole": max(poles)})


def _whitening_filter(noise: Array, order: int) -> Array:
    """Filter [1, a_1, ..., a_order] that whitens a series (N,), by the Yule-Walker equations."""
    # Biased autocorrelations (divided by N, not N - k): the model is always stable.
    lags = np.array([noise[k:] @ noise[: len(noise) - k] for k in range(order + 1)])
    if order == 0 or lags[0] == 0.0:
        return np.concatenate([[1.0], np.zeros(order)])
    return np.concatenate([[1.0], solve_toeplitz(lags[:-1], -lags[1:])])


def _filtered_blocks(rows: ScaledRows, taps: Array) -> Iterator[Array]:
    """Scaled samples filtered in time, block by block, without the first `order` of them."""
    order = taps.shape[1] - 1
    past: Array | None = None
    for Q, _ in rows.blocks():
        Q = Q if past is None else np.concatenate([past, Q])
        if len(Q) > order:
            yield _filtered(Q, taps[..., None])
        # -order as start would keep everything for order 0.
        past = Q[len(Q) - min(order, len(Q)) :]


def _filtered(values: Array, taps: Array) -> Array:
    """sum_k taps_k (rows, order + 1, ...) values_(t - k) (N, rows, ...): (N - order, rows, ...)."""
    order = taps.shape[1] - 1
    count = len(values) - order
    return np.asarray(
        sum(taps[:, k] * values[order - k : order - k + count] for k in range(order + 1))
    )
