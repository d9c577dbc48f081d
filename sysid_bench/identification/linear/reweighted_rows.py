"""Iteratively reweighted least squares: residuals sample by sample, steps with a weight per sample.

Samples are read block by block in every pass, so that memory does not grow with their number. In
M-estimation each row has its own scale, the median absolute residual over 0.6745 (MAD): the
standard deviation for Gaussian noise, insensitive to outliers (Holland and Welsch 1977)."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy.linalg import blas, cho_factor, cho_solve, solve_triangular

from sysid_bench.identification.linear.least_squares import (
    covariance,
    scaled_fit,
    stacked_factor,
    with_floor,
)
from sysid_bench.types import Array, Estimate, Problem, RowBlock, SparseBlocks

KEPT: Final = 40e6
"""Most bytes of samples that are kept between passes; others are made again in every pass."""

SMALL: Final = 1e-10
"""Share of the torques that the last step of a converged iteration may change."""

ENOUGH: Final = 20_000
"""Samples, spread over all, from which a fit of a part of them is made."""

SETTLED: Final = "a step changes the torques by less than 1e-10 of them"


@dataclass(frozen=True, eq=False)
class Weighting:
    """Weights of one iteration as functions of a block, whose first sample has the index `start`.

    `values(e, start)` are v (n, rows) of residuals e (n, rows), for the gradient Y'v;
    `rows(Q, e, samples)` are samples Q (n, rows, r) of indices (n,), None where they are a part of
    all, times the roots of their weights. A block begins with the last `overlap` samples of the
    block before. `slopes(e)` (n, rows) are derivatives of v by e where they are not the weights.
    """

    values: Callable[[Array, int], Array]
    rows: Callable[[Array, Array, Array | None], Array]
    overlap: int = 0
    slopes: Callable[[Array], Array] | None = None


@dataclass(frozen=True, eq=False)
class DenseProducts:
    """A block Y (n, rows, r), b (n, rows) whose first sample has the index `start`."""

    start: int
    b: Array
    Y: Array

    def residual(self, beta: Array) -> Array:
        """b - Y beta (n, rows)."""
        # One product of a matrix and a vector, faster than one of each sample.
        return np.asarray(self.b - (self.Y.reshape(-1, len(beta)) @ beta).reshape(self.b.shape))

    def transposed(self, v: Array) -> Array:
        """Y'v (r,) of values v (n, rows)."""
        return np.asarray(v.ravel() @ self.Y.reshape(v.size, -1))

    def dense(self, samples: Array) -> Array:
        """Y (m, rows, r) of some samples (m,)."""
        return np.asarray(self.Y[samples])


@dataclass(frozen=True, eq=False)
class SparseProducts:
    """The same for Y (k, n) of each row, in some of r columns."""

    start: int
    b: Array
    Y: list[Array]
    columns: list[Array]
    r: int

    def residual(self, beta: Array) -> Array:
        """b - Y beta (n, rows), a row after the other in memory."""
        e = np.empty(self.b.T.shape)
        for row, Y, columns in zip(e, self.Y, self.columns, strict=True):
            np.dot(beta[columns], Y, out=row)
        np.subtract(self.b.T, e, out=e)
        return e.T

    def transposed(self, v: Array) -> Array:
        """Y'v (r,) of values v (n, rows)."""
        total = np.zeros(self.r)
        for row, Y, columns in zip(np.ascontiguousarray(v.T), self.Y, self.columns, strict=True):
            total[columns] += Y @ row
        return total

    def dense(self, samples: Array) -> Array:
        """Y (m, rows, r) of some samples (m,)."""
        dense = np.zeros((len(samples), len(self.Y), self.r))
        for i, (Y, columns) in enumerate(zip(self.Y, self.columns, strict=True)):
            dense[:, i, columns] = Y[:, samples].T
        return dense


Products = DenseProducts | SparseProducts


