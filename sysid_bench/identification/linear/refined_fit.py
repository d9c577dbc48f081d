"""Reweighted least squares of many samples: a fit of a part of them, then few passes over all.

A part of n of N samples gives an estimate within sqrt(N / n) standard deviations of that of all,
and the curvature of its loss within a few percent. A pass over all samples then makes residuals,
weights, gradient and what the next weights need at once, and divides the distance by 20 or so.
Covariances that need Q of all rows are those of the part, whose standard deviations differ by a
percent."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Protocol, Self, TypeVar

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from sysid_bench.identification.linear import reweighted_rows as kept
from sysid_bench.identification.linear.least_squares import with_floor
from sysid_bench.identification.linear.reweighted_rows import (
    MAD_OF_GAUSSIAN,
    Loss,
    ReweightedFit,
    StreamedRows,
    Weighting,
    m_estimate,
    m_weighting,
    reweighted_fit,
)
from sysid_bench.types import Array, Problem, RowBlock

RUN: Final = 128
"""Consecutive samples of a part, where a filter in time needs neighbours."""

START: Final = 0.05
"""Step, in standard deviations of the fit of a part, at which it is a start: small beside the
distance from the fit of all."""

ALIKE: Final = (0.5, 2.0)
"""Range of the information of a part, scaled to all samples, relative to that of all."""

NEAR: Final = 1e-4
"""Expected RMS distance from the fixed point, in standard deviations of the estimate, at which a
fit has converged."""

PASSES: Final = 25
"""Most passes; a fit of a part that is no start for all would not converge in more."""


def part_of(rows: StreamedRows, overlap: int = 0) -> StreamedRows | None:
    """Return evenly spread samples that are kept, in runs behind `overlap` others for filters; None
    where all samples are few, or where a part lacks what they excite."""
    count, r = rows.problem.samples, len(rows.R)
    size = 8 * max(len(rows.problem.rows), 1) * r
    most = int(min(kept.ENOUGH, 0.5 * kept.KEPT / size))
    if count * size <= kept.KEPT or most * len(rows.problem.rows) < 10 * r:
        return None
    every, run = -(-count // most), 1 if overlap == 0 else RUN
    # One run at random out of each `every`: a fixed step could meet the same phase of each period.
    chosen_run = np.random.default_rng(0).integers(0, every, size=count // (run * every) + 1)
    parts: list[RowBlock] = []
    for block in rows.products(overlap):
        runs = np.arange(block.start, block.start + len(block.b)) // run
        chosen = runs % every == chosen_run[runs // every]
        for _ in range(overlap):
            chosen[:-1] |= chosen[1:]
        indices = np.flatnonzero(chosen)
        edges = np.flatnonzero(np.diff(indices) > 1) + 1 if overlap else np.zeros(0, dtype=int)
        parts += [(block.dense(piece), block.b[piece]) for piece in np.split(indices, edges)]
    samples = sum(len(b) for _, b in parts)
    share = samples / count
    factors = tuple(
        replace(f, R=f.R * np.sqrt(share), samples=round(share * f.samples))
        for f in rows.problem.factors
    )
    problem = replace(
        rows.problem, blocks=lambda: iter(parts), samples=samples, factors=factors, motions=()
    )
    sigma = rows.sigma[:, None]
    plain = Weighting(lambda e, _: e / sigma[:, 0] ** 2, lambda Q, _e, _at: Q / sigma)
    part = StreamedRows(problem, rows.R, rows.sigma, whole=False)
    shares = part.information(np.zeros(r), plain)
    values = np.linalg.eigvalsh(shares) / share
    if not ALIKE[0] < values[0] <= values[-1] < ALIKE[1]:
        return None
    # R of the part: relative to it, the information of weighted rows is that of all samples.
    return replace(part, R=np.triu(cho_factor(shares)[0]) @ rows.R)


class Weights(Protocol):
    """Weights that depend on the residuals."""

    def see(self, e: Array, start: int) -> None:
        """Take in residuals e (n, rows) of a block whose first sample has the index `start`."""

    def change(self, step: float = np.inf) -> None:
        """Change the weights by what was seen since the last call, before a step (standard
        deviations) of the estimate."""

    def weighting(self) -> Weighting:
        """The weights of now."""

    def of(self, problem: Problem) -> Self:
        """The same weights for the samples of another problem."""


@dataclass(eq=False)
class Refined:
    """A fit on its way: beta (r,), its weights and steps."""

    part: StreamedRows
    beta: Array
    weights: Weights
    start: int = 0  # iterations before
    steps: list[float] = field(default_factory=list)  # RMS, standard deviations
    converged: bool = False

    def move(self, rows: StreamedRows, gradient: Array) -> None:
        """Make a step with the gradient (r,) of all samples by gamma = R beta."""
        root = cho_factor(curvature(self.part, self.beta, self.weights.weighting()))
        change = cho_solve(root, gradient)
        self.steps.append(float(np.linalg.norm(np.triu(root[0]) @ change) / np.sqrt(len(change))))
        gamma = rows.R @ self.beta + change
        self.beta = solve_triangular(rows.R, gamma)
        self.weights.change(self.steps[-1])
        # Later steps are shorter by the ratio of these: their sum is the way to the fixed point, by
        # the largest of three, since scales and estimate may take turns. Rounding ends it too.
        last = np.array(self.steps[-4:])
        ratio = float((last[1:] / np.maximum(last[:-1], 1e-300)).max(initial=0.0))
        left = last[-1] * (ratio / (1.0 - ratio) if 0.0 < ratio < 0.5 else 1.0)
        rounding = np.linalg.norm(change) <= kept.SMALL * np.linalg.norm(gamma)
        self.converged = bool(left <= NEAR or rounding)

    @property
    def fit(self) -> ReweightedFit:
        count = self.start + len(self.steps)
        stop = f"within {NEAR:g} standard deviations of the fixed point"
        return ReweightedFit(self.beta, self.weights.weighting(), count, self.converged, stop)


CONVEX: Final = 0.01
"""Least curvature of a loss, relative to the largest, by which a step is made: in these unknowns
weights alone make them differ."""


def curvature(part: StreamedRows, beta: Array, weighting: Weighting) -> Array:
    """Second derivative (r, r) of the loss in gamma, or the information of the weighted rows where
    the loss is concave in some direction."""
    if weighting.slopes is not None:
        total = np.zeros((len(part.R),) * 2)
        inverse = solve_triangular(part.R, np.eye(len(part.R)))
        for _, Y, b in part.blocks():
            Q = Y.reshape(-1, len(inverse)) @ inverse
            total += (Q * weighting.slopes(b - Y @ beta).reshape(-1, 1)).T @ Q
        values = np.linalg.eigvalsh(total)
        if values[0] > CONVEX * values[-1]:
            return total
    return part.information(beta, weighting)


def refine(rows: StreamedRows, fits: Sequence[Refined], overlap: int = 0) -> bool:
    """Move fits to their fixed points in the same passes; False where one does not converge."""
    for _ in range(PASSES):
        gradients = [np.zeros(len(rows.R)) for _ in fits]
        weightings = [fit.weights.weighting() for fit in fits]
        for block in rows.products(overlap):
            for fit, weighting, total in zip(fits, weightings, gradients, strict=True):
                e = block.residual(fit.beta)
                fit.weights.see(e, block.start)
                total += block.transposed(weighting.values(e, block.start))
        for fit, total in zip(fits, gradients, strict=True):
            fit.move(rows, solve_triangular(rows.R, total, trans="T"))
        if all(fit.converged for fit in fits):
            return True
    return False


W = TypeVar("W", bound=Weights)


def fixed_point(
    rows: StreamedRows,
    beta: Array,
    iterations: int,
    weights: Callable[[StreamedRows, Array], W],
    hold_after: int = 0,
    overlap: int = 0,
) -> tuple[ReweightedFit, StreamedRows | None, W]:
    """Return the fixed point from a start beta (r,), the part of the samples that its information
    is made of (None: all) and its weights: `weights(rows, beta)` are those of a start.
    """
    part = part_of(rows, overlap)
    if part is not None:
        of_part = weights(part, beta)
        weigh = _weigher(part, of_part, overlap)
        first = reweighted_fit(part, beta, iterations, weigh, hold_after, START)
        of_all = of_part.of(rows.problem)
        fit = Refined(part, first.beta, of_all, first.iterations)
        if refine(rows, [fit], overlap):
            return fit.fit, part, of_all
    own = weights(rows, beta)
    weigh = _weigher(rows, own, overlap)
    return reweighted_fit(rows, beta, iterations, weigh, hold_after), None, own


def _weigher(
    rows: StreamedRows, weights: Weights, overlap: int
) -> Callable[[Array, int], Weighting]:
    def weigh(beta: Array, _: int) -> Weighting:
        for start, e in rows.residuals(beta, overlap):
            weights.see(e, start)
        weights.change()
        return weights.weighting()

    return weigh


BAND: Final = 0.1
"""Width of the band about a median in which its density is taken, relative to it."""

COLLECTED: Final = 4000
"""Residuals of a row about its median that are expected to be collected in a pass."""


class MedianScales:
    """MAD scales (rows,) from pass to pass: by the exact median of the residuals of a pass where it
    is among those near the last one, which are collected, else by a step of Newton's method."""

    def __init__(self, rows: StreamedRows, part: StreamedRows, beta: Array, scale: Array) -> None:
        self.problem, self.scale = rows.problem, scale
        used, some = (np.array([f.samples for f in p.problem.factors]) for p in (rows, part))
        self.used = np.clip(used, 1, rows.problem.samples)
        inside = np.zeros(len(scale))
        for _, e in part.residuals(beta):
            inside += (np.abs(np.abs(e) / self._median - 1.0) <= BAND).sum(axis=0)
        self.density = np.maximum(inside, 1.0) / np.maximum(some, 1) / (2.0 * BAND * self._median)
        self._restart()

    @property
    def _median(self) -> Array:
        return MAD_OF_GAUSSIAN * self.scale

    def _restart(self) -> None:
        expected = 0.5 * COLLECTED / (self.used * self.density)
        self.width = np.minimum(expected, BAND * self._median)
        self.above = np.zeros(len(self.scale))
        self.near: list[tuple[Array, Array]] = []  # indices of rows, residuals less the median

    def see(self, e: Array, start: int) -> None:
        """Take in residuals e (n, rows)."""
        away = np.abs(e) - self._median
        # A product with ones: four times faster than a sum of truth values over the first axis.
        self.above += np.ones(len(e)) @ (away > self.width)
        samples, columns = np.nonzero(np.abs(away) <= self.width)
        self.near.append((columns, away[samples, columns]))

    def change(self) -> None:
        """Change the scales by what was seen since the last call."""
        medians = self._median.copy()
        rows, near = (np.concatenate(part) for part in zip(*self.near, strict=True))
        for i, (above, used) in enumerate(zip(self.above.astype(int), self.used, strict=True)):
            largest_first = -np.sort(-near[rows == i])
            ranks = np.array([(used - 1) // 2, used // 2]) - above
            if ranks[0] >= 0 and ranks[1] < len(largest_first):
                medians[i] += largest_first[ranks].mean()
            else:
                more = above + (largest_first > 0).sum() - 0.5 * used
                step = more / (used * self.density[i])
                medians[i] += np.clip(step, -BAND * medians[i], BAND * medians[i])
        self.scale = with_floor(self.problem, medians / MAD_OF_GAUSSIAN)
        self._restart()


@dataclass(frozen=True, eq=False)
class LossWeights:
    """Weights of a loss by scales that are kept with it."""

    scales: MedianScales
    loss: Loss
    sees: bool  # whether the scales change with the residuals of this loss

    def see(self, e: Array, start: int) -> None:
        """Take in residuals e (n, rows)."""
        if self.sees:
            self.scales.see(e, start)

    def change(self, step: float = np.inf) -> None:
        """Change the scales by what was seen."""
        if self.sees:
            self.scales.change()

    def weighting(self) -> Weighting:
        """Weights by the scales of now."""
        return m_weighting(self.loss, self.scales.scale)

    def of(self, problem: Problem) -> "LossWeights":
        """The same weights: those of a loss do not depend on the number of samples."""
        return self


def refined_m_estimate(
    rows: StreamedRows, losses: Sequence[Loss], beta: Array, iterations: int
) -> tuple[ReweightedFit, Array] | None:
    """Return the M-estimate of the last of some losses and its scales, those of the first; None
    where all samples are few or passes do not converge."""
    part = part_of(rows)
    if part is None:
        return None
    first, of_part = m_estimate(part, losses[0], beta, iterations, near=START)
    scales = MedianScales(rows, part, first.beta, of_part)
    fits = [Refined(part, first.beta, LossWeights(scales, losses[0], True), first.iterations)]
    for loss in losses[1:]:
        first, _ = m_estimate(part, loss, first.beta, iterations, of_part, START)
        fits.append(Refined(part, first.beta, LossWeights(scales, loss, False), first.iterations))
    return (fits[-1].fit, scales.scale) if refine(rows, fits) else None
