"""What a Regression offers is one and the same Y: rows, blocks, subsets, terms, riders, torque."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sysid_bench.errors import UsageError
from sysid_bench.models.manifest import TERMS
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.regression import Regression, regression
from sysid_bench.spatial import inertia_transform
from sysid_bench.types import Array, Trajectory
from tests.closeness import assert_close
from tests.robots import named_robot, random_robot, robot_of, states

SEEDS = st.integers(0, 2**32 - 1)
TREES = tuple(range(6))


@pytest.fixture(autouse=True)
def _(kernel_name: str) -> None:
    """Every kernel."""


def all_columns(robot: RobotModel) -> tuple[str, ...]:
    return robot.inertial_columns + robot.term_columns(TERMS)


def dense(robot: RobotModel, columns: tuple[str, ...], motion: Trajectory) -> Array:
    return regression(robot, columns).dense(motion).Y


@pytest.fixture(scope="module", params=TREES)
def robot(request: pytest.FixtureRequest) -> RobotModel:
    return random_robot(request.param)


def test_rows_and_columns_carry_their_names(robot: RobotModel) -> None:
    columns = all_columns(robot)
    Y = regression(robot, columns).dense(states(robot, 3))
    assert Y.rows == robot.rows
    assert Y.columns == columns
    assert Y.Y.shape == (3, robot.nv, len(columns))
    assert len(set(columns)) == len(columns)


def test_rows_are_the_rows_of_the_dense_matrix(robot: RobotModel) -> None:
    motion = states(robot, 7)
    ours = regression(robot, all_columns(robot))
    (block,) = ours.blocks(motion)
    Y = block.dense()
    for i, places in enumerate(ours.row_columns):
        assert len(set(places.tolist())) == len(places)
        np.testing.assert_array_equal(block.row(i), Y[:, i, places].T)
        out = np.full((len(places), 7), np.nan)
        assert block.row(i, out) is out
        np.testing.assert_array_equal(out, Y[:, i, places].T)
        assert not np.delete(Y[:, i], places, axis=1).any()


def test_torque_is_y_theta(robot: RobotModel) -> None:
    motion = states(robot, 7)
    ours = regression(robot, all_columns(robot))
    theta = np.random.default_rng(0).normal(size=len(ours.columns))
    tau = ours.dense(motion).Y @ theta
    np.testing.assert_allclose(ours.torque(motion, theta), tau, rtol=1e-10, atol=1e-10)


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=SEEDS)
def test_chosen_columns_in_any_order_are_the_same_columns(seed: int) -> None:
    robot = random_robot(1)
    motion = states(robot, 4)
    columns = np.array(all_columns(robot))
    rng = np.random.default_rng(seed)
    chosen = rng.permutation(len(columns))[: rng.integers(1, len(columns) + 1)]
    every = dense(robot, tuple(columns), motion)
    some = dense(robot, tuple(columns[chosen].tolist()), motion)
    np.testing.assert_allclose(some, every[:, :, chosen], rtol=1e-12, atol=1e-12)


def test_term_columns_say_what_joints_do(robot: RobotModel) -> None:
    """v, sign v, 1, a, and q less the spring's reference, in the joint's own row alone."""
    motion = states(robot, 5)
    dofs = robot.scalar_dofs
    places = np.array([joint.qadr for joint in robot.joints if joint.kind in ("hinge", "slide")])
    reference = robot.joint_terms.spring_reference[dofs]
    wanted = {
        "viscous": motion.v[:, dofs],
        "coulomb": np.sign(motion.v[:, dofs]),
        "offset": np.ones((5, len(dofs))),
        "armature": motion.a[:, dofs],
        "spring": motion.q[:, places] - reference,
    }
    for term, values in wanted.items():
        Y = dense(robot, robot.term_columns((term,)), motion)
        expected = np.zeros_like(Y)
        expected[:, dofs, np.arange(len(dofs))] = values
        np.testing.assert_array_equal(Y, expected)


def test_terms_and_bodies_do_not_touch_each_other(robot: RobotModel) -> None:
    motion = states(robot, 3)
    columns = all_columns(robot)
    Y = dense(robot, columns, motion)
    ten_nb = len(robot.inertial_columns)
    np.testing.assert_array_equal(Y[..., :ten_nb], dense(robot, columns[:ten_nb], motion))
    np.testing.assert_array_equal(Y[..., ten_nb:], dense(robot, columns[ten_nb:], motion))


def test_riders_are_their_carriers_seen_from_elsewhere(robot: RobotModel) -> None:
    """The ten columns of a welded body are its carrier's times the transport of its pose."""
    motion = states(robot, 3)
    blocks = dense(robot, robot.inertial_columns, motion).reshape(3, robot.nv, -1, 10)
    for b, link in enumerate(robot.tree.carrier):
        if link < 0:
            assert not blocks[:, :, b].any()
            continue
        carrier = robot.tree.links[link].body
        R, p = _pose_in(robot, carrier, b)
        expected = blocks[:, :, carrier] @ inertia_transform(R, p)
        np.testing.assert_allclose(blocks[:, :, b], expected, atol=1e-11)


