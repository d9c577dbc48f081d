"""Joint terms are MuJoCo's own passive forces, and others are left out and reported."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array
from tests.robots import named_robot, random_robot, robot_of, states

INERTIAL = '<inertial pos=".1 .02 .03" mass="1" diaginertia=".1 .2 .25"/>'


def arm(joint: str, more: str = "", option: str = "", body: str = "") -> str:
    """A hinge and a slide with the same attributes, and what stands after the worldbody."""
    return f"""<mujoco>{option}<worldbody>
    <body name="a" {body}><joint name="j" {joint}/>{INERTIAL}
    <body name="b" pos="0 0 .3"><joint name="k" type="slide" {joint}/>{INERTIAL}</body></body>
    </worldbody>{more}</mujoco>"""


def passive(robot: RobotModel, mj: mujoco.MjModel) -> tuple[Array, Array]:
    """Passive forces of a compiled model, and those of the truth, (N, nv) at random states."""
    motion, terms = states(robot, 10), robot.joint_terms
    theirs, data = np.empty_like(motion.v), mujoco.MjData(mj)
    for k in range(len(motion)):
        data.qpos[:], data.qvel[:] = motion.q[k], motion.v[k]
        mujoco.mj_forward(mj, data)
        theirs[k] = -data.qfrc_passive
    ours = terms.viscous * motion.v
    for joint in robot.joints:
        if joint.kind in ("hinge", "slide"):
            i = joint.vadr
            ours[:, i] += terms.spring[i] * (motion.q[:, joint.qadr] - terms.spring_reference[i])
    return ours, theirs


@pytest.mark.parametrize("robot", [*range(25), "ur5", "panda", "solo12"], ids=str)
def test_the_truth_is_mujocos_passive_force(robot: int | str) -> None:
    loaded = random_robot(robot) if isinstance(robot, int) else named_robot(robot)
    ours, theirs = passive(loaded, loaded.spec.copy().compile())
    np.testing.assert_allclose(ours, theirs, atol=1e-11 * max(np.abs(theirs).max(), 1e-3))


OFF = '<option><flag {}="disable"/></option>'
SINGLE = {
    "damping": arm('damping="1.5"'),
    "spring": arm('stiffness="3" springref="10" ref="-20"'),
    "radians": arm('stiffness="3" springref=".2" ref="-.3"', option='<compiler angle="radian"/>'),
    "springdamper": arm('springdamper=".1 1"'),
    "no dampers": arm('damping="1" stiffness="2"', option=OFF.format("damper")),
    "no springs": arm('damping="1" stiffness="2"', option=OFF.format("spring")),
    "geared damper": arm(
        'damping="1"', '<actuator><motor joint="j" gear="3" damping=".2" armature=".1"/></actuator>'
    ),
    "two motors": arm(
        "",
        '<actuator><motor joint="j" gear="-2" damping=".2"/>'
        '<position joint="j" kp="5" damping=".1" armature=".3"/></actuator>',
    ),
    "motor of a default": arm(
        "",
        '<actuator><motor joint="k" gear="4"/></actuator>',
        '<default><motor armature=".2" damping=".3"/></default>',
    ),
}  # fmt: skip
"""Models whose every force beside inertia is a joint term."""


@pytest.mark.parametrize("name", SINGLE)
def test_the_whole_model_of_mujoco_has_the_same_terms(name: str) -> None:
    """Against the model as MuJoCo itself compiles the text: actuators and flags in place."""
    robot, whole = robot_of(SINGLE[name]), mujoco.MjModel.from_xml_string(SINGLE[name])
    assert robot.repairs == ()
    whole.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    ours, theirs = passive(robot, whole)
    np.testing.assert_allclose(ours, theirs, atol=1e-12)
    np.testing.assert_allclose(mass_matrix(robot.mj), mass_matrix(whole), atol=1e-12)


def mass_matrix(mj: mujoco.MjModel) -> Array:
    data, M = mujoco.MjData(mj), np.zeros((mj.nv, mj.nv))
    mujoco.mj_forward(mj, data)
    mujoco.mj_fullM(mj, data, M)
    return M


def test_friction_that_is_switched_off_is_none() -> None:
    flag = OFF.format("frictionloss")
    assert robot_of(arm('frictionloss="2"')).joint_terms.coulomb.tolist() == [2, 2]
    assert robot_of(arm('frictionloss="2"', option=flag)).joint_terms.coulomb.tolist() == [0, 0]


TENDON = '<tendon><fixed name="t" {}><joint joint="j" coef="2"/></fixed></tendon>'
LEFT_OUT = {
    "damper of joint 'j'": arm('damping="1 2"'),
    "spring of joint 'k'": arm('stiffness="1 0 3"'),
    "stiffness of tendon 't'": arm("", TENDON.format('stiffness="3"')),
    "damping, frictionloss of tendon": arm("", TENDON.format('damping="3" frictionloss="1"')),
    "armature of tendon": arm("", TENDON.format('armature=".2"')),
    "density": arm("", option='<option density="1000"/>'),
    "gravity compensation of 'a'": arm("", body='gravcomp="1"'),
    "actuator 'm'": arm(
        "", TENDON.format("") + '<actuator><motor name="m" tendon="t" armature="1"/></actuator>'
    ),
    "non-linear damping of actuator 'm'": arm(
        "", '<actuator><motor name="m" joint="j" damping="0 1"/></actuator>'
    ),
    "spring of joint 'ball'": f"""<mujoco><worldbody><body><joint name="ball" type="ball"
        stiffness="2"/>{INERTIAL}</body></worldbody></mujoco>""",
}  # fmt: skip


@pytest.mark.parametrize("words", LEFT_OUT)
def test_what_is_no_joint_term_is_left_out_and_reported(words: str) -> None:
    robot = robot_of(LEFT_OUT[words])
    assert any(re.search(f"{re.escape(words)}.*left out", reported) for reported in robot.repairs)
    ours, theirs = passive(robot, robot.spec.copy().compile())
    np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_a_gear_is_no_part_of_the_model(tmp_path: Path) -> None:
    """Torque is taken at the joint."""
    geared = '<actuator><motor joint="j" gear="100"/><position joint="k" kp="9" kv="3"/></actuator>'
    plain, motored = robot_of(arm('armature=".2"')), robot_of(arm('armature=".2"', geared))
    np.testing.assert_array_equal(plain.joint_terms.armature, motored.joint_terms.armature)
    np.testing.assert_array_equal(plain.joint_terms.viscous, motored.joint_terms.viscous)
