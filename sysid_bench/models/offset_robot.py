"""Robots whose geometry differs slightly from that of another: displaced frames, turned gravity,
other slopes of couplings. Link parameters stay the same numbers in the links' own frames."""

from collections.abc import Mapping
from dataclasses import replace

import mujoco
import numpy as np

from sysid_bench.errors import ModelError
from sysid_bench.models.coupling.build import group_constraints, group_of
from sysid_bench.models.coupling.coordinates import coordinates_of
from sysid_bench.models.coupling.equalities import equalities_of
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.tree import tree_of
from sysid_bench.spatial import composed_rotation, matrix_of_quaternion, quaternion_of_rotation
from sysid_bench.types import Array

BodyOffset = tuple[Array, Array]
"""Translation (3,) in m and rotation vector (3,) in rad, in the axes of the displaced frame."""


def with_body_offset(robot: RobotModel, displacements: Mapping[int, BodyOffset]) -> RobotModel:
    """Return the robot with the frames of bodies (by their index) displaced in their parents.

    Joints, inertia and children of a body move with its frame. Closed chains stay closed in their
    reference posture. Raises ModelError for a frame that cannot be displaced.
    """
    spec = robot.spec.copy()
    poses = {}
    for b, (shift, turn) in displacements.items():
        # MuJoCo counts the world as body 0.
        origin, axes = np.array(robot.mj.body_pos[b + 1]), np.array(robot.mj.body_quat[b + 1])
        turned = composed_rotation(axes, quaternion_of_rotation(turn))
        poses[b] = (origin + matrix_of_quaternion(axes) @ shift, turned)
    for b, (position, quaternion) in poses.items():
        body = spec.body(robot.body_names[b])
        body.pos, body.quat = position, quaternion
        # Else euler or axisangle in the text of the model would win over quat.
        body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    changed = _rebuilt(robot, spec)
    for b, (position, _) in poses.items():
        if not np.allclose(changed.mj.body_pos[b + 1], position, atol=1e-9):
            raise ModelError(
                f"{robot.name}: the frame of {robot.body_names[b]!r} cannot be displaced, since "
                "the model places it by a frame of its own."
            )
    return changed


def with_gravity(robot: RobotModel, gravity: Array) -> RobotModel:
    """Return the robot under another gravity (3,), m/s^2 in the world frame."""
    spec = robot.spec.copy()
    spec.option.gravity = gravity
    return _rebuilt(robot, spec)


def with_scaled_coupling(robot: RobotModel, factors: Mapping[int, float]) -> RobotModel:
    """Return the robot with the slopes of joint and tendon equalities, by number, times a
    factor."""
    spec = robot.spec.copy()
    equalities = list(spec.equalities)
    for e, factor in factors.items():
        data = np.array(equalities[e].data)
        data[1:5] *= factor  # coefficients of the polynomial, without the constant
        equalities[e].data = data
    return _rebuilt(robot, spec)


def _rebuilt(robot: RobotModel, spec: mujoco.MjSpec) -> RobotModel:
    """The robot of a changed spec, with the names, limits and parameters of `robot`, and the same
    independent joints."""
    mj = spec.compile()
    coupling = robot.coupling
    if coupling is not None:
        coordinates = coordinates_of(robot.joints, mj.qpos0, robot.nv)
        independent = frozenset(coupling.independent.tolist())
        groups = tuple(
            group_of(members, coordinates, coupling.names, frozenset(), independent)
            for members in group_constraints(equalities_of(mj).constraints)
        )
        coupling = replace(coupling, groups=groups, coordinates=coordinates)
    return replace(robot, mj=mj, spec=spec, tree=tree_of(mj), coupling=coupling)
