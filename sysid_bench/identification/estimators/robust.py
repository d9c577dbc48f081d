"""Least squares reweighted by its residuals: outliers, noise across joints, noise in time."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import erfc, sqrt

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.special import chdtr, chdtri

from sysid_bench.errors import EstimationError
from sysid_bench.identification.linear.least_squares import row_ranks, with_floor
from sysid_bench.identification.linear.refined_fit import fixed_point, refined_m_estimate
from sysid_bench.identification.linear.reweighted_rows import (
    Loss,
    StreamedRows,
    Weighting,
    m_estimate,
    m_estimate_result,
    row_scale,
    streamed_rows,
)
from sysid_bench.numerics import qr_factor
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
        rows, start = streamed_rows(problem)
        loss = huber_loss(self.cut)
        fit = refined_m_estimate(rows, [loss], start, self.iterations)
        fit = fit or m_estimate(rows, loss, start, self.iterations)
        return m_estimate_result(rows, loss, *fit)


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
        rows, start = streamed_rows(problem)
        losses = [huber_loss(Huber.cut), tukey_loss(self.cut)]
        fit = refined_m_estimate(rows, losses, start, self.iterations)
        if fit is None:
            first, scales = m_estimate(rows, losses[0], start, self.iterations)
            fit = m_estimate(rows, losses[1], first.beta, self.iterations, scales)
        return m_estimate_result(rows, losses[1], *fit)


def tukey_loss(cut: float) -> Loss:
    """Return psi(u) = u (1 - (u / cut)^2)^2 for |u| <= cut, zero beyond."""

    def inside(u: Array) -> Array:
        return np.maximum(1.0 - (u / cut) ** 2, 0.0)

    return Loss(lambda u: inside(u) ** 2, lambda u: inside(u) * (1.0 - 5.0 * (u / cut) ** 2))


HOLD_AFTER = 10
"""Iterations after which the set of rejected samples is held: it could alternate forever."""

HOLD_STEP = 0.03
"""Step, in standard deviations, after which it is held as well: of some 10,000 samples or more, few
that are at the edge of the set change the estimate by as much."""


@dataclass(frozen=True)
class IRLS:
    """Samples whitened by the covariance Lambda (rows, rows) of their residuals across joints.

    Lambda is updated from the residuals until a step changes the torques by less than 1e-10 of
    them. Samples whose chi-square is as improbable as `cut` standard deviations of one variable are
    rejected (3: one of 370); Lambda is corrected for the variance that rejection removes, with
    sqrt((N - b_i)(N - b_j)) degrees of freedom, b_j the rank of the rows of joint j. Assumes W
    exact and noise white in time. Han, Wu, Liu, Xiong (2020).
    """

    cut: float = 3.0
    iterations: int = 100

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and the covariance of the whitened rows; raises EstimationError where the
        motion does not excite every direction."""
        rows, beta = streamed_rows(problem)
        # Joints that no parameter acts on have no residual to whiten.
        acting = row_ranks(problem)
        felt = acting > 0
        k = int(felt.sum())
        # Chi-square of k Gaussian variables that is exceeded as often as `cut` by one of them.
        farthest = float(chdtri(k, erfc(self.cut / sqrt(2)))) if self.cut < 30 else np.inf

        def weights(some: StreamedRows, beta: Array) -> _AcrossJoints:
            # Robust scales first: in a plain covariance an outlier would hide itself.
            whiten = np.diag(1 / row_scale(some, beta)[felt])
            return _AcrossJoints(some.problem, acting, farthest, whiten)

        fit, part, used = fixed_point(rows, beta, self.iterations, weights, hold_after=HOLD_AFTER)
        rejected = float(problem.samples - used.counted.sum())
        return fit.estimate(rows.covariance(fit.beta, fit.weighting, part), {"left_out": rejected})


