"""Base parameters: the identifiable linear combinations of the dynamic parameters.

beta = K theta (r,) with Y theta = Y[:, pivots] beta on every motion (Gautier and Khalil 1990;
Gautier 1991). The numerical rank r counts singular values above 1e-5 of the largest. Columns stay
in SI units, since columns scaled to unit length would hide near-parallel axes. Pivots are chosen
greedily from left to right, as published tables of base parameters do.

Structural base parameters of a robot are those of its regressor at random states."""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import qr, solve_triangular

from sysid_bench.errors import count_text
from sysid_bench.models.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorSubtree, instruments_of
from sysid_bench.numerics import qr_factor
from sysid_bench.regressors.sensor_offset import measured_regression
from sysid_bench.types import Array, BaseMap, Trajectory

RANK_TOLERANCE: Final = 1e-5
"""Rank tolerance relative to the largest singular value. Rounded angles in model files cause values
near 1e-9; identifiable parameters stay above 1e-4 (measured on 270 models)."""

NOISE_FLOOR: Final = 1e-12
"""Relative: smaller singular values are rounding errors, larger ones near-degenerate directions."""


PIVOT_FLOORS: Final = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 10 * NOISE_FLOOR)
"""Relative thresholds, tried in this order: a column whose distance from the span of the pivots to
its left is smaller is not a pivot, if columns further right can replace it. Distances below 1e-7
come from rounded angles alone."""

CONDITION: Final = 1e5
"""Maximal condition number of the base columns: the first threshold that satisfies it is used.
Greedy pivots of real robots stay below 4e4 (89 models); those of trees with random angles reach
1e9, which leaves no digits after noise."""


def base_map(R: Array, parameters: tuple[str, ...]) -> BaseMap:
    """Return the base map of a regressor with the R factor R (m, p) and these p parameters."""
    _, values, Vt = np.linalg.svd(R, full_matrices=False)
    largest = values[0] if len(values) else 0.0
    if largest == 0.0:
        return BaseMap(
            np.zeros((0, len(parameters))), np.zeros(0, dtype=int), parameters, np.inf, 0, values
        )
    rank = int((values > RANK_TOLERANCE * largest).sum())
    dropped = values[rank:]
    gap = float(values[rank - 1] / dropped[0]) if dropped.any() else np.inf
    # The rank comes from singular values alone: QR diagonals may miss near-dependence.
    pivots = _left_to_right_pivots(R, rank)
    Q, T = np.linalg.qr(R[:, pivots])
    K = solve_triangular(T, Q.T @ R)
    # The identity exactly, not up to rounding: printed base parameters begin with their pivot.
    K[:, pivots] = np.eye(len(pivots))
    near_degenerate = int((dropped > NOISE_FLOOR * largest).sum())
    # D (near_degenerate, p) with |D theta| = |(R - R_p K) theta|: the remainder has no more
    # directions than those that the rank drops, the rest of it is rounding.
    D = np.zeros((0, R.shape[1]))
    if near_degenerate:
        _, rest, right = np.linalg.svd(R - R[:, pivots] @ K, full_matrices=False)
        D = rest[:near_degenerate, None] * right[:near_degenerate]
    return BaseMap(
        K=K,
        pivots=pivots,
        parameters=parameters,
        gap=gap,
        near_degenerate=near_degenerate,
        singular_values=values,
        row_space=Vt[:rank],
        dropped=D,
    )


class BaseCount(NamedTuple):
    """Number of base parameters, how many dropped directions are near-degenerate, and the ratio of
    the last kept to the first dropped singular value (None: nothing is dropped)."""

    rank: int
    near_degenerate: int
    gap: float | None

    @property
    def dropped_text(self) -> str:
        """Directions that the rank rule drops, in brackets; empty where it drops rounding."""
        if not self.near_degenerate or self.gap is None:
            return ""
        return (
            f" ({count_text(self.near_degenerate, 'near-degenerate direction')} below "
            f"{RANK_TOLERANCE:g} of the largest dropped, gap {self.gap:.3g})"
        )


def base_count(R: Array) -> BaseCount:
    """Return the numbers of `base_map` for a regressor with the R factor R (m, p), at a small share
    of its cost."""
    values = np.linalg.svd(R, compute_uv=False)
    largest = values[0] if len(values) else 0.0
    rank = int((values > RANK_TOLERANCE * largest).sum())
    near = int((values[rank:] > NOISE_FLOOR * largest).sum())
    has_gap = 0 < rank < len(values) and values[rank] > 0
    return BaseCount(rank, near, float(values[rank - 1] / values[rank]) if has_gap else None)


def left_out_torque(base: BaseMap, theta: Array) -> float:
    """Torque that the base parameters of theta (p,) leave out, as a share of the whole torque, both
    RMS over the random states: |(R - R_p K) theta| / |R theta|, at most
    sigma_(r+1) sqrt(1 + |K|^2) |theta| / |R theta|. Zero without near-degenerate directions.
    """
    if base.near_degenerate == 0 or base.dropped is None or base.row_space is None:
        return 0.0
    whole = float(np.linalg.norm(base.singular_values[: base.rank] * (base.row_space @ theta)))
    left_out = float(np.linalg.norm(base.dropped @ theta))
    return left_out / whole if whole > 0 else 0.0


