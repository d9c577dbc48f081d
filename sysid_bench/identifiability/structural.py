"""Structural base parameters of a robot, computed from the regressor at random states."""

from collections.abc import Callable

import numpy as np

from sysid_bench.identifiability.base_map import base_count, base_map
from sysid_bench.models.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorSubtree, instruments_of
from sysid_bench.models.tree import Tree
from sysid_bench.qr_factor import qr_factor
from sysid_bench.regressors.sensor_offset import measured_regression
from sysid_bench.types import Array, BaseMap, Trajectory

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


def structural_count(robot: RobotModel) -> tuple[int, int]:
    """Return the number of base parameters of all links over all motions, and of near-degenerate
    directions."""
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
    carried, X = _carrier_columns(robot, instruments.tree, parameters)
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


def _carrier_columns(
    robot: RobotModel, tree: Tree, parameters: tuple[str, ...]
) -> tuple[tuple[str, ...], Array]:
    """Names of m columns that span all p, and the coefficients X (m, p).

    Bodies welded to a link act through the link's ten parameters, so that m does not grow with
    their number.
    """
    index = {name: j for j, name in enumerate(robot.inertial_columns)}
    weights: dict[str, Array] = {}
    for j, name in enumerate(parameters):
        acting = _on_link(robot, tree, index[name]) if name in index else {name: 1.0}
        for column, weight in acting.items():
            weights.setdefault(column, np.zeros(len(parameters)))[j] = weight
    return tuple(weights), np.array([*weights.values()]).reshape(-1, len(parameters))


def _on_link(robot: RobotModel, tree: Tree, index: int) -> dict[str, float]:
    """Parameters of the carrying link, with their coefficients, that act as one of a body does."""
    body, number = divmod(index, 10)
    link = int(tree.carrier[body])
    if link < 0:  # welded to the world: no joint carries it
        return {}
    first, X = 10 * tree.links[link].body, tree.X[body]
    nonzero = np.flatnonzero(X[:, number]).tolist()
    return {robot.inertial_columns[first + k]: float(X[k, number]) for k in nonzero}
