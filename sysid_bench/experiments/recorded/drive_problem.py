"""Problems of actuators with known links: one row for each joint, at a delay of the commands."""

from collections.abc import Iterator

import numpy as np

from sysid_bench.apps.actuators.drive_rows import UNKNOWNS, DriveRows
from sysid_bench.qr_factor import qr_factor
from sysid_bench.types import Array, BaseMap, Factor, Problem, RowBlock


def drive_problem(rows: DriveRows, delay: float, kinds: tuple[str, ...]) -> Problem:
    """Return the problem of the values of all joints ("knee.Ia", ...) at a delay (s) of the
    commands; `kinds` of the rows, as in `Problem`."""
    tau, count = rows.torque(delay), len(UNKNOWNS)
    names = tuple(f"{joint}.{term}" for joint in rows.joints for term in UNKNOWNS)
    factors = tuple(
        _factor(joint, count * j, rows.features[:, j], tau[:, j])
        for j, joint in enumerate(rows.joints)
    )
    return Problem(
        parameters=names,
        base=_all_of(names),
        rows=rows.joints,
        factors=factors,
        bodies=(),
        blocks=lambda: _blocks(rows.features, tau),
        samples=len(tau),
        kinds=kinds,
        torque=np.sqrt(np.mean((tau + rows.links) ** 2, axis=0)),
    )


def _factor(joint: str, first: int, A: Array, tau: Array) -> Factor:
    columns = np.arange(first, first + A.shape[1])
    return Factor(joint, columns, qr_factor([np.column_stack([A, tau])]), len(tau))


def _all_of(names: tuple[str, ...]) -> BaseMap:
    """The map of values that are identifiable one by one."""
    every = np.eye(len(names))
    return BaseMap(every, np.arange(len(names)), names, np.inf, 0, np.ones(len(names)))


def _blocks(features: Array, tau: Array) -> Iterator[RowBlock]:
    """The rows of all joints in one block."""
    N, k, c = features.shape
    W = np.zeros((N, k, k * c))
    for j in range(k):
        W[:, j, c * j : c * (j + 1)] = features[:, j]
    yield W, tau