def _pose_in(robot: RobotModel, a: int, b: int) -> tuple[Array, Array]:
    """Pose of body b in body a by MuJoCo's own kinematics."""
    import mujoco

    data = mujoco.MjData(robot.mj)
    mujoco.mj_kinematics(robot.mj, data)
    R_wa, R_wb = (data.xmat[i + 1].reshape(3, 3) for i in (a, b))
    return R_wa.T @ R_wb, R_wa.T @ (data.xpos[b + 1] - data.xpos[a + 1])


def test_the_trees_have_riders_on_links_and_on_the_world() -> None:
    robots = [random_robot(seed) for seed in TREES]
    owners = [
        {link.body for link in robot.tree.links} for robot in robots
    ]  # bodies that have joints of their own
    assert any((robot.tree.carrier < 0).any() for robot in robots)
    assert any(
        link >= 0 and b not in own
        for robot, own in zip(robots, owners, strict=True)
        for b, link in enumerate(robot.tree.carrier)
    )


def one_body(joint: str) -> RobotModel:
    return robot_of(
        f"""<mujoco><option gravity="1 2 -9"/><worldbody><body name="b">{joint}
        <inertial pos=".1 .2 .3" mass="2" diaginertia="1 1.2 1.4"/></body></worldbody></mujoco>"""
    )


def test_a_slide_feels_mass_alone() -> None:
    robot = one_body('<joint name="j" type="slide" axis="0 0 1"/>')
    motion = states(robot, 4)
    Y = dense(robot, robot.inertial_columns, motion)[:, 0]
    assert_close(Y[:, 0], motion.a[:, 0] + 9.0, 1e-14)
    assert not Y[:, 1:].any()


def test_a_pendulum_is_that_of_the_textbooks() -> None:
    """tau = Izz a + g (hx cos q - hy sin q) about a horizontal axis."""
    robot = robot_of(
        """<mujoco><option gravity="0 -9.81 0"/><worldbody><body name="b">
        <joint name="j" axis="0 0 1"/><inertial pos=".1 .2 .3" mass="2" diaginertia="1 1.2 1.4"/>
        </body></worldbody></mujoco>"""
    )
    motion = states(robot, 4)
    q, a = motion.q[:, 0], motion.a[:, 0]
    Y = dense(robot, ("b.Izz", "b.hx", "b.hy"), motion)[:, 0]
    expected = np.column_stack([a, 9.81 * np.cos(q), -9.81 * np.sin(q)])
    np.testing.assert_allclose(Y, expected, atol=1e-14)
    other = [f"b.{name}" for name in ("m", "hz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz")]
    assert not dense(robot, tuple(other), motion).any()


def test_a_ball_obeys_eulers_equations() -> None:
    robot = one_body('<joint name="j" type="ball"/>')
    motion = states(robot, 4)
    Y = dense(robot, ("b.Ixx", "b.Iyy", "b.Izz"), motion)
    for moments in np.eye(3):
        L = motion.v * moments
        expected = motion.a * moments + np.cross(motion.v, L)
        np.testing.assert_allclose(Y @ moments, expected, atol=1e-14)


def test_a_free_point_mass_obeys_newton_in_the_world() -> None:
    robot = one_body("<freejoint/>")
    motion = states(robot, 4)
    column = dense(robot, ("b.m",), motion)[..., 0]
    np.testing.assert_allclose(column[:, :3], motion.a[:, :3] - [1, 2, -9], atol=1e-13)
    np.testing.assert_allclose(column[:, 3:], 0, atol=1e-13)


@pytest.mark.parametrize("name", ["upper_arm_link.M", "elbow_joint.fw", "Izz", "", "tool0"])
def test_an_unknown_column_is_refused_by_name(name: str) -> None:
    with pytest.raises(UsageError) as refusal:
        regression(named_robot("ur5"), ("upper_arm_link.m", name))
    assert repr(name) in str(refusal.value)


def test_a_ball_has_no_joint_terms() -> None:
    robot = one_body('<joint name="j" type="ball" damping="1"/>')
    assert robot.term_columns(TERMS) == ()
    with pytest.raises(UsageError):
        regression(robot, ("j.fv",))


def test_a_regression_on_terms_alone_works() -> None:
    robot = named_robot("ur5")
    ours: Regression = regression(robot, robot.term_columns(("viscous",)))
    motion = states(robot, 3)
    np.testing.assert_array_equal(ours.torque(motion, np.ones(6)), motion.v)
