"""Motion of a floating base that a recording gives: filtered, with its rates."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.filter import Filter, derivative
from sysid_bench.signals.log_base import RecordedBase
from sysid_bench.spatial import (
    composed_rotation,
    inverse_quaternion,
    matrix_of_quaternion,
)
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class BaseMotion:
    """Motion of a free joint: q (N, 7), position and quaternion [w, x, y, z] in the world; v and a
    (N, 6), linear in axes of the world, angular in its own ones."""

    q: Array
    v: Array
    a: Array


def base_motion(
    base: RecordedBase, rate: float, gravity: Array, low_pass: Filter, accuracy: int
) -> BaseMotion:
    """Return the motion through a filter at a rate (Hz): rates as they are recorded, else by
    differences of the order `accuracy`. `gravity` (3,) is that of the model, for accelerometers.

    An origin whose velocity is not known is taken at rest: a uniform motion loads no joint.
    """

    def slope(x: Array) -> Array:
        return derivative(low_pass, x, rate, accuracy)

    signals = {name: low_pass.smooth(x, rate) for name, x in base.signals.items()}
    rotation = signals["orientation"]
    rotation = rotation / np.linalg.norm(rotation, axis=1, keepdims=True)
    at_rest = np.zeros((len(rotation), 3))
    position = signals.get("position", at_rest)
    velocity = signals["velocity"] if "velocity" in signals else slope(position)
    turning = signals.get("angular_velocity")
    if turning is None:
        turning = 2.0 * composed_rotation(inverse_quaternion(rotation), slope(rotation))[:, 1:]
    acceleration = signals["acceleration"] if "acceleration" in signals else slope(velocity)
    if base.accelerometer is not None:
        R = matrix_of_quaternion(base.orientation)
        felt = np.einsum("nij,nj->ni", R, base.accelerometer)
        acceleration = low_pass.smooth(felt, rate) + gravity
    return BaseMotion(
        q=np.hstack([position, rotation]),
        v=np.hstack([velocity, turning]),
        a=np.hstack([acceleration, slope(turning)]),
    )


def base_indices(robot: RobotModel) -> tuple[slice, slice]:
    """Return the indices of the free joint in positions q and in velocities v.

    Raises UsageError for a robot without one, or with several.
    """
    free = [joint for joint in robot.joints if joint.kind == "free"]
    if len(free) != 1:
        raise UsageError(
            f"The recording holds the motion of a base, but {robot.name} has {len(free)} free "
            "joints; give a model with one, or leave base out."
        )
    return slice(free[0].qadr, free[0].qadr + 7), slice(free[0].vadr, free[0].vadr + 6)
