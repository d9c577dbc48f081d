"""Random states of a robot, for structural identifiability and cross-checks."""

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, Trajectory

LARGEST = 2.0
"""rad, m; half width of the window for random positions where the range of a joint is wider."""


def random_states(
    robot: RobotModel, count: int, rng: np.random.Generator, narrowest: float = 0.0
) -> Trajectory:
    """Return independent states: q and orientations uniform, v and a standard normal; of coupled
    joints the independent ones are drawn.

    `narrowest` (rad, m): smaller ranges of uncoupled joints are widened to it.
    """
    if robot.coupling is not None:
        # v and a are drawn for the whole tree; those of dependent joints are replaced at the end.
        free = random_states(robot.without_coupling, count, rng, narrowest)
        values = np.zeros((count, len(robot.coupling.independent)))
        drawn = zip(
            robot.coupling.independent, robot.coupling.low, robot.coupling.high, strict=True
        )
        for k, (dof, low, high) in enumerate(drawn):
            if dof not in robot.coupling.bounded_dofs:
                continue  # a floating base turns in all directions
            values[:, k] = rng.uniform(*_window(low, high, float(robot.coupling.q0[dof])), count)
        q = robot.coupling.with_positions(free.q, values)
        return Trajectory(free.t, *robot.coupling.completed(q, free.v, free.a), free.name)
    q = np.tile(robot.mj.qpos0, (count, 1))
    for joint in robot.joints:
        start = joint.qadr
        if joint.kind == "free":
            q[:, start : start + 3] += rng.normal(size=(count, 3))
            q[:, start + 3 : start + 7] = _orientations(count, rng)
        elif joint.kind == "ball":
            q[:, start : start + 4] = _orientations(count, rng)
        else:
            low, high = robot.limits.q_low[joint.vadr], robot.limits.q_high[joint.vadr]
            more = max(0.5 * (narrowest - (high - low)), 0.0)
            low, high = low - more, high + more
            q[:, start] = rng.uniform(*_window(low, high, float(robot.mj.qpos0[start])), count)
    v, a = rng.normal(size=(2, count, robot.nv))
    return Trajectory(np.arange(count, dtype=float), q, v, a, "random states")


def _window(low: float, high: float, reference: float) -> tuple[float, float]:
    """The part of a range that is drawn from: of full width and nearest to the reference. Around a
    reference at an end of the range it would be too narrow to separate parameters."""
    if high - low <= 2 * LARGEST:
        return low, high
    centre = min(max(reference, low + LARGEST), high - LARGEST)
    return centre - LARGEST, centre + LARGEST


def _orientations(count: int, rng: np.random.Generator) -> Array:
    # The direction of a normal vector is uniform on the sphere, here that of unit quaternions.
    quaternion = rng.normal(size=(count, 4))
    unit: Array = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    return unit
