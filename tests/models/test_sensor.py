"""Sensor cuts: any fixed joint, site or body, and the sub-tree behind it."""

from dataclasses import replace

import pytest

from sysid_bench.errors import UnsupportedError, UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest, Sensor
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.models.random_robot import random_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import default_sensor, floating_subtree, instruments_of, subtree_at
from tests.robots import named_robot, robot_of, states

ARM = """<mujoco><worldbody><body name="foot"><body name="upper"><joint name="a" axis="0 1 0"/>
  <inertial pos=".1 0 0" mass="1" diaginertia=".1 .1 .1"/>
  <body name="plate" pos=".2 0 0"><inertial pos=".1 0 0" mass=".5" diaginertia=".1 .1 .1"/>
    <site name="tip" pos=".01 .02 .03" quat="1 1 0 0"/>
    <body name="lower"><joint name="b" axis="0 0 1"/>
      <inertial pos=".1 0 0" mass=".3" diaginertia=".1 .1 .1"/>
</body></body></body></body></worldbody></mujoco>"""


def test_a_fixed_joint_keeps_the_links_on_its_sides_apart() -> None:
    robot = named_robot("icub")
    cut = subtree_at(robot, "l_arm_ft_sensor")
    names = [robot.body_names[b] for b in cut.bodies]
    assert names[0] == "l_upper_arm"
    assert "l_shoulder_3" not in names
    masses = [robot.phi[b, 0] for b in cut.bodies]
    assert masses[0] == pytest.approx(0.727843, abs=1e-6)
    assert sum(masses) == pytest.approx(1.640, abs=2e-3)
    assert robot.phi[robot.body_names.index("l_shoulder_3"), 0] == pytest.approx(0.156, abs=1e-3)


def test_sites_bodies_and_manifest_names_cut_too() -> None:
    robot = robot_of(ARM)
    site, body = subtree_at(robot, "tip"), subtree_at(robot, "plate")
    assert (
        [robot.body_names[b] for b in site.bodies]
        == ["plate", "lower"]
        == [robot.body_names[b] for b in body.bodies]
    )
    assert site.p.tolist() == [0.01, 0.02, 0.03]
    assert site.rows[0] == "tip.nx"
    assert site.rows[3] == "tip.fx"
    named = _with_sensors(robot_of(ARM), Sensor(name="wrist", at="tip"))
    assert subtree_at(named, "wrist").rows[0] == "wrist.nx"
    assert default_sensor(named, None) == "wrist"


def _with_sensors(robot: RobotModel, *sensors: Sensor) -> RobotModel:

    return replace(robot, manifest=Manifest("arm", robot.manifest.path, sensors=sensors))


def test_the_next_sensor_ends_the_sub_tree() -> None:
    robot = _with_sensors(
        robot_of(ARM), Sensor(name="root", at="upper"), Sensor(name="wrist", at="lower")
    )
    cut = subtree_at(robot, "root")
    assert [robot.body_names[b] for b in cut.bodies] == ["upper", "plate"]
    assert cut.end_sensors == ("wrist",)
    assert len(subtree_at(robot, "root", others=()).bodies) == 3
    leg = subtree_at(named_robot("icub"), "l_leg_ft_sensor", ("l_foot_ft_sensor",))
    assert leg.end_sensors == ("l_foot_ft_sensor",)


def test_a_mounted_payload_is_behind_the_wrist() -> None:
    robot = load_robot("icub", PAYLOADS["box-2kg"])
    assert robot.payload_body in subtree_at(robot, "l_arm_ft_sensor").bodies
    assert robot.payload_body not in subtree_at(robot, "r_arm_ft_sensor").bodies


@pytest.mark.parametrize("wrong", ["l_arm_ft_senso", "no such thing"])
def test_an_unknown_place_names_what_there_is(wrong: str) -> None:
    with pytest.raises(UsageError, match="l_arm_ft_sensor"):
        subtree_at(named_robot("icub"), wrong)


def test_a_joint_that_moves_is_no_sensor() -> None:
    with pytest.raises(UnsupportedError, match="a moving joint"):
        subtree_at(named_robot("icub"), "l_elbow")
    with pytest.raises(UnsupportedError, match="a moving joint"):
        subtree_at(robot_of(ARM), "b")


def test_no_sensor_or_several_ask_which() -> None:
    with pytest.raises(UnsupportedError, match="has no force/torque sensor"):
        default_sensor(robot_of(ARM), None)
    two = _with_sensors(robot_of(ARM), Sensor(name="s", at="tip"), Sensor(name="t", at="lower"))
    with pytest.raises(UnsupportedError, match="sensors s, t"):
        default_sensor(two, None)
    with pytest.raises(UnsupportedError, match="use one at a time"):
        default_sensor(two, "s, t")
    with pytest.raises(UnsupportedError, match="measure the same"):
        instruments_of(two, (subtree_at(two, "tip"), subtree_at(two, "plate")))


@pytest.mark.parametrize("seed", range(6))
def test_sensors_leave_the_robot_its_own_places(seed: int) -> None:
    """Any body of any tree can be cut, and the sub-tree flies on its own with six places more."""
    robot = robot_of(random_robot(seed))
    motion = states(robot, 3)
    for name in robot.body_names:
        cut = subtree_at(robot, name)
        made = instruments_of(robot, (cut,))
        assert made.rows[: robot.nv] == robot.rows
        assert made.motion(motion).v.shape == (3, robot.nv + 6)
        alone = floating_subtree(robot, cut)
        assert len(alone.rows) == robot.nv + 6
        riders = [b for b, link in enumerate(alone.tree.carrier) if link >= 0]
        assert tuple(riders) == cut.bodies
