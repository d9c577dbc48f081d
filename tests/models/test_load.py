"""Loading of a file: names, floating bases, true parameters as in MuJoCo's own model."""

import mujoco
import numpy as np
import pytest

from sysid_bench.errors import ModelError
from sysid_bench.evaluation.crosscheck import crosscheck
from sysid_bench.models.load import load_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.plant import contact_free
from sysid_bench.spatial import feasible_margins, inertia_matrix
from tests.robots import NAMED, named_robot, random_robot, robot_of, states

EVERY = [*NAMED, *range(8)]
INERTIAL = '<inertial pos=".1 .2 .3" mass="1" diaginertia="1 1 1"/>'


@pytest.fixture(scope="module", params=EVERY)
def robot(request: pytest.FixtureRequest) -> RobotModel:
    name = request.param
    return random_robot(name) if isinstance(name, int) else named_robot(name)


def test_every_name_is_there_and_there_once(robot: RobotModel) -> None:
    for names in (robot.body_names, robot.rows, robot.inertial_columns):
        assert all(names)
        assert len(set(names)) == len(names)
    assert len(robot.rows) == robot.nv == robot.mj.nv
    assert len(robot.body_names) == len(robot.phi) == robot.mj.nbody - 1


def test_every_body_can_exist(robot: RobotModel) -> None:
    assert (feasible_margins(robot.phi) >= -1e-9 * np.abs(robot.phi).max(axis=1)).all()


def test_kinetic_energy_is_that_of_the_ten_numbers(robot: RobotModel) -> None:
    """v' M v / 2 from MuJoCo equals the sum over bodies of m v²/2 + w'(h × v) + w' I w / 2."""

    mj = contact_free(robot.spec.copy().compile())
    data = mujoco.MjData(mj)
    motion = states(robot, 1)
    data.qpos[:], data.qvel[:] = motion.q[0], motion.v[0]
    mujoco.mj_forward(mj, data)
    mujoco.mj_energyVel(mj, data)
    energy = 0.5 * (mj.dof_armature * motion.v[0] ** 2).sum()
    for b, phi in enumerate(robot.phi, start=1):
        twist = np.zeros(6)
        mujoco.mj_objectVelocity(mj, data, mujoco.mjtObj.mjOBJ_XBODY, b, twist, 1)
        w, v = twist[:3], twist[3:]
        energy += 0.5 * phi[0] * v @ v + w @ np.cross(phi[1:4], v)
        energy += 0.5 * w @ inertia_matrix(phi[4:]) @ w
    assert data.energy[1] == pytest.approx(energy, rel=1e-10)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("offset", [0.0, 1e-10, 1e-8, 3e-7, 2e-6, 1e-3])
def test_an_inertial_frame_near_that_of_the_body_is_the_one_that_mujoco_moves(
    offset: float, turned: bool
) -> None:
    """MuJoCo drops offsets below 1e-6; on heavy bodies they are above the tolerance of closures."""
    pose = f'pos=".1 .2 0" quat="1 0 {offset} 0"' if turned else f'pos="{offset} 0 {offset}"'
    inertial = f'<inertial {pose} mass="200" diaginertia="9 8 7"/>'
    check = crosscheck(robot_of(
        f"<mujoco><worldbody><body><freejoint/>{inertial}</body><body><joint axis='0 1 0'/>"
        f"{inertial}</body></worldbody></mujoco>"
    ), 4)  # fmt: skip
    assert check.ok(), check.reason()


def test_joint_terms_are_mujocos_own_forces(robot: RobotModel) -> None:
    """Springs and dampers of hinges and slides are -qfrc_passive."""
    mj = contact_free(robot.spec.copy().compile())
    data = mujoco.MjData(mj)
    motion = states(robot, 1)
    data.qpos[:], data.qvel[:] = motion.q[0], motion.v[0]
    mujoco.mj_forward(mj, data)
    terms = robot.joint_terms
    for joint in robot.joints:
        if joint.kind in ("hinge", "slide"):
            i = joint.vadr
            deflection = motion.q[0, joint.qadr] - terms.spring_reference[i]
            force = terms.viscous[i] * motion.v[0, i] + terms.spring[i] * deflection
            assert -data.qfrc_passive[i] == pytest.approx(force, abs=1e-12)