@dataclass(frozen=True, eq=False)
class StreamedRows:
    """Samples of a problem in the unknowns gamma = R beta, R (r, r) the factor of all rows divided
    by `sigma` (rows,).

    Q = Y R^-1 is nearly orthonormal, so that its normal equations lose no digits, and the next step
    corrects the rounding error of this one. Residuals and gradients need Y alone.
    """

    problem: Problem
    R: Array
    sigma: Array
    whole: bool = True  # all samples, whose blocks follow each other in time

    def blocks(self, overlap: int = 0) -> Iterator[tuple[int, Array, Array]]:
        """Yield (start, Y (n, rows, r), b (n, rows)) in time order; blocks after the first begin
        with up to `overlap` samples of those before."""
        end, past = 0, None
        for Y, b in self.problem.blocks() if self._kept is None else self._kept:
            if past is not None:
                Y, b = (np.concatenate(pair) for pair in zip(past, (Y, b), strict=True))
            yield end - (0 if past is None else len(past[0])), Y, b
            end += len(b) - (0 if past is None else len(past[0]))
            if overlap and self.whole:
                past = (Y[-overlap:], b[-overlap:])

    @cached_property
    def _kept(self) -> list[RowBlock] | None:
        size = 8 * self.problem.samples * len(self.problem.rows) * len(self.R)
        return list(self.problem.blocks()) if size <= KEPT else None

    def products(self, overlap: int = 0) -> Iterator["Products"]:
        """Yield the blocks for products with vectors: without zeros where samples are not kept and
        the problem can be read so."""
        sparse = self.problem.blocks
        if self._kept is None and isinstance(sparse, SparseBlocks):
            columns = [factor.columns for factor in self.problem.factors]
            for start, Y, b in sparse.by_row(overlap):
                yield SparseProducts(start, b, Y, columns, len(self.R))
        else:
            for start, Y_dense, b in self.blocks(overlap):
                yield DenseProducts(start, b, Y_dense)

    def residuals(self, beta: Array, overlap: int = 0) -> Iterator[tuple[int, Array]]:
        """Yield (start, b - Y beta (n, rows)) block by block."""
        for block in self.products(overlap):
            yield block.start, block.residual(beta)

    def gradient(self, beta: Array, weighting: Weighting) -> Array:
        """Gradient (r,) by gamma at beta."""
        total = np.zeros(len(self.R))
        for start, Y, b in self.blocks(weighting.overlap):
            values = weighting.values(b - Y @ beta, start)
            total += values.ravel() @ Y.reshape(-1, len(total))
        return solve_triangular(self.R, total, trans="T")

    def information(self, beta: Array, weighting: Weighting) -> Array:
        """Weighted sum of Q'Q (r, r)."""
        r = len(self.R)
        total, inverse = np.zeros((r, r)), solve_triangular(self.R, np.eye(r))
        for start, Y, b in self.blocks(weighting.overlap):
            Q = (Y.reshape(-1, r) @ inverse).reshape(Y.shape)
            samples = np.arange(start, start + len(b)) if self.whole else None
            rows = weighting.rows(Q, b - Y @ beta, samples).reshape(-1, r)
            if len(rows):
                # Fortran order of the transpose: no copy, and half of the products.
                total += blas.dsyrk(1.0, rows.T)
        return np.triu(total) + np.triu(total, 1).T

    def covariance(
        self, beta: Array, weighting: Weighting, part: "StreamedRows | None" = None
    ) -> Array:
        """Covariance (r, r) of beta for weighted rows of unit noise, with the information of a part
        where one is given."""
        rows = self if part is None else part
        factor = np.triu(cho_factor(rows.information(beta, weighting))[0])
        half = solve_triangular(factor @ self.R, np.eye(len(factor)))
        return np.asarray(half @ half.T)


MAD_OF_GAUSSIAN: Final = 0.6745
"""Median of |x| of the standard normal distribution."""

HOLD_AFTER: Final = 10
"""Iterations after which the scales are held: with held scales a convex loss always converges."""


@dataclass(frozen=True)
class Loss:
    """Loss function by weight(u) = psi(u) / u and slope(u) = psi'(u) of scaled residuals u."""

    weight: Callable[[Array], Array]
    slope: Callable[[Array], Array]


def streamed_rows(problem: Problem) -> tuple[StreamedRows, Array]:
    """Return the samples with the factor of `wls` as R, and its beta (r,)."""
    beta, weighted, sigma = scaled_fit(problem)
    return StreamedRows(problem, weighted[:-1, :-1], sigma), beta


@dataclass(frozen=True, eq=False)
class ReweightedFit:
    """Fixed point of reweighted least squares, or the last iterate, with its weights."""

    beta: Array  # (r,)
    weighting: Weighting
    iterations: int
    converged: bool
    stop: str = SETTLED

    def estimate(self, covariance: Array, stats: dict[str, float]) -> Estimate:
        """The estimate with a covariance (r, r) and the numbers of its method."""
        return Estimate(
            self.beta,
            covariance=covariance,
            stats=stats,
            converged=self.converged,
            iterations=self.iterations,
            stop=self.stop if self.converged else f"the limit of {self.iterations} iterations",
        )


def reweighted_fit(
    rows: StreamedRows,
    beta: Array,
    iterations: int,
    weigh: Callable[[Array, int], Weighting],
    hold_after: int = 0,
    near: float = 0.0,
) -> ReweightedFit:
    """Return the fixed point from a start beta (r,): `weigh(beta, iteration)` makes the weights
    from the residuals of beta. It can converge after iteration `hold_after`, from which `weigh`
    holds what could alternate for ever, or anywhere by a step of `near` standard deviations (RMS).
    """
    gamma, root, converged = rows.R @ beta, rows.R, False
    for iteration in range(1, iterations + 1):
        weighting = weigh(beta, iteration)
        # The information is made anew in iterations 1, 2, 4, 8 and so on: a step with that of
        # similar weights has the same fixed point.
        if iteration & (iteration - 1) == 0:
            root = np.triu(cho_factor(rows.information(beta, weighting))[0])
        # A step from the present residual, not a fit of b: an old or rounded factor changes the
        # way, and not the fixed point.
        change = np.asarray(cho_solve((root, False), rows.gradient(beta, weighting)))
        gamma = gamma + change
        beta = solve_triangular(rows.R, gamma)
        # |gamma| = |R beta| is the size of the torques: the stop rule depends on no unit.
        small = np.linalg.norm(change) <= SMALL * np.linalg.norm(gamma)
        deviations = np.linalg.norm(root @ change) / np.sqrt(len(change))
        converged = (iteration > hold_after and bool(small)) or bool(deviations < near)
        if converged:
            break
    return ReweightedFit(beta, weighting, iteration, converged)


