"""Random states of a robot: what structural questions are asked with."""

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, Trajectory

LARGEST = 2.0
"""Random positions stay within this of the reference where a joint's range is wider (rad, m)."""


def random_states(robot: RobotModel, count: int, rng: np.random.Generator) -> Trajectory:
    """Independent states: q uniform in its limits, orientations too, v and a standard normal."""
    q = np.tile(robot.mj.qpos0, (count, 1))
    for joint in robot.joints:
        at = joint.qadr
        if joint.kind == "free":
            q[:, at : at + 3] += rng.normal(size=(count, 3))
            q[:, at + 3 : at + 7] = _orientations(count, rng)
        elif joint.kind == "ball":
            q[:, at : at + 4] = _orientations(count, rng)
        else:
            low = max(robot.limits.q_low[joint.vadr], robot.mj.qpos0[at] - LARGEST)
            high = min(robot.limits.q_high[joint.vadr], robot.mj.qpos0[at] + LARGEST)
            if not low < high:  # a range that lies away from the reference
                low, high = robot.limits.q_low[joint.vadr], robot.limits.q_high[joint.vadr]
            q[:, at] = rng.uniform(low, high, count)
    v, a = rng.normal(size=(2, count, robot.nv))
    return Trajectory(np.arange(count, dtype=float), q, v, a, "random states")


def _orientations(count: int, rng: np.random.Generator) -> Array:
    quaternion = rng.normal(size=(count, 4))
    return quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
