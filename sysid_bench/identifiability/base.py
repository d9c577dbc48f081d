"""Base parameters: what the torques of any motion can tell (Gautier & Khalil 1990; Gautier 1991).

Rank is counted on SI columns of random states, singular values above 1e-5 of the largest: unit
columns hide near-parallel axes. Pivots are taken greedily from left to right, as papers print them.
"""

from typing import Final

import numpy as np
from scipy.linalg import solve_triangular

from sysid_bench.types import Array, BaseMap

RANK_TOLERANCE: Final = 1e-5
"""Relative to the largest singular value: rounded angles in model files leave values near 1e-9,
true parameters stay above 1e-4 (measured on 270 models)."""

NOISE_FLOOR: Final = 1e-12
"""Relative; below it a singular value is rounding error, above it a near-degenerate direction."""


PIVOT_FLOORS: Final = (1e-7, 10 * NOISE_FLOOR)
"""Relative; the first that leaves enough columns. Below it a column rises by rounded angles alone:
a base set with such a pivot in place of its neighbour to the right has a condition of 1e9."""


def base_map(R: Array, parameters: tuple[str, ...]) -> BaseMap:
    """The base parameters of a regressor known by its R factor (m, p)."""
    values = np.linalg.svd(R, compute_uv=False)
    largest = values[0] if len(values) else 0.0
    if largest == 0.0:
        return BaseMap(
            np.zeros((0, len(parameters))), np.zeros(0, dtype=int), parameters, np.inf, 0, values
        )
    rank = int((values > RANK_TOLERANCE * largest).sum())
    dropped = values[rank:]
    gap = float(values[rank - 1] / max(dropped[0], 1e-300)) if len(dropped) else np.inf
    pivots = left_to_right_pivots(R, rank)
    return BaseMap(
        K=_combinations(R, pivots),
        pivots=pivots,
        parameters=parameters,
        gap=gap,
        near_degenerate=int((dropped > NOISE_FLOOR * largest).sum()),
        singular_values=values,
    )


def left_to_right_pivots(R: Array, rank: int) -> Array:
    """Columns (rank,) that are independent of the columns picked to the left of them.

    Where more than `rank` columns look independent at the noise floor, those that stand out least
    are left: the near-degenerate directions.
    """
    scale = float(np.linalg.norm(R, 2))
    found: list[tuple[int, float]] = []
    for floor in PIVOT_FLOORS:
        found = _standing_out(R, floor * scale)
        if len(found) >= rank:
            break
    kept = sorted(found, key=lambda item: item[1], reverse=True)[:rank]
    return np.array(sorted(j for j, _ in kept), dtype=int)


def _standing_out(R: Array, floor: float) -> list[tuple[int, float]]:
    """Columns that rise more than `floor` above those picked to the left of them: (j, height)."""
    Q = np.zeros((R.shape[0], 0))
    found: list[tuple[int, float]] = []
    for j in range(R.shape[1]):
        rest = R[:, j] - Q @ (Q.T @ R[:, j])
        rest = rest - Q @ (Q.T @ rest)  # twice is enough (Kahan, Parlett)
        height = float(np.linalg.norm(rest))
        if height > floor:
            found.append((j, height))
            Q = np.column_stack([Q, rest / height])
    return found


def _combinations(R: Array, pivots: Array) -> Array:
    """K (r, p) with R = R[:, pivots] K, the identity on the pivots."""
    Q, T = np.linalg.qr(R[:, pivots])
    K = solve_triangular(T, Q.T @ R)
    K[:, pivots] = np.eye(len(pivots))
    return K
