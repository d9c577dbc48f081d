"""Change of pivots: the same space of base parameters, led by other parameters."""

from dataclasses import replace

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.types import Array, BaseMap


def rebase(base: BaseMap, pivots: Array) -> BaseMap:
    """Return the base map with the given pivots (r,): K becomes K[:, pivots]^-1 K.

    Raises UsageError if these parameters are not independent.
    """
    chosen = base.K[:, pivots]
    if chosen.shape != (base.rank, base.rank) or np.linalg.matrix_rank(chosen) < base.rank:
        names = ", ".join(base.parameters[int(j)] for j in pivots[:5])
        raise UsageError(
            f"The {len(pivots)} parameters {names} ... are not a base: {base.rank} independent "
            "ones are needed; take those of 'qr_pivots', or exchange some of them."
        )
    K = np.linalg.solve(chosen, base.K)
    K[:, pivots] = np.eye(base.rank)
    return replace(base, K=K, pivots=np.asarray(pivots))