def test_unnamed_parts_are_named_by_their_place_and_taken_names_are_left() -> None:
    robot = robot_of(
        f"""<mujoco><worldbody><body><freejoint/>{INERTIAL}
        <body name="body4"><joint/>{INERTIAL}<body><joint name="joint2"/>{INERTIAL}
        <body><joint type="ball"/>{INERTIAL}</body></body></body></body></worldbody></mujoco>"""
    )
    assert robot.body_names == ("body1", "body4", "body3", "body4_")
    assert robot.rows[:6] == tuple(f"root.{d}" for d in ("vx", "vy", "vz", "wx", "wy", "wz"))
    assert robot.rows[6:8] == ("joint2_", "joint2")
    assert robot.rows[8:] == ("joint4.x", "joint4.y", "joint4.z")


def test_two_free_bodies_have_names_of_their_own() -> None:
    body = f"<body><freejoint/>{INERTIAL}</body>"
    robot = robot_of(f"<mujoco><worldbody>{body}{body}</worldbody></mujoco>")
    assert len(set(robot.rows)) == 12


@pytest.mark.parametrize(
    ("bodies", "words"),
    [
        (f"<body><joint/>{INERTIAL}</body>", "already has joints"),
        (f"<body><joint/>{INERTIAL}</body><body>{INERTIAL}</body>", "there are 2"),
    ],
)
def test_a_base_that_cannot_float_says_why(bodies: str, words: str) -> None:
    with pytest.raises(ModelError, match=words):
        robot_of(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>", free_base=True)


def test_a_base_that_floats_already_is_left() -> None:
    text = f"<mujoco><worldbody><body><freejoint/>{INERTIAL}</body></worldbody></mujoco>"
    assert robot_of(text, free_base=True).rows == robot_of(text).rows


def test_the_caller_decides_whether_the_base_floats() -> None:
    assert load_robot("solo12").nv == 18
    assert load_robot("solo12", free_base=False).nv == 12
    assert load_robot("ur5", free_base=True).nv == 12


@pytest.mark.parametrize(
    "attribute",
    ['pos="0 nan 0"', 'pos="1e300 0 0"', 'pos="inf 0 0"', 'quat="1e300 1 0 0"', 'quat="nan 0 0 1"'],
)
@pytest.mark.parametrize("element", ["body", "inertial"])
def test_numbers_that_are_none_are_refused_in_mjcf(element: str, attribute: str) -> None:
    good = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    if element == "inertial":
        kept = 'pos="0 0 0" ' if attribute.startswith("quat") else ""
        good = f'<inertial {kept}{attribute} mass="1" diaginertia="1 1 1"/>'
    body = f"<body {attribute if element == 'body' else ''}><joint/>{good}</body>"
    with pytest.raises(ModelError, match=r"robot\.xml"):
        robot_of(f"<mujoco><worldbody>{body}</worldbody></mujoco>")


def test_a_nan_that_mujoco_takes_for_a_default_is_reported() -> None:
    robot = robot_of(
        """<mujoco><worldbody><body><joint/><inertial pos="nan 0 0" mass="1" diaginertia="1 1 1"/>
        </body></worldbody></mujoco>"""
    )
    assert np.isfinite(robot.phi).all()
    assert any("NaN" in words for words in robot.repairs)


def test_a_mass_matrix_that_is_singular_at_the_reference_is_reported_and_no_error() -> None:
    """z-x-z hinges on one body: sound, but two axes fall together at zero."""
    hinges = "".join(f'<joint axis="{axis}"/>' for axis in ("0 0 1", "1 0 0", "0 0 1"))
    robot = robot_of(f"<mujoco><worldbody><body>{hinges}{INERTIAL}</body></worldbody></mujoco>")
    assert robot.nv == 3
    assert any("singular" in words for words in robot.repairs)


def test_what_plays_no_role_is_dropped_and_what_was_mesh_is_reported() -> None:
    text = f"""<mujoco><asset><mesh name="m" file="absent.stl"/><material name="red"/></asset>
    <default><geom material="red"/></default>
    <worldbody><body name="a"><joint name="j"/>{INERTIAL}<geom type="mesh" mesh="m"/>
    <body name="b"><geom type="mesh" mesh="m"/></body></body></worldbody>
    <actuator><motor joint="j"/></actuator><keyframe><key qpos="1"/></keyframe></mujoco>"""
    robot = robot_of(text)
    assert robot.nv == 1
    assert robot.phi[1].tolist() == [0.0] * 10
    (words,) = robot.repairs
    assert words.startswith("b: inertia came from meshes")