def _left_to_right_pivots(R: Array, rank: int) -> Array:
    """Indices (rank,) of columns that are independent of the pivots to their left.

    Their condition number is below `CONDITION`, or else the best over all thresholds and QR. If
    more than `rank` columns are independent at a threshold, those nearest to the span of the others
    are dropped: they are the near-degenerate directions.
    """
    scale = float(np.linalg.norm(R, 2))
    tried: list[tuple[float, Array]] = []
    for floor in PIVOT_FLOORS:
        found = _independent_columns(R, floor * scale)
        if len(found) < rank:
            continue
        kept = sorted(found, key=lambda item: item[1], reverse=True)[:rank]
        pivots = np.array(sorted(j for j, _ in kept), dtype=int)
        tried.append((float(np.linalg.cond(R[:, pivots])), pivots))
        if tried[-1][0] <= CONDITION:
            return pivots
    fallback = qr_columns(R, rank)
    tried.append((float(np.linalg.cond(R[:, fallback])), fallback))
    return min(tried, key=lambda item: item[0])[1]


def qr_columns(R: Array, rank: int) -> Array:
    """Return the pivots (rank,) of QR with column pivoting of R (m, p), in ascending order.

    Each pivot is the column with the largest residual, wherever it stands (Gautier 1991).
    """
    _, _, order = qr(R, mode="economic", pivoting=True)
    return np.sort(order[:rank])


def _independent_columns(R: Array, floor: float) -> list[tuple[int, float]]:
    """(j, distance) of the columns farther than `floor` from the span of those found before."""
    basis = np.zeros((R.shape[0], min(R.shape)), order="F")
    found: list[tuple[int, float]] = []
    for j in range(R.shape[1]):
        Q = basis[:, : len(found)]
        rest = R[:, j] - Q @ (Q.T @ R[:, j])
        rest = rest - Q @ (Q.T @ rest)  # "twice is enough" for orthogonality (Kahan; Parlett 1980)
        distance = float(np.linalg.norm(rest))
        # Beyond the rows of R a column is rounding alone.
        if distance > floor and len(found) < basis.shape[1]:
            basis[:, len(found)] = rest / distance
            found.append((j, distance))
    return found


NARROWEST = 1.0
"""rad, m: joints with a narrower range are sampled this far, since identifiability is a property of
the tree and not of its limits."""

SEED = 0
"""Seed of the random states; fixed, since the rank is a property of the robot."""

MOST_ROWS = 4096
"""Rows of the regressor beyond three per column: 64 states, or fewer where many joints give enough
rows."""


def structural_base(
    robot: RobotModel,
    parameters: tuple[str, ...],
    rows: tuple[str, ...] | None = None,
    cuts: tuple[SensorSubtree, ...] = (),
) -> BaseMap:
    """Return the base map of the named parameters over all motions of the robot.

    `rows` are the measured ones (None: `robot.torque_rows`); those of the sensors `cuts` may be
    among them. `robot.without_coupling` gives the base parameters of the tree without
    joint couplings.
    """
    return base_map(structural_factor(robot, parameters, rows, cuts), parameters)


def structural_count(robot: RobotModel) -> BaseCount:
    """Return the number of base parameters of all links over all motions, and what is dropped."""
    return base_count(structural_factor(robot, robot.inertial_columns))


def structural_factor(
    robot: RobotModel,
    parameters: tuple[str, ...],
    rows: tuple[str, ...] | None = None,
    cuts: tuple[SensorSubtree, ...] = (),
    appended: Callable[[Trajectory], Array] | None = None,
) -> Array:
    """Return the R factor (m, p) of the regressor over random states, whose row space is that of
    all motions.

    `appended(motion)` returns k further columns (N, rows, k): then R is (m, p + k).
    """
    instruments = instruments_of(robot, cuts)
    # The names of m columns that span all p parameters, and the coefficients X (m, p). Bodies
    # welded to a link act through the link's ten parameters, so that m does not grow with their
    # number
    index = {name: j for j, name in enumerate(robot.inertial_columns)}
    weights: dict[str, Array] = {}
    for j, name in enumerate(parameters):
        acting = {name: 1.0}
        if name in index:
            body, number = divmod(index[name], 10)
            link, column = int(instruments.tree.carrier[body]), instruments.tree.X[body][:, number]
            # Welded to the world (link -1), no joint carries it.
            nonzero = np.flatnonzero(column).tolist() if link >= 0 else []
            first = 10 * instruments.tree.links[link].body
            acting = {robot.inertial_columns[first + k]: float(column[k]) for k in nonzero}
        for column, weight in acting.items():
            weights.setdefault(column, np.zeros(len(parameters)))[j] = weight
    carried, X = tuple(weights), np.array([*weights.values()]).reshape(-1, len(parameters))
    columns = measured_regression(robot, carried, instruments, rows)
    available = instruments.measured
    measured = [available.index(row) for row in (available if rows is None else rows)]
    # Three times as many rows as columns: random states then excite every direction.
    count = min(64, MOST_ROWS // len(measured) + 1) + 3 * len(carried) // len(measured)
    motion = random_states(robot, count, np.random.default_rng(SEED), NARROWEST)
    more = np.zeros((count, len(measured), 0)) if appended is None else appended(motion)
    factors = []
    for block in columns.blocks(instruments.motion(motion)):
        both = np.concatenate([block.dense()[:, measured], more[block.samples]], axis=2)
        factors.append(qr_factor([both.reshape(-1, both.shape[2])]))
    R, m = qr_factor(factors), len(carried)
    return np.hstack([R[:, :m] @ X, R[:, m:]])
