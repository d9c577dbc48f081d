"""The kernel's motion of every link is MuJoCo's own: rates, accelerations, axes of each dof."""

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors import kernel_numpy as kernel
from sysid_bench.regressors.kernel_numpy import LinkMotion, blocks, link_motions, newton_euler
from sysid_bench.simulation.plant import contact_free
from sysid_bench.types import Trajectory
from tests.robots import named_robot, random_robot, relative_gap, robot_of, states

# Found by trying seeds until free, ball, slide and hinge occur in one tree: see the first test.
RICH = 3
ROBOTS = {
    "ur5": lambda: named_robot("ur5"),
    "solo12": lambda: named_robot("solo12"),
    "random": lambda: random_robot(RICH, 14),
}


@pytest.fixture(scope="module", params=ROBOTS)
def robot(request: pytest.FixtureRequest) -> RobotModel:
    made: RobotModel = ROBOTS[request.param]()
    return made


def test_the_random_tree_has_every_kind_of_joint() -> None:
    robot = random_robot(RICH, 14)
    assert {joint.kind for joint in robot.joints} == {"free", "ball", "slide", "hinge"}
    assert max(len(link.joints) for link in robot.tree.links) > 1
    assert len(robot.tree.links) < len(robot.body_names)
    assert sum(link.parent < 0 for link in robot.tree.links) > 1


def _engine_states(
    robot: RobotModel, motion: Trajectory
) -> Iterator[tuple[int, mujoco.MjModel, mujoco.MjData]]:
    mj = contact_free(robot.spec.copy().compile())
    data = mujoco.MjData(mj)
    for k in range(len(motion)):
        data.qpos[:], data.qvel[:], data.qacc[:] = motion.q[k], motion.v[k], motion.a[k]
        mujoco.mj_inverse(mj, data)
        mujoco.mj_rnePostConstraint(mj, data)
        yield k, mj, data


def _swept(robot: RobotModel, motion: Trajectory) -> list[LinkMotion]:
    return link_motions(robot.tree, motion.q.T, motion.v.T, motion.a.T)


def test_rates_and_accelerations_are_mujocos(robot: RobotModel) -> None:
    motion = states(robot, 5)
    swept = _swept(robot, motion)
    kind = mujoco.mjtObj.mjOBJ_XBODY
    for k, mj, data in _engine_states(robot, motion):
        for link, state in zip(robot.tree.links, swept, strict=True):
            twist, acceleration = np.zeros(6), np.zeros(6)
            mujoco.mj_objectVelocity(mj, data, kind, link.body + 1, twist, 1)
            mujoco.mj_objectAcceleration(mj, data, kind, link.body + 1, acceleration, 1)
            np.testing.assert_allclose(state.w[:, k], twist[:3], atol=1e-11)
            np.testing.assert_allclose(state.alpha[:, k], acceleration[:3], atol=1e-10)
            np.testing.assert_allclose(state.d[:, k], acceleration[3:], atol=1e-10)


def test_the_motion_of_each_dof_is_mujocos_jacobian(robot: RobotModel) -> None:
    motion = states(robot, 5, seed=1)
    swept = _swept(robot, motion)
    for k, mj, data in _engine_states(robot, motion):
        for link, state in zip(robot.tree.links, swept, strict=True):
            linear, angular = np.zeros((2, 3, mj.nv))
            mujoco.mj_jacBody(mj, data, linear, angular, link.body + 1)
            R_wb = data.xmat[link.body + 1].reshape(3, 3)
            ours = np.zeros((6, mj.nv))
            ours[:, link.dofs] = state.ZU[:, :, k].T
            np.testing.assert_allclose(ours[:3], R_wb.T @ angular, atol=1e-12)
            np.testing.assert_allclose(ours[3:], R_wb.T @ linear, atol=1e-11)


def test_the_dofs_of_a_link_give_its_velocity(robot: RobotModel) -> None:
    """w is the sum of all axes times their rates: Jacobian and recursion say the same."""
    motion = states(robot, 5, seed=2)
    for link, state in zip(robot.tree.links, _swept(robot, motion), strict=True):
        w = np.einsum("kin,nk->in", state.ZU[:, :3], motion.v[:, link.dofs])
        np.testing.assert_allclose(state.w, w, atol=1e-12)


@pytest.mark.parametrize("tilt", [0.0, 1e-300, 1e-16, 4e-8, 1e-6, 0.1])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("along", range(3))
def test_an_axis_nearly_along_a_coordinate_is_no_special_case(
    along: int, sign: int, tilt: float
) -> None:
    """(0, -1, 4e-8) has the length 1 in floating point, and is not the y axis for all that."""
    axis = np.full(3, tilt)
    axis[along] = sign
    words = " ".join(map(repr, axis.tolist()))
    robot = robot_of(
        f"""<mujoco><worldbody><body><joint axis="1 2 3"/>
        <inertial pos=".1 .2 .3" mass="1" diaginertia="1 1 1"/>
        <body pos=".3 .2 .1"><joint axis="{words}"/><joint type="slide" axis="{words}"/>
        <inertial pos=".1 .2 .3" mass="1" diaginertia="1 1.2 1.4"/>
        </body></body></worldbody></mujoco>"""
    )
    motion = states(robot, 3)
    swept = _swept(robot, motion)[-1]
    for k, _, data in _engine_states(robot, motion):
        angular = np.zeros((3, robot.nv))
        mujoco.mj_jacBody(robot.mj, data, None, angular, 2)
        ours = data.xmat[2].reshape(3, 3) @ swept.ZU[:, :3, k].T
        np.testing.assert_allclose(ours, angular, atol=1e-14)


def test_newton_euler_does_not_depend_on_block_sizes(
    kernel_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = named_robot("ur5")
    motion = states(robot, 100)
    phi = robot.tree.link_parameters(robot.phi)
    whole = newton_euler(robot.tree, phi, motion)
    for size in (1, 7, 99):
        monkeypatch.setattr(kernel.blocks, "__defaults__", (size,))
        assert relative_gap(newton_euler(robot.tree, phi, motion), whole) < 1e-14


@pytest.mark.parametrize("count", [0, 1, 1023, 1024, 1025, 5000])
@pytest.mark.parametrize("size", [1, 7, 1024])
def test_blocks_cover_every_sample_once(count: int, size: int) -> None:
    numbers = np.arange(count, dtype=float)
    empty = np.zeros((count, 0))
    parts = [numbers[part] for part in blocks(Trajectory(numbers, empty, empty, empty), size)]
    assert all(0 < len(part) <= size for part in parts)
    np.testing.assert_array_equal(np.concatenate([*parts, np.zeros(0)]), numbers)


def test_a_sweep_leaves_its_inputs_alone() -> None:
    robot = random_robot(RICH, 14)
    motion = states(robot, 5)
    copies = [x.copy() for x in (motion.q, motion.v, motion.a)]
    first = _swept(robot, motion)
    for x, copy in zip((motion.q, motion.v, motion.a), copies, strict=True):
        np.testing.assert_array_equal(x, copy)
    for one, again in zip(first, _swept(robot, motion), strict=True):
        np.testing.assert_array_equal(one.ZU, again.ZU)
        np.testing.assert_array_equal(one.d, again.d)