def m_estimate(
    rows: StreamedRows,
    loss: Loss,
    beta: Array,
    iterations: int,
    scales: Array | None = None,
    near: float = 0.0,
) -> tuple[ReweightedFit, Array]:
    """Return the M-estimate from a start beta (r,), and the scales (rows,); given ones are held.
    `near` as for `reweighted_fit`."""
    hold_after = 0 if scales is not None else HOLD_AFTER
    held = np.ones(len(rows.problem.rows)) if scales is None else scales

    def weigh(beta: Array, iteration: int) -> Weighting:
        nonlocal held
        if iteration <= hold_after:
            held = row_scale(rows, beta)
        return m_weighting(loss, held)

    return reweighted_fit(rows, beta, iterations, weigh, hold_after, near), held


def m_weighting(loss: Loss, scale: Array) -> Weighting:
    """Return the weights of a loss of residuals divided by scales (rows,)."""
    return Weighting(
        lambda e, _: loss.weight(e / scale) / scale**2 * e,
        lambda Q, e, _: Q * (np.sqrt(loss.weight(e / scale)) / scale)[..., None],
        slopes=lambda e: loss.slope(e / scale) / scale**2,
    )


def m_estimate_result(
    rows: StreamedRows, loss: Loss, fit: ReweightedFit, scales: Array
) -> Estimate:
    """Return the estimate with the covariance A^-1 B A^-1 of Huber (1981, section 7.6):
    A = sum E psi' W_j'W_j / s_j^2, B = sum E psi^2 W_j'W_j / s_j^2, expectations over each row."""
    slope, squares, count, least = np.zeros(len(scales)), np.zeros(len(scales)), 0, np.inf
    for _, e in rows.residuals(fit.beta):
        u = e / scales
        weight = loss.weight(u)
        # weight * u is psi(u).
        slope, squares = (
            slope + loss.slope(u).sum(axis=0),
            squares + ((weight * u) ** 2).sum(axis=0),
        )
        count, least = count + len(u), min(least, float(weight.min(initial=np.inf)))
    r = rows.problem.base.rank
    outer = stacked_factor(
        rows.problem, (np.sqrt(np.maximum(slope / count, 0.0)) / scales).tolist()
    )
    inner = stacked_factor(rows.problem, (np.sqrt(squares / count) / scales).tolist())[:r, :r]
    spread = covariance(outer) @ inner.T
    return fit.estimate(spread @ spread.T, {"least_weight": least})


def row_scale(rows: StreamedRows, beta: Array) -> Array:
    """MAD scale (rows,) of the residuals of beta, above rounding, over the samples of each row."""

    def sizes() -> Iterator[Array]:
        for _, e in rows.residuals(beta):
            yield np.abs(e)

    counts = [factor.samples for factor in rows.problem.factors]
    return with_floor(rows.problem, streamed_medians(sizes, counts) / MAD_OF_GAUSSIAN)


BIN_SHIFT: Final = 48
"""Bits of a double behind its exponent and four bits of its mantissa: bins of 6 %."""


def streamed_medians(blocks: Callable[[], Iterable[Array]], counts: list[int]) -> Array:
    """Medians (k,) of columns of sizes (N, k), none negative, in blocks (n, k) that are read twice.

    That of column i is over its `counts[i]` largest: what is left out of a column is zero in it.
    Bins in a first pass select the few numbers that a second one sorts, so that they are exact.
    """
    bins = 1 << (63 - BIN_SHIFT)
    histogram, columns, total = np.zeros(bins * len(counts), int), np.arange(len(counts)), 0
    for block in blocks():
        # Doubles that are not negative are in the order of their bits.
        np.add.at(histogram, _bins(block) + columns * bins, 1)
        total += len(block)
    below = np.cumsum(histogram.reshape(-1, bins), axis=1)
    middle = []
    for reach, count in zip(below, counts, strict=True):
        last, used = total - 1, min(max(count, 1), total)
        ranks = np.array([last - used // 2, last - (used - 1) // 2])
        middle.append((ranks, *np.searchsorted(reach, ranks, side="right")))
    chosen: list[list[Array]] = [[] for _ in counts]
    for block in blocks():
        for i, (column, x) in enumerate(zip(_bins(block).T, block.T, strict=True)):
            chosen[i].append(x[(column >= middle[i][1]) & (column <= middle[i][2])])
    medians = []
    for i, (ranks, first, _) in enumerate(middle):
        before = below[i, first - 1] if first > 0 else 0
        medians.append(np.sort(np.concatenate(chosen[i]))[ranks - before].mean())
    return np.array(medians)


def _bins(sizes: Array) -> Array:
    return np.ascontiguousarray(sizes).view(np.int64) >> BIN_SHIFT
