"""Curves of a training motion with the limits of the joints, as Fig. 5 of Fontanelli et al. (2017)
shows the motion of an identification."""

from collections.abc import Iterator

import numpy as np

from sysid_bench.models.robot import Joint, RobotModel
from sysid_bench.types import Curve, Trajectory

POINTS = 1000
"""Samples of a curve at most, about: more cannot be seen in print."""


def motion_curves(robot: RobotModel, motion: Trajectory) -> tuple[Curve, ...]:
    """Return position and velocity (rad, m, /s) of each hinge and slide that has coordinates of its
    own, with their limits where these are stated."""
    step = max(len(motion) // POINTS, 1)
    thin = Trajectory(motion.t[::step], motion.q[::step], motion.v[::step], motion.a[::step])
    moving = set(robot.torque_dofs)
    return tuple(
        curve
        for joint in robot.joints
        if joint.kind in ("hinge", "slide") and joint.vadr in moving
        for curve in _curves(robot, joint, thin)
    )


def _curves(robot: RobotModel, joint: Joint, motion: Trajectory) -> Iterator[Curve]:
    limits, k = robot.limits, joint.vadr
    unit = "rad" if joint.kind == "hinge" else "m"
    q, v = motion.q[:, joint.qadr], motion.v[:, k]
    yield Curve(joint.name, motion.t, {"": q}, unit, _finite(limits.q_low[k], limits.q_high[k]))
    yield Curve(joint.name, motion.t, {"": v}, f"{unit}/s", _finite(-limits.v[k], limits.v[k]))


def _finite(low: float, high: float) -> tuple[float, float] | None:
    """The limits, None where they are not stated."""
    return (float(low), float(high)) if np.isfinite(high - low) else None
