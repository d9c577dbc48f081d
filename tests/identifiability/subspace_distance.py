"""Angle between subspaces, with which tests compare base maps."""

import numpy as np
from scipy.linalg import subspace_angles

from sysid_bench.types import Array


def subspace_distance(A: Array, B: Array) -> float:
    """Return the largest principal angle (rad) between the column spaces of A (n, a) and B (n, b);
    pi / 2 if a and b differ.

    With A = K1^T and B = K2^T it is zero iff two base maps identify the same combinations.
    """
    if A.shape[1] != B.shape[1]:
        return float(np.pi / 2)
    return float(subspace_angles(A, B).max(initial=0.0)) if A.shape[1] else 0.0
