"""Block-wise QR accumulation of the regression: one R factor per row of the robot.

R of [W_i | b_i] is a sufficient statistic of all samples of row i for least squares, rank,
condition number and RMSE (sequential accumulation; Lawson and Hanson 1974). Its size does not
depend on the number of samples, so the stacked regressor is never stored.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import lapack

from sysid_bench.numerics import qr_factor
from sysid_bench.regressors.kernel_c import layout_of
from sysid_bench.regressors.kernel_numpy import blocks, motion_part
from sysid_bench.regressors.regression import Regression
from sysid_bench.regressors.sensor_offset import MeasuredRegressor
from sysid_bench.types import Array, Factor, Trajectory


def motion_factors(
    regression: MeasuredRegressor, motion: Trajectory, b: Array, rows: Sequence[int] | None = None
) -> tuple[Factor, ...]:
    """Return the R factor of [Y_i | b_i] for each row i along one motion.

    b (N, n) is the right-hand side, whose column i belongs to row i; `rows` selects rows (None:
    all).
    """
    return factors_of_motions(regression, [(motion, b)], rows)


def factors_of_motions(
    regression: MeasuredRegressor,
    parts: Iterable[tuple[Trajectory, Array]],
    rows: Sequence[int] | None = None,
) -> tuple[Factor, ...]:
    """Return the R factors over several motions, given as (motion, right-hand side) pairs.

    `parts` may be a generator: each motion is used once, so memory does not grow with their number.
    """
    chosen_rows = tuple(range(len(regression.rows)) if rows is None else rows)
    factors = [np.zeros((0, len(regression.row_columns[i]) + 1)) for i in chosen_rows]
    samples = 0
    for motion, b in parts:
        factors = _accumulated(regression, motion, b, chosen_rows, factors)
        samples += len(motion)
    return tuple(
        Factor(regression.rows[i], regression.row_columns[i], R, samples)
        for i, R in zip(chosen_rows, factors, strict=True)
    )


def _accumulated(
    regression: MeasuredRegressor,
    motion: Trajectory,
    b: Array,
    rows: Sequence[int],
    factors: list[Array],
) -> list[Array]:
    """R factors updated by one motion, by the compiled kernel where it can."""
    # With fewer samples than columns R is trapezoidal, which the compiled kernel cannot store.
    widest = max((R.shape[1] for R in factors), default=0)
    if isinstance(regression, Regression) and len(motion) >= widest:
        library = regression.library
        if library is not None:
            # In C order, completed to squares by rows of zeros.
            squares = [np.zeros((R.shape[1], R.shape[1])) for R in factors]
            for square, R in zip(squares, factors, strict=True):
                square[: len(R)] = R
            library.update_factors(layout_of(regression, rows), motion, b, squares)
            return squares
    for block in regression.blocks(motion):
        # C order here is Fortran order of the transpose, which LAPACK reads without a copy.
        factors = [
            _absorb(R, block.row_with(i, b[block.samples, i]).T)
            for R, i in zip(factors, rows, strict=True)
        ]
    return factors


def _absorb(R: Array, rows: Array) -> Array:
    """R factor of [R; rows]; rows (n, k) are in Fortran order and are overwritten."""
    m, k = R.shape
    if m < k:
        return qr_factor([R, rows])
    if k == 0:
        return R
    # dtpqrt exploits that R is triangular: measured 10 to 20 % faster than dgeqrf at 12 to 44
    # columns.
    R, _, _, info = lapack.dtpqrt(0, min(8, k), R, rows, overwrite_a=1, overwrite_b=1)
    if info != 0:
        raise np.linalg.LinAlgError(f"LAPACK's dtpqrt rejected argument {-info}.")
    return R


SHORT: Final = 512
"""Samples of a block whose rows are read twice: they stay in the second-level cache."""


@dataclass(frozen=True, eq=False)
class MotionBlocks:
    """Blocks of Y and b (N, n) along a motion, as a problem has them; arguments as for
    `motion_factors`."""

    regression: MeasuredRegressor
    motion: Trajectory
    b: Array
    rows: tuple[int, ...]

    def __call__(self) -> Iterator[tuple[Array, Array]]:
        """Yield (Y (n, rows, p), b (n, rows)) block by block."""
        regression, motion, b = self.regression, self.motion, self.b
        if isinstance(regression, Regression) and self.rows == tuple(range(len(regression.rows))):
            # All rows: the kernel writes the dense block itself.
            for part in blocks(motion):
                yield regression.dense(motion_part(motion, part)).Y, b[part]
            return
        chosen = list(self.rows)
        for block in regression.blocks(motion):
            yield block.dense()[:, chosen], b[block.samples][:, chosen]

    def by_row(self, overlap: int = 0) -> Iterator[tuple[int, list[Array], Array]]:
        """Yield (index of the first sample, the values (k, n) of each row in the columns of its
        factor, b (n, rows)); values are valid until the next block, which begins with the last
        `overlap` samples of this one."""
        regression, chosen = self.regression, list(self.rows)
        library = regression.library if isinstance(regression, Regression) else None
        memory = np.zeros(0)  # fresh memory would cost as much as half of the kernel
        for part in blocks(self.motion, SHORT):
            samples = slice(max(part.start - overlap, 0), part.stop)
            span, b = motion_part(self.motion, samples), self.b[samples][:, chosen]
            if library is not None and isinstance(regression, Regression):
                layout = layout_of(regression, self.rows)
                size = layout.size * len(span)
                memory = memory if len(memory) >= size else np.empty(size)
                values = library.rows(layout, span, memory[:size].reshape(layout.size, -1))
                starts = zip(layout.starts.tolist(), layout.count.tolist(), strict=True)
                yield samples.start, [values[i : i + k] for i, k in starts], b
            else:
                (block,) = regression.blocks(span)
                yield samples.start, [block.row(i) for i in chosen], b
