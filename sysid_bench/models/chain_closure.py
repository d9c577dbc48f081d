"""Closed chains of a robot: the bodies that each joins, and those that lead past a sensor."""

import mujoco

from sysid_bench.errors import UnsupportedError
from sysid_bench.models.coupling.equalities import closure_frames
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorSubtree


def chain_bodies(robot: RobotModel) -> tuple[tuple[int, int], ...]:
    """Return the two bodies that each closed chain joins, -1 for the world; none where the robot's
    couplings are ignored."""
    if robot.coupling is None:
        return ()
    kinds = int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)
    chains = [e for e in range(robot.mj.neq) if robot.mj.eq_type[e] in kinds]
    ends = [[body - 1 for body, _, _ in closure_frames(robot.mj, e)] for e in chains]
    return tuple((one, other) for one, other in ends)


def check_chain(robot: RobotModel, cut: SensorSubtree) -> None:
    """Raise UnsupportedError where a closed chain leads past a sensor: its closing force also acts
    on the sub-tree, and the sensor does not measure it."""
    names = [*robot.body_names, "world"]
    for one, other in chain_bodies(robot):
        if (one in cut.bodies) != (other in cut.bodies):
            raise UnsupportedError(
                f"{robot.name}: a closed chain joins {names[one]} and {names[other]} past the "
                f"sensor {cut.name}, which does not measure its force; cut proximal or distal to "
                "the whole chain."
            )
