"""Rows are folded, not stacked: one R factor per row of the robot, block after block.

R of [W_i | b_i] is a sufficient statistic of the samples of row i for every least-squares method,
rank, condition number and RMSE; its size does not depend on the number of samples.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from scipy.linalg import lapack

from sysid_bench.regressors.coupled import AnyRegression
from sysid_bench.types import Array, Factor, Trajectory


def fold(
    regression: AnyRegression, motion: Trajectory, b: Array, rows: Sequence[int] | None = None
) -> tuple[Factor, ...]:
    """One Factor per row for the right-hand side b (N, n); `rows`: only these (None: all)."""
    chosen = range(len(regression.rows)) if rows is None else rows
    factors = {i: np.zeros((0, len(regression.touched[i]) + 1)) for i in chosen}
    for block in regression.blocks(motion):
        for i, R in factors.items():
            factors[i] = _absorb(
                R, block.count, lambda out, i=i, block=block: block.row(i, out), b[block.samples, i]
            )
    return tuple(
        Factor(regression.rows[i], regression.touched[i], R, len(motion))
        for i, R in factors.items()
    )


def triangle(parts: Iterable[Array]) -> Array:
    """R of all rows of the given matrices (m_i, k) on top of each other."""
    stack = np.asfortranarray(np.concatenate(list(parts)))
    return _triangle(stack)


def _absorb(R: Array, count: int, fill, b: Array) -> Array:  # type: ignore[no-untyped-def]
    m, k = R.shape
    # C order here is Fortran order of the transpose, which LAPACK reads without a copy.
    stack = np.empty((k, m + count))
    stack[:, :m] = R.T
    fill(stack[: k - 1, m:])
    stack[k - 1, m:] = b
    return _triangle(stack.T)


def _triangle(stack: Array) -> Array:
    rows, columns = stack.shape
    if rows == 0 or columns == 0:
        return np.zeros((0, columns))
    # The wrapper's default workspace would make LAPACK fall back to its unblocked algorithm.
    packed, _, _, info = lapack.dgeqrf(stack, lwork=64 * columns, overwrite_a=1)
    if info != 0:
        raise np.linalg.LinAlgError(f"dgeqrf refused its argument {-info}.")
    return np.triu(packed[: min(rows, columns)])


def dense_blocks(
    regression: AnyRegression, motion: Trajectory, b: Array, rows: Sequence[int] | None = None
) -> Iterator[tuple[Array, Array]]:
    """The rows themselves again: (Y (n, rows, p), b (n, rows)) block by block; as for `fold`."""
    chosen = slice(None) if rows is None else list(rows)
    for block in regression.blocks(motion):
        yield block.dense()[:, chosen], b[block.samples][:, chosen]
