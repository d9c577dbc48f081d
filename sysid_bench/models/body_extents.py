"""Bounding boxes of bodies, from what every model file states: joints, shapes and child frames."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.spatial import matrix_of_quaternion
from sysid_bench.types import Array, BodyExtents

if TYPE_CHECKING:
    import mujoco

MARGIN: Final = 0.2
"""m; margin around a body: housings, motors and tools reach beyond the joints that they hold."""

LAST: Final = 0.4
"""m; margin of a body that carries no other, such as a torso without a head: its extent is unknown.
"""

SHARE: Final = 0.5
"""Margin as a share of the diagonal: links bow out from the line between their joints."""

HOUSING: Final = 0.1
"""m around the joints; little mass lies further out."""


def body_extents(robot: RobotModel) -> Mapping[str, BodyExtents]:
    """Return the bounding box of each body (m, body frame): around its frame, joints, shapes
    (MJCF), the frames of its children and all that is welded to it, widened by margins.

    Generous: it only excludes centres of mass that are impossible. A payload, of which nothing is
    known, has none.
    """
    return {
        name: _extent(robot.mj, i + 1)  # MuJoCo counts the world
        for i, name in enumerate(robot.body_names)
        if i != robot.payload_body
    }


def _extent(mj: "mujoco.MjModel", body: int) -> BodyExtents:
    points = _points(mj, body)
    low, high = points.min(axis=0), points.max(axis=0)
    margin = MARGIN if (mj.body_parentid[1:] == body).any() else LAST
    reach = margin + SHARE * float(np.linalg.norm(high - low))
    volume = float(np.prod(high - low + 2 * HOUSING))
    return BodyExtents(low - reach, high + reach, volume)


def _points(mj: "mujoco.MjModel", body: int) -> Array:
    """Points (k, 3) of a body in its frame; those of welded children are turned into it."""
    points = [np.zeros(3)]
    points += [np.array(mj.jnt_pos[j]) for j in np.flatnonzero(mj.jnt_bodyid == body)]
    for g in np.flatnonzero(mj.geom_bodyid == body):
        points += list(_shape(mj, int(g)))
    for child in np.flatnonzero(mj.body_parentid == body):
        points += _child_points(mj, int(child))
    return np.array(points)


def _child_points(mj: "mujoco.MjModel", child: int) -> list[Array]:
    """The origin of a child in its parent's frame, and all its points where it is welded to it."""
    origin = np.array(mj.body_pos[child])
    if mj.body_jntnum[child] > 0:
        return [origin]
    R = matrix_of_quaternion(np.array(mj.body_quat[child]))
    return [origin, *(origin + _points(mj, child) @ R.T)]


def _shape(mj: "mujoco.MjModel", geom: int) -> Array:
    """Corners (8, 3) of the box around a shape, in the body frame."""
    # MuJoCo's box is aligned with the axes of the geom, not with those of the body.
    centre, half = np.split(np.array(mj.geom_aabb[geom]), 2)
    corners = centre + half * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    R = matrix_of_quaternion(np.array(mj.geom_quat[geom]))
    turned: Array = np.array(mj.geom_pos[geom]) + corners @ R.T
    return turned
