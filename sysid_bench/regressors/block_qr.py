"""Block-wise QR accumulation of the regression: one R factor per row of the robot.

R of [W_i | b_i] is a sufficient statistic of all samples of row i for least squares, rank,
condition number and RMSE (sequential accumulation; Lawson and Hanson 1974). Its size does not
depend on the number of samples, so the stacked regressor is never stored.
"""

from collections.abc import Iterable, Iterator, Sequence

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


def dense_blocks(
    regression: MeasuredRegressor, motion: Trajectory, b: Array, rows: Sequence[int] | None = None
) -> Iterator[tuple[Array, Array]]:
    """Yield (Y (n, rows, p), b (n, rows)) block by block; arguments as for `update_factors`."""
    if isinstance(regression, Regression) and rows in (None, tuple(range(len(regression.rows)))):
        # All rows: the kernel writes the dense block itself.
        for part in blocks(motion):
            yield regression.dense(motion_part(motion, part)).Y, b[part]
        return
    chosen = slice(None) if rows is None else list(rows)
    for block in regression.blocks(motion):
        yield block.dense()[:, chosen], b[block.samples][:, chosen]
