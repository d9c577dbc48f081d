"""The same base space with other pivots, and whether two sets span the same space."""

from dataclasses import replace

import numpy as np
from scipy.linalg import subspace_angles

from sysid_bench.errors import UsageError
from sysid_bench.types import Array, BaseMap


def rebase(base: BaseMap, pivots: Array) -> BaseMap:
    """The base map with these pivots (r,): K becomes K[:, pivots]^-1 K.

    Raises UsageError where the parameters are not independent.
    """
    chosen = base.K[:, pivots]
    if chosen.shape != (base.rank, base.rank) or np.linalg.matrix_rank(chosen) < base.rank:
        names = ", ".join(base.parameters[int(j)] for j in pivots[:5])
        raise UsageError(
            f"The {len(pivots)} parameters {names} ... are no base: {base.rank} independent ones "
            "are needed; take those of 'qr_pivots', or exchange one for another."
        )
    K = np.linalg.solve(chosen, base.K)
    K[:, pivots] = np.eye(base.rank)
    return replace(base, K=K, pivots=np.asarray(pivots))


def same_space(K1: Array, K2: Array) -> float:
    """The largest principal angle (rad) between the row spaces of K1 (r1, p) and K2 (r2, p).

    Zero: both sets of base parameters tell the same. Sets of different size are at a right angle.
    """
    if len(K1) != len(K2):
        return float(np.pi / 2)
    if len(K1) == 0:
        return 0.0
    return float(subspace_angles(K1.T, K2.T).max())
