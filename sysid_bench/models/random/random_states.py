"""Random states of a robot: what structural questions are asked with."""

import numpy as np

from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, Trajectory

LARGEST = 2.0
"""Random positions come from a window of twice this where a joint's range is wider (rad, m)."""


def random_states(
    robot: RobotModel, count: int, rng: np.random.Generator, narrowest: float = 0.0
) -> Trajectory:
    """Independent states: q uniform in its limits, orientations too, v and a standard normal; of
    coupled joints the independent ones, and the others follow.

    `narrowest` (rad, m): ranges below it are widened to it, of joints that move on their own."""
    if robot.coupling is not None:
        return _coupled_states(robot, robot.coupling, count, rng, narrowest)
    q = np.tile(robot.mj.qpos0, (count, 1))
    for joint in robot.joints:
        at = joint.qadr
        if joint.kind == "free":
            q[:, at : at + 3] += rng.normal(size=(count, 3))
            q[:, at + 3 : at + 7] = _orientations(count, rng)
        elif joint.kind == "ball":
            q[:, at : at + 4] = _orientations(count, rng)
        else:
            low, high = robot.limits.q_low[joint.vadr], robot.limits.q_high[joint.vadr]
            low, high = _widened(low, high, narrowest)
            q[:, at] = rng.uniform(*_window(low, high, float(robot.mj.qpos0[at])), count)
    v, a = rng.normal(size=(2, count, robot.nv))
    return Trajectory(np.arange(count, dtype=float), q, v, a, "random states")


def _coupled_states(
    robot: RobotModel,
    coupling: Coupling,
    count: int,
    rng: np.random.Generator,
    narrowest: float,
) -> Trajectory:
    free = random_states(robot.uncoupled, count, rng, narrowest)
    q = free.q.copy()
    for dof, low, high in zip(coupling.independent, coupling.low, coupling.high, strict=True):
        at = coupling.qadr[dof]
        if at >= 0:
            q[:, at] = rng.uniform(*_window(low, high, float(robot.mj.qpos0[at])), count)
    return Trajectory(free.t, *coupling.completed(q, free.v, free.a), free.name)


def _widened(low: float, high: float, narrowest: float) -> tuple[float, float]:
    more = max(0.5 * (narrowest - (high - low)), 0.0)
    return low - more, high + more


def _window(low: float, high: float, reference: float) -> tuple[float, float]:
    """As much of a range as is drawn from, nearest to the reference: where that lies at an end or
    outside, the part of the range around it alone would be too narrow to tell parameters apart."""
    if high - low <= 2 * LARGEST:
        return low, high
    centre = min(max(reference, low + LARGEST), high - LARGEST)
    return centre - LARGEST, centre + LARGEST


def _orientations(count: int, rng: np.random.Generator) -> Array:
    quaternion = rng.normal(size=(count, 4))
    return quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
