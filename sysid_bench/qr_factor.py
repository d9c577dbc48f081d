"""R factor of tall matrices: the one dense factorisation that all packages share."""

from collections.abc import Iterable

import numpy as np
from scipy.linalg import lapack

from sysid_bench.types import Array


def qr_factor(parts: Iterable[Array]) -> Array:
    """Return the R factor (min(m, k), k) of the vertically stacked matrices (m_i, k).

    Its diagonal may be negative. Raises LinAlgError where LAPACK rejects the matrix.
    """
    stack = np.asfortranarray(np.concatenate(list(parts)))
    rows, columns = stack.shape
    if rows == 0 or columns == 0:
        return np.zeros((0, columns))
    # With the default workspace of SciPy's wrapper LAPACK uses its slow, unblocked algorithm.
    packed, _, _, info = lapack.dgeqrf(stack, lwork=64 * columns, overwrite_a=1)
    if info != 0:
        raise np.linalg.LinAlgError(f"LAPACK's dgeqrf rejected argument {-info}.")
    # Below the diagonal LAPACK stores the reflectors that make up Q.
    return np.triu(packed[: min(rows, columns)])