class _AcrossJoints:
    """Weights of samples whitened by the covariance of their residuals, without those whose squares
    are above `farthest`; these are held after HOLD_AFTER changes."""

    def __init__(self, problem: Problem, acting: Array, farthest: float, whiten: Array) -> None:
        self.problem, self.acting, self.farthest, self.whiten = problem, acting, farthest, whiten
        self.felt, k = acting > 0, len(whiten)  # rank of each row; zero where nothing acts
        # The share of the variance of k Gaussian variables within `farthest`.
        self.share = (
            float(chdtr(k + 2, farthest) / chdtr(k, farthest)) if farthest < np.inf else 1.0
        )
        self.counted = np.ones(problem.samples, dtype=bool)
        self.changes, self.held = 0, False
        self.products, self.used = np.zeros((k, k)), 0

    def see(self, e: Array, start: int) -> None:
        """Take in residuals e (n, rows)."""
        e, part = e[:, self.felt], slice(start, start + len(e))
        if not self.held:
            self.counted[part] = ((e @ self.whiten.T) ** 2).sum(axis=1) <= self.farthest
        kept = e[self.counted[part]]
        self.products += kept.T @ kept
        self.used += int(np.count_nonzero(kept.any(axis=1)))

    def change(self, step: float = np.inf) -> None:
        """Whiten by the covariance of the residuals seen since the last call."""
        self.whiten = _whitening(self.problem, self.acting, self.products / self.share, self.used)
        self.changes += 1
        self.held = self.held or self.changes >= HOLD_AFTER or step < HOLD_STEP
        self.products, self.used = np.zeros_like(self.products), 0

    def of(self, problem: Problem) -> "_AcrossJoints":
        """The same whitening for the samples of another problem."""
        return _AcrossJoints(problem, self.acting, self.farthest, self.whiten)

    def weighting(self) -> Weighting:
        """The weights of now."""
        whiten, felt, counted = self.whiten, self.felt, self.counted

        def values(e: Array, start: int) -> Array:
            weighted = np.zeros_like(e)
            weighted[:, felt] = e[:, felt] @ whiten.T @ whiten
            return np.asarray(weighted * counted[start : start + len(e), None])

        def rows(Q: Array, e: Array, samples: Array | None) -> Array:
            if samples is None:
                used = ((e[:, felt] @ whiten.T) ** 2).sum(axis=1) <= self.farthest
            else:
                used = counted[samples]
            return np.asarray(whiten @ Q[used][:, felt])

        return Weighting(values, rows)


def _whitening(problem: Problem, acting: Array, products: Array, used: int) -> Array:
    """C^-1/2 D^-1 (k, k) of the covariance D C D of `used` residuals with the sums of products
    (k, k), D their standard deviations.

    The symmetric root treats all joints alike; a floor above rounding keeps the covariance of exact
    data regular.
    """
    felt = acting > 0
    freedom = np.maximum(used - acting[felt], 1.0)
    floor = with_floor(problem, np.zeros(len(problem.factors)))[felt]
    deviations = np.sqrt(np.diag(products) / freedom + floor**2)
    scale = np.sqrt(freedom) * deviations
    noise = products / np.outer(scale, scale) + np.diag((floor / deviations) ** 2)
    values, axes = np.linalg.eigh(noise)
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

        R = [np.zeros((0, len(factor.columns) + 1)) for factor in problem.factors]
        for W, torque in blocks():
            for j, factor in enumerate(problem.factors):
                R[j] = qr_factor(
                    [R[j], np.column_stack([W[:, j][:, factor.columns], torque[:, j]])]
                )
        pairs = zip(problem.factors, R, strict=True)
        factors = [replace(factor, R=root, samples=len(b)) for factor, root in pairs]
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
        rows, beta = streamed_rows(problem)

        def weights(some: StreamedRows, _: Array) -> _InTime:
            return _InTime(some.problem, self.order)

        fit, part, used = fixed_point(rows, beta, self.iterations, weights, overlap=self.order)
        poles = [float(np.abs(np.roots(tap)).max(initial=0.0)) for tap in used.taps]
        spread = rows.covariance(fit.beta, fit.weighting, part)
        return fit.estimate(spread, {"largest_pole": max(poles)})


