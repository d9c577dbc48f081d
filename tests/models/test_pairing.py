"""One robot, two engines: configurations, rates and forces go over without loss."""

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from sysid_bench.models.robot import RobotModel
from sysid_bench.models.tree import BALL, FREE
from sysid_bench.simulation.plant import contact_free
from sysid_bench.types import Array
from tests.robots import named_robot, random_robot, relative_gap, states

SEEDS = tuple(range(20))


@pytest.fixture(scope="module", params=[*SEEDS, "solo12", "panda"])
def robot(request: pytest.FixtureRequest) -> RobotModel:
    return random_robot(request.param) if request.param in SEEDS else named_robot(request.param)


def test_the_trees_have_free_and_ball_joints() -> None:
    kinds = [{joint.kind for joint in random_robot(seed).joints} for seed in SEEDS]
    assert sum("free" in kind for kind in kinds) >= 3
    assert sum("ball" in kind for kind in kinds) >= 3


def test_sizes_agree(robot: RobotModel) -> None:
    model = robot.pairing.model
    assert (model.nq, model.nv, model.njoints - 1) == (robot.mj.nq, robot.nv, robot.mj.njnt)
    assert len(robot.pairing.carrier) == len(robot.body_names)
    moving = robot.phi[robot.tree.carrier >= 0, 0].sum()
    lumped = sum(inertia.mass for inertia in list(model.inertias)[1:])
    assert lumped == pytest.approx(moving)


def test_bodies_are_where_mujoco_puts_them(robot: RobotModel) -> None:
    """World-welded bodies hang on the universe, the others on their joint."""
    motion = states(robot, 3)
    model = robot.pairing.model
    data, mjdata = model.createData(), mujoco.MjData(robot.mj)
    for k, q in enumerate(robot.pairing.positions_to_pinocchio(motion.q)):
        pin.forwardKinematics(model, data, q)
        mjdata.qpos[:] = motion.q[k]
        mujoco.mj_kinematics(robot.mj, mjdata)
        for b, joint in enumerate(robot.pairing.carrier):
            placed = data.oMi[int(joint)]
            # The first moment of a unit mass at the body's origin is that origin, in the joint.
            X = robot.pairing.X[b]
            origin = placed.act((X @ np.eye(10)[0])[1:4])
            np.testing.assert_allclose(origin, mjdata.xpos[b + 1], atol=1e-12)


def test_the_velocity_map_is_that_of_the_configuration(robot: RobotModel) -> None:
    """Moving for a moment in MuJoCo is moving for a moment in Pinocchio."""
    motion = states(robot, 3)
    h = 1e-6
    ours = robot.pairing
    v, _ = ours.rates(motion.q, motion.v, motion.a)
    for k in range(3):
        q0 = ours.positions_to_pinocchio(motion.q[k])
        stepped = motion.q[k].copy()
        mujoco.mj_integratePos(robot.mj, stepped, motion.v[k], h)
        velocity = pin.difference(ours.model, q0, ours.positions_to_pinocchio(stepped)) / h
        np.testing.assert_allclose(velocity, v[k], atol=1e-4)


def test_mass_matrices_and_bias_forces_agree(robot: RobotModel) -> None:
    motion = states(robot, 3)
    ours, zero = robot.pairing, np.zeros_like(motion.v)
    mj = contact_free(robot.spec.copy().compile())
    data, mjdata = ours.model.createData(), mujoco.MjData(mj)
    q = ours.positions_to_pinocchio(motion.q)
    v, a0 = ours.rates(motion.q, motion.v, zero)
    for k in range(3):
        mjdata.qpos[:], mjdata.qvel[:] = motion.q[k], motion.v[k]
        mujoco.mj_forward(mj, mjdata)
        one = slice(k, k + 1)
        bias = pin.rnea(ours.model, data, q[k], v[k], a0[k])[None]
        assert relative_gap(ours.rows_to_mujoco(motion.q[one], bias)[0], mjdata.qfrc_bias) < 1e-12
        M = np.zeros((robot.nv, robot.nv))
        mujoco.mj_fullM(mj, mjdata, M)
        T, _ = ours.rates(np.repeat(motion.q[one], robot.nv, axis=0), np.eye(robot.nv), M)
        M_pin = _symmetric(pin.crba(ours.model, data, q[k]))
        # The rows of T are Pinocchio's velocities of MuJoCo's unit rates.
        assert relative_gap(T @ M_pin @ T.T + np.diag(mj.dof_armature), M) < 1e-12


def _symmetric(upper: Array) -> Array:
    return np.asarray(np.triu(upper) + np.triu(upper, 1).T)


def test_power_is_the_same_in_both_coordinates(robot: RobotModel) -> None:
    """tau . v does not depend on who counts it: force and velocity maps are each other's dual."""
    motion = states(robot, 5)
    tau_pin = np.random.default_rng(0).normal(size=motion.v.shape)
    v, _ = robot.pairing.rates(motion.q, motion.v, motion.a)
    tau = robot.pairing.rows_to_mujoco(motion.q, tau_pin)
    np.testing.assert_allclose((tau * motion.v).sum(1), (tau_pin * v).sum(1), atol=1e-12)


def test_rows_of_matrices_turn_like_rows_of_vectors(robot: RobotModel) -> None:
    motion = states(robot, 5)
    rows = np.random.default_rng(0).normal(size=(5, robot.nv, 3))
    turned = robot.pairing.rows_to_mujoco(motion.q, rows)
    for c in range(3):
        one = robot.pairing.rows_to_mujoco(motion.q, rows[..., c])
        np.testing.assert_allclose(turned[..., c], one, atol=1e-15)


def test_the_maps_leave_their_inputs_alone(robot: RobotModel) -> None:
    motion = states(robot, 2)
    rows = np.ones((2, robot.nv))
    before = [x.copy() for x in (motion.q, motion.v, motion.a, rows)]
    robot.pairing.positions_to_pinocchio(motion.q)
    robot.pairing.rates(motion.q, motion.v, motion.a)
    robot.pairing.rows_to_mujoco(motion.q, rows)
    for x, copy in zip((motion.q, motion.v, motion.a, rows), before, strict=True):
        np.testing.assert_array_equal(x, copy)


def test_an_unnormalised_quaternion_means_the_same_rotation(robot: RobotModel) -> None:
    motion = states(robot, 2)
    longer = motion.q.copy()
    for kind, at in zip(robot.mj.jnt_type, robot.mj.jnt_qposadr, strict=True):
        start = int(at) + (3 if kind == FREE else 0)
        if kind in (FREE, BALL):
            longer[:, start : start + 4] *= 3.0
    ours = robot.pairing.positions_to_pinocchio
    np.testing.assert_allclose(ours(longer), ours(motion.q), atol=1e-15)
