"""Base parameters: what the torques of any motion can tell (Gautier & Khalil 1990; Gautier 1991).

Rank is counted on SI columns of random states, singular values above 1e-5 of the largest: unit
columns hide near-parallel axes. Pivots are taken greedily from left to right, as papers print them.
"""

from typing import Final

import numpy as np
from scipy.linalg import qr, solve_triangular

from sysid_bench.types import Array, BaseMap

RANK_TOLERANCE: Final = 1e-5
"""Relative to the largest singular value: rounded angles in model files leave values near 1e-9,
true parameters stay above 1e-4 (measured on 270 models)."""

NOISE_FLOOR: Final = 1e-12
"""Relative; below it a singular value is rounding error, above it a near-degenerate direction."""


PIVOT_FLOORS: Final = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 10 * NOISE_FLOOR)
"""Relative; a column that rises less above those to the left of it is no pivot where its neighbours
to the right can take its place. Below 1e-7 it rises by rounded angles alone."""

CONDITION: Final = 1e5
"""Of the base columns: the first floor that keeps it is taken. From left to right the robots of
engineers stay below 4e4 (89 models); trees at random angles reach 1e9, which no data bear."""


def base_map(R: Array, parameters: tuple[str, ...]) -> BaseMap:
    """The base parameters of a regressor known by its R factor (m, p)."""
    _, values, Vt = np.linalg.svd(R, full_matrices=False)
    largest = values[0] if len(values) else 0.0
    if largest == 0.0:
        return BaseMap(
            np.zeros((0, len(parameters))), np.zeros(0, dtype=int), parameters, np.inf, 0, values
        )
    rank = int((values > RANK_TOLERANCE * largest).sum())
    dropped = values[rank:]
    gap = float(values[rank - 1] / dropped[0]) if dropped.any() else np.inf
    pivots = _left_to_right_pivots(R, rank)
    K = _combinations(R, pivots)
    near_degenerate = int((dropped > NOISE_FLOOR * largest).sum())
    return BaseMap(
        K=K,
        pivots=pivots,
        parameters=parameters,
        gap=gap,
        near_degenerate=near_degenerate,
        singular_values=values,
        row_space=Vt[:rank],
        dropped=_dropped_factor(R, pivots, K, near_degenerate),
    )


def dropped_torque(base: BaseMap, theta: Array) -> float:
    """Torque that the base parameters of theta (p,) leave out, as a share of the whole torque, both
    RMS over the random states: |(R - R_p K) theta| / |R theta|, at most
    sigma_(r+1) sqrt(1 + |K|^2) |theta| / |R theta|. Zero without near-degenerate directions.
    """
    if base.near_degenerate == 0 or base.dropped is None or base.row_space is None:
        return 0.0
    whole = float(np.linalg.norm(base.singular_values[: base.rank] * (base.row_space @ theta)))
    left_out = float(np.linalg.norm(base.dropped @ theta))
    return left_out / whole if whole > 0 else 0.0


def _dropped_factor(R: Array, pivots: Array, K: Array, count: int) -> Array:
    """D (count, p) with |D theta| = |(R - R_p K) theta|: the remainder has no more directions than
    those that the rank drops, the rest of it is rounding."""
    if count == 0:
        return np.zeros((0, R.shape[1]))
    _, values, Vt = np.linalg.svd(R - R[:, pivots] @ K, full_matrices=False)
    return values[:count, None] * Vt[:count]


def _left_to_right_pivots(R: Array, rank: int) -> Array:
    """Columns (rank,) that are independent of the columns picked to the left of them, and bear
    data: their condition is below `CONDITION`, or the best that any floor, or QR, gives.

    Where more than `rank` columns look independent at the noise floor, those that stand out least
    are left: the near-degenerate directions.
    """
    scale = float(np.linalg.norm(R, 2))
    tried: list[tuple[float, Array]] = []
    for floor in PIVOT_FLOORS:
        found = _standing_out(R, floor * scale)
        if len(found) < rank:
            continue
        kept = sorted(found, key=lambda item: item[1], reverse=True)[:rank]
        pivots = np.array(sorted(j for j, _ in kept), dtype=int)
        tried.append((float(np.linalg.cond(R[:, pivots])), pivots))
        if tried[-1][0] <= CONDITION:
            return pivots
    fallback = qr_pivots(R, rank)
    tried.append((float(np.linalg.cond(R[:, fallback])), fallback))
    return min(tried, key=lambda item: item[0])[1]


def qr_pivots(R: Array, rank: int) -> Array:
    """Columns (rank,) that QR with column pivoting picks, in their order in R (m, p): each the one
    with the longest remainder, whatever its place. Gautier (1991)."""
    _, _, order = qr(R, mode="economic", pivoting=True)
    return np.sort(order[:rank])


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