class _InTime:
    """Weights of samples whitened by an AR model of each row's residuals."""

    def __init__(self, problem: Problem, order: int) -> None:
        self.problem, self.order = problem, order
        # The rank of each row and the coefficients of its filter are estimated from its samples;
        # the number of its columns depends on the choice of base parameters.
        acting = row_ranks(problem)
        self.freedom = np.maximum(problem.samples - 2 * order - acting, 1)
        self.taps, self.sigma = np.zeros((len(acting), order + 1)), np.ones(len(acting))
        self._restart()

    def _restart(self) -> None:
        # Autocorrelations of the residuals, sums over N - k products, and the sums of
        # e_(t - k) e_(t - l) over t >= order.
        self.lags = np.zeros_like(self.taps)
        self.products = np.zeros((len(self.taps), self.order + 1, self.order + 1))

    def see(self, e: Array, start: int) -> None:
        """Take in residuals e (n, rows), which begin with the last `order` ones of the block
        before."""
        order = self.order
        if len(e) > order:
            if start == 0:  # samples that have no `order` samples before them
                first = [[x[k:] @ x[: len(x) - k] for k in range(order + 1)] for x in e[:order].T]
                self.lags += first
            shifted = np.stack([e[order - k : len(e) - k].T for k in range(order + 1)], axis=1)
            self.products += shifted @ shifted.transpose(0, 2, 1)

    def change(self, step: float = np.inf) -> None:
        """Model the residuals seen since the last call."""
        lags = self.lags + self.products[:, 0]
        self.taps = np.array([_whitening_filter(of_row) for of_row in lags])
        # Squares of the filtered residual: a quadratic form of its moments.
        squares = np.einsum("jk,jkl,jl->j", self.taps, self.products, self.taps)
        self._restart()
        noise = np.sqrt(np.maximum(squares, 0.0) / self.freedom)
        self.sigma = with_floor(self.problem, noise)

    def of(self, problem: Problem) -> "_InTime":
        """The same model for the samples of another problem."""
        other = _InTime(problem, self.order)
        other.taps, other.sigma = self.taps, self.sigma
        return other

    def weighting(self) -> Weighting:
        """The weights of now."""
        return _whitened_in_time(self.taps, self.sigma)


def _whitening_filter(lags: Array) -> Array:
    """Filter [1, a_1, ..., a_order] that whitens a series of autocorrelations (order + 1,), by the
    Yule-Walker equations: biased ones (divided by N, not N - k) make the model stable."""
    if len(lags) == 1 or lags[0] == 0.0:
        return np.concatenate([[1.0], np.zeros(len(lags) - 1)])
    return np.concatenate([[1.0], solve_toeplitz(lags[:-1], -lags[1:])])


def _whitened_in_time(taps: Array, sigma: Array) -> Weighting:
    """Samples filtered in time by `taps` (rows, order + 1) and divided by sigma (rows,)."""
    order = taps.shape[1] - 1

    def values(e: Array, _: int) -> Array:
        v = np.zeros_like(e)
        white = _filtered(e, taps) / sigma**2
        # v'x = white' filtered(x): the adjoint runs backwards in time.
        for k in range(order + 1):
            v[order - k : order - k + len(white)] += taps[:, k] * white
        return v

    def rows(Q: Array, _e: Array, _at: Array | None) -> Array:
        return _filtered(Q, (taps / sigma[:, None])[..., None])

    return Weighting(values, rows, overlap=order)


def _filtered(values: Array, taps: Array) -> Array:
    """sum_k taps_k (rows, order + 1, ...) values_(t - k) (N, rows, ...): (N - order, rows, ...)."""
    order = taps.shape[1] - 1
    count = max(len(values) - order, 0)
    return np.asarray(
        sum(taps[:, k] * values[order - k : order - k + count] for k in range(order + 1))
    )
