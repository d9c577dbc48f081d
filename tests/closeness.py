"""Comparison of arrays as a whole.

An entry far smaller than the others has their rounding errors: relative to itself it may differ by
any factor between processors, whose kernels sum in different orders.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import subspace_angles

from sysid_bench.types import Array


def assert_close(actual: ArrayLike, expected: ArrayLike, relative: float = 1e-7) -> None:
    """Assert |actual - expected| <= relative |expected| by the norms of the whole arrays;
    `expected` is of the shape of `actual`, or one value for all of an axis."""
    found = np.asarray(actual, float)
    wanted = np.broadcast_to(np.asarray(expected, float), found.shape)
    assert np.isfinite(found).all()
    assert np.isfinite(wanted).all()
    difference = np.linalg.norm(found - wanted)
    size = np.linalg.norm(wanted)
    assert difference <= relative * size, f"{difference:.3g} of {size:.3g}: {found} for {wanted}"


def subspace_distance(A: Array, B: Array) -> float:
    """Return the largest principal angle (rad) between the column spaces of A (n, a) and B (n, b);
    pi / 2 if a and b differ.

    With A = K1^T and B = K2^T it is zero iff two base maps identify the same combinations.
    """
    if A.shape[1] != B.shape[1]:
        return float(np.pi / 2)
    return float(subspace_angles(A, B).max(initial=0.0)) if A.shape[1] else 0.0
