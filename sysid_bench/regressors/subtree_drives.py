"""Torques of the drives distal to a force/torque sensor, G(q)^T Y_c.

A drive is an independent degree of freedom with the joints that follow it. Where nothing is
coupled, each joint of the sub-tree is its own drive and G is the identity.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorSubtree
from sysid_bench.regressors.wrench import SubtreeRegressor, subtree_dofs
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class SubtreeDrives:
    """Drives of a sub-tree along a motion, all joints of which are distal to the sensor.

    `rows`: names (d,) with `units`; G (N or 1, k, d): rates of the k degrees of freedom of the
    sub-tree per unit rate of each drive; `followers`: other joints that each moves. `partial`:
    drives that move joints on both sides of the sensor; their torques also need the parameters of
    bodies that the sensor does not carry.
    """

    rows: tuple[str, ...]
    units: tuple[str, ...]
    G: Array
    followers: tuple[tuple[str, ...], ...]
    partial: tuple[str, ...] = ()

    def reduced(self, tau: Array) -> Array:
        """Return G^T tau (N, d, ...) of torques tau (N, k, ...) of the sub-tree's joints."""
        if self.G.shape[0] == 1 and np.array_equal(self.G[0], np.eye(self.G.shape[1])):
            return tau
        G = np.broadcast_to(self.G, (len(tau), *self.G.shape[1:]))
        return np.asarray(np.einsum("nkd,nk...->nd...", G, tau))

    def joints(self, drive: int) -> tuple[int, ...]:
        """Return the indices among the k degrees of freedom of those that a drive moves."""
        return tuple(np.flatnonzero((self.G[:, :, drive] != 0.0).any(axis=0)).tolist())


def subtree_drives(robot: RobotModel, cut: SensorSubtree, q: Array) -> SubtreeDrives:
    """Return the drives distal to a sensor at closed positions q (N, nq or more)."""
    dofs = subtree_dofs(robot, cut)
    if robot.coupling is None:
        units = tuple(robot.torque_units[dof] for dof in dofs)
        names = tuple(robot.rows[dof] for dof in dofs)
        return SubtreeDrives(names, units, np.eye(len(dofs))[None], ((),) * len(dofs))
    moved = _moved_dofs(robot)
    whole = [i for i, joints in enumerate(moved) if joints <= {*dofs}]
    partial = [i for i, joints in enumerate(moved) if joints & {*dofs} and i not in whole]
    rows = robot.torque_rows
    G = robot.coupling.G(q[:, : robot.mj.nq])[:, list(dofs)][:, :, whole]
    return SubtreeDrives(
        rows=tuple(rows[i] for i in whole),
        units=tuple(robot.torque_units[i] for i in whole),
        G=G,
        followers=tuple(_names(robot, moved[i] - {int(robot.torque_dofs[i])}) for i in whole),
        partial=tuple(rows[i] for i in partial),
    )


def _moved_dofs(robot: RobotModel) -> list[set[int]]:
    """Degrees of freedom that each independent one moves, itself included."""
    coupling = robot.coupling
    assert coupling is not None
    return [
        {int(dof), *coupling.dependent[column].tolist()}
        for dof, column in zip(coupling.independent, coupling.is_coupled.T, strict=True)
    ]


def _names(robot: RobotModel, dofs: Collection[int]) -> tuple[str, ...]:
    return tuple(robot.rows[dof] for dof in sorted(dofs))


def _drive_torque(subtree: SubtreeRegressor, drives: SubtreeDrives) -> Array:
    """Return G^T Y_c (N, d, p), the torques of the drives with the base at the sensor."""
    return drives.reduced(subtree.Y_c)
