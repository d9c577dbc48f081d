"""How far a body reaches, from what every model file tells: where its joints and neighbours are."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.spatial.rotation import matrix_of_quaternion
from sysid_bench.types import Array, Extent

MARGIN: Final = 0.2
"""m; housings, motors and tools reach beyond the joints that they hold."""

LAST: Final = 0.4
"""m; the same of a body that carries no other, as a torso without a head: nothing else tells how
far it reaches."""

SHARE: Final = 0.5
"""Of the box around the joints: links bow out beside the line between them."""

HOUSING: Final = 0.1
"""m around the joints; what is further out is too little to hold much mass."""


def body_extents(robot: RobotModel) -> Mapping[str, Extent]:
    """Of each body the box around its frame, its joints, its shapes (MJCF), the frames of bodies
    that it carries and all of those that are welded to it, widened by margins.

    Generous: it tells a centre of mass that cannot be from one that can, no more. A payload, of
    which nothing is known, has none.
    """
    mj, boxes = robot.mj, {}
    for i, name in enumerate(robot.body_names):
        if i != robot.payload_body:
            points = _points(mj, i + 1)  # MuJoCo counts the world
            low, high = points.min(axis=0), points.max(axis=0)
            carries = (mj.body_parentid[1:] == i + 1).any()
            margin = MARGIN if carries else LAST
            reach = margin + SHARE * float(np.linalg.norm(high - low))
            volume = float(np.prod(high - low + 2 * HOUSING))
            boxes[name] = Extent(low - reach, high + reach, volume)
    return boxes


def _points(mj, body: int) -> Array:  # type: ignore[no-untyped-def]
    points = [np.zeros(3)]
    points += [np.array(mj.jnt_pos[j]) for j in np.flatnonzero(mj.jnt_bodyid == body)]
    for g in np.flatnonzero(mj.geom_bodyid == body):
        points += list(_shape(mj, int(g)))
    for child in np.flatnonzero(mj.body_parentid == body):
        if child == body:
            continue
        origin = np.array(mj.body_pos[child])
        points.append(origin)
        if mj.body_jntnum[child] == 0:
            R = matrix_of_quaternion(np.array(mj.body_quat[child]))
            points += list(origin + _points(mj, int(child)) @ R.T)
    return np.array(points)


def _shape(mj, geom: int) -> Array:  # type: ignore[no-untyped-def]
    """The corners (8, 3) of the box around a shape."""
    centre, half = np.split(np.array(mj.geom_aabb[geom]), 2)
    corners = centre + half * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    R = matrix_of_quaternion(np.array(mj.geom_quat[geom]))
    return np.array(mj.geom_pos[geom]) + corners @ R.T
