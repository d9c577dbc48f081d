"""The base parameters of a robot's task, asked with random states."""

from collections.abc import Callable

import numpy as np

from sysid_bench.identifiability.base_map import base_map
from sysid_bench.models.random.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorCut, instruments_of
from sysid_bench.models.tree import Tree
from sysid_bench.regressors.nested_sensors import measured_regression
from sysid_bench.regressors.qr_accumulation import upper_factor
from sysid_bench.types import Array, BaseMap, Trajectory

NARROWEST = 1.0
"""rad, m: joints with less range move this far, since what acts is a property of the tree."""

SEED = 0
"""The same random states for everybody: a rank is a property of the robot, not of a draw."""


def structural_base(
    robot: RobotModel,
    parameters: tuple[str, ...],
    rows: tuple[str, ...] | None = None,
    cuts: tuple[SensorCut, ...] = (),
) -> BaseMap:
    """The base map of the named parameters over all motions of the robot; `rows`: what is measured
    (None: `robot.torque_rows`), among the rows of the sensors `cuts` too. `robot.uncoupled` has the
    base of the whole tree."""
    return base_map(structural_factor(robot, parameters, rows, cuts), parameters)


def structural_factor(
    robot: RobotModel,
    parameters: tuple[str, ...],
    rows: tuple[str, ...] | None = None,
    cuts: tuple[SensorCut, ...] = (),
    beside: Callable[[Trajectory], Array] | None = None,
) -> Array:
    """R (m, p) of the regressor over random states, whose column space is that of all motions;
    `beside` gives more columns (N, rows, k) along a motion, which come last: R (m, p + k)."""
    instruments = instruments_of(robot, cuts)
    carried, X = _carrier_columns(robot, instruments.tree, parameters)
    columns = measured_regression(robot, carried, instruments, rows)
    own = instruments.measured
    measured = [own.index(row) for row in (own if rows is None else rows)]
    count = 64 + 3 * len(carried) // len(measured)
    motion = random_states(robot, count, np.random.default_rng(SEED), NARROWEST)
    more = np.zeros((count, len(measured), 0)) if beside is None else beside(motion)
    factors = []
    for block in columns.blocks(instruments.motion(motion)):
        both = np.concatenate([block.dense()[:, measured], more[block.samples]], axis=2)
        factors.append(upper_factor([both.reshape(-1, both.shape[2])]))
    R, m = upper_factor(factors), len(carried)
    return np.hstack([R[:, :m] @ X, R[:, m:]])


def _carrier_columns(
    robot: RobotModel, tree: Tree, parameters: tuple[str, ...]
) -> tuple[tuple[str, ...], Array]:
    """Columns that all others are mixed from, and the mixture X (m, p): what is welded to a link
    acts through that link's ten numbers, however many bodies that are."""
    place = {name: j for j, name in enumerate(robot.inertial_columns)}
    rows: dict[str, dict[int, float]] = {}
    for j, name in enumerate(parameters):
        if name not in place:
            rows.setdefault(name, {})[j] = 1.0
            continue
        body, number = divmod(place[name], 10)
        link = int(tree.carrier[body])
        if link >= 0:
            first = 10 * tree.links[link].body
            for k in np.flatnonzero(tree.X[body][:, number]):
                own = robot.inertial_columns[first + int(k)]
                rows.setdefault(own, {})[j] = float(tree.X[body][k, number])
    X = np.zeros((len(rows), len(parameters)))
    for i, mixture in enumerate(rows.values()):
        X[i, list(mixture)] = list(mixture.values())
    return tuple(rows), X
