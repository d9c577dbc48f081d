"""Random points on clocks of their own: what is asked to move moves, after the rest."""

import numpy as np
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import RandomWaypoints
from tests.robots import named_robot


@pytest.mark.parametrize("name", ["ur5", "solo12", "icub"])
def test_named_joints_alone_move_and_only_after_the_rest(name: str) -> None:
    robot = named_robot(name)
    scalar = [joint for joint in robot.joints if joint.kind == "hinge"]
    chosen = [joint.name for joint in scalar[::2]]
    motion = RandomWaypoints(duration=12.0, rest=2.0, joints=chosen).design(
        design_problem(robot, 100.0), np.random.default_rng(0)
    )
    assert len(motion) == 1200
    moves = np.abs(motion.v).max(axis=0) > 0.1
    assert [robot.rows[i] for i in np.flatnonzero(moves)] == chosen
    assert not motion.v[motion.t <= 2.0].any()
    assert np.ptp(motion.q[motion.t <= 2.0], axis=0).max() == 0.0


def test_all_joints_move_where_none_is_named() -> None:
    robot = named_robot("solo12")
    motion = RandomWaypoints().design(design_problem(robot, 50.0), np.random.default_rng(1))
    assert (np.abs(motion.v).max(axis=0) > 0).all()
    assert (np.abs(motion.q - robot.mj.qpos0).max(axis=0) > 0).all()


def test_settings_that_make_no_motion_are_refused() -> None:
    robot = named_robot("ur5")
    with pytest.raises(UsageError, match=r"'shoulder_pan_join'.*'shoulder_pan_joint'"):
        RandomWaypoints(joints=["shoulder_pan_join"]).design(
            design_problem(robot, 50.0), np.random.default_rng(0)
        )
    for wrong in ({"duration": 1.0, "rest": 2.0}, {"move": 0.0}, {"joints": "elbow"}):
        with pytest.raises(UsageError):
            RandomWaypoints(**wrong)
