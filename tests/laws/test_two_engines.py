"""Laws of every robot: Y is linear in theta, and two engines agree with it."""

import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_bench import package_folders
from sysid_bench.errors import ModelError, UnsupportedError
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.regressors.pinocchio import pinocchio_regressor
from sysid_bench.regressors.pinocchio_urdf import urdf_regressor
from sysid_bench.regressors.regression import regression
from sysid_bench.simulation.inverse import inverse_torque
from sysid_bench.spatial import body_mass_inertia
from sysid_bench.types import Array, Trajectory
from tests.robots import (
    EMPTY,
    MOTIONLESS,
    NAMED,
    named_robot,
    random_phi,
    random_robot,
    relative_gap,
    revolute_tree,
    states,
    urdf_files,
    urdf_robot,
)

GAP = 1e-12
CLOSURE = 1e-11
FLOATING = [
    "anymal_b_simple_description/robots/anymal.urdf",
    "go2_description/urdf/go2.urdf",
    "icub_description/robots/icub.urdf",
    "romeo_description/urdf/romeo.urdf",
    "kinova_description/robots/kinova.urdf",
    "so_arm_description/urdf/so101.urdf",
]
SEEDS = st.integers(0, 2**32 - 1)


def check(robot: RobotModel, count: int = 5, seed: int = 0) -> None:
    """All laws of one robot at a few states."""
    motion = states(robot, count, seed)
    ours = regression(robot, robot.inertial_columns)
    Y = ours.dense(motion).Y
    theta = robot.phi.ravel()
    tau = Y @ theta
    assert np.abs(Y).max() > 0
    assert relative_gap(Y, pinocchio_regressor(robot, motion).Y) <= GAP
    armature = robot.joint_terms.armature * motion.a
    assert relative_gap(tau + armature, inverse_torque(robot, motion)) <= CLOSURE
    assert (
        relative_gap(newton_euler(robot.tree, robot.tree.link_parameters(robot.phi), motion), tau)
        <= GAP
    )
    assert relative_gap(ours.torque(motion, theta), tau) <= GAP
    paired = rnea(robot.pairing.model, robot, motion)
    assert relative_gap(tau, paired) <= CLOSURE


def rnea(model: pin.Model, robot: RobotModel, motion: Trajectory) -> Array:
    """Pinocchio's own recursion, in MuJoCo's coordinates."""
    data = model.createData()
    q = robot.pairing.positions_to_pinocchio(motion.q)
    v, a = robot.pairing.rates(motion.q, motion.v, motion.a)
    rows = np.array([pin.rnea(model, data, *state).copy() for state in zip(q, v, a, strict=True)])
    return robot.pairing.rows_to_mujoco(motion.q, rows)


def test_the_collection_of_urdfs_is_whole() -> None:
    assert len(urdf_files()) == 66
    for file in package_folders.robot_data_folder().rglob("*.urdf"):
        if str(file).endswith(MOTIONLESS):
            with pytest.raises(ModelError, match="no moving joint"):
                load_robot(file)
        elif str(file).endswith(EMPTY):
            with pytest.raises(ModelError, match="no <link>"):
                load_robot(file)


@pytest.mark.parametrize("file", urdf_files())
def test_every_urdf(file: str) -> None:
    check(urdf_robot(file))


@pytest.mark.parametrize("file", urdf_files())
def test_every_urdf_as_pinocchio_reads_it_itself(file: str) -> None:
    robot = urdf_robot(file)
    motion = states(robot, 3, seed=1)
    Y = regression(robot, robot.inertial_columns).dense(motion).Y
    assert relative_gap(Y, urdf_regressor(robot, motion).Y) <= GAP


@pytest.mark.parametrize("file", FLOATING)
def test_urdfs_that_float(file: str) -> None:
    (path,) = [
        p for p in package_folders.robot_data_folder().rglob(Path(file).name) if file in str(p)
    ]
    robot = load_robot(path, free_base=True)
    assert robot.floating
    check(robot)
    motion = states(robot, 3, seed=1)
    Y = regression(robot, robot.inertial_columns).dense(motion).Y
    assert relative_gap(Y, urdf_regressor(robot, motion).Y) <= GAP


@pytest.mark.parametrize("payload", ["none", "sphere-offset-1kg"])
@pytest.mark.parametrize("name", NAMED)
def test_every_named_robot(name: str, payload: str) -> None:
    check(named_robot(name, payload))


@pytest.mark.parametrize("seed", range(40))
def test_random_trees(seed: int) -> None:
    check(random_robot(seed, bodies=3 + seed % 10))


@settings(max_examples=40)
@given(seed=SEEDS)
def test_any_random_tree(seed: int) -> None:
    check(random_robot(seed), seed=seed)


@pytest.mark.parametrize("seed", range(3))
def test_floating_hinge_trees(seed: int) -> None:
    check(revolute_tree(seed, 6))


@settings(max_examples=25)
@given(seed=SEEDS)
def test_torque_is_linear_in_the_parameters(seed: int) -> None:
    robot = random_robot(seed % 20)
    motion = states(robot, 3, seed)
    ours = regression(robot, robot.inertial_columns)
    rng = np.random.default_rng(seed)
    one, other = rng.normal(size=(2, len(ours.columns)))
    s = rng.normal()
    together = ours.torque(motion, one + s * other)
    parts = ours.torque(motion, one) + s * ours.torque(motion, other)
    np.testing.assert_allclose(together, parts, atol=1e-9 * np.abs(parts).max())
    lumped = [robot.tree.link_parameters(theta.reshape(-1, 10)) for theta in (one, other)]
    ours_too = newton_euler(robot.tree, lumped[0] + s * lumped[1], motion)
    np.testing.assert_allclose(ours_too, parts, atol=1e-9 * np.abs(parts).max())


@settings(max_examples=15)
@given(seed=SEEDS)
def test_other_parameters_are_another_plant(seed: int) -> None:
    """Y does not know theta: with the inertias of MuJoCo's model exchanged, Y is the same."""
    robot = random_robot(seed % 20)
    motion = states(robot, 3, seed)
    phi = random_phi(np.random.default_rng(seed), len(robot.body_names))
    tau = inverse_torque(replace(robot, spec=respecified(robot, phi)), motion)
    predicted = regression(robot, robot.inertial_columns).torque(motion, phi.ravel())
    assert relative_gap(predicted + robot.joint_terms.armature * motion.a, tau) <= CLOSURE


def respecified(robot: RobotModel, phi: Array) -> mujoco.MjSpec:
    """The robot's spec with the inertias phi (nb, 10)."""
    spec = robot.spec.copy()
    for name, numbers in zip(robot.body_names, phi, strict=True):
        body = spec.body(name)
        body.mass, body.ipos, about_com = body_mass_inertia(numbers)
        moments, axes = np.linalg.eigh(about_com)
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, (axes * np.linalg.det(axes)).ravel())
        body.inertia, body.iquat, body.fullinertia = moments, quaternion, np.full(6, np.nan)
    return spec


def test_a_reference_that_cannot_serve_says_so() -> None:
    tree = random_robot(0)
    with pytest.raises(UnsupportedError, match="MJCF"):
        urdf_regressor(tree, states(tree, 2))
    loaded = load_robot("ur5", PAYLOADS["box-2kg"])
    with pytest.raises(UnsupportedError, match="payload"):
        urdf_regressor(loaded, states(loaded, 2))


@pytest.mark.data
def test_the_mjcf_collection(data_folder: Path) -> None:
    """Both engines, and the torques, biases and Y norms that were measured when it was made."""
    folder = data_folder / "robots"
    facts = json.loads((folder / "facts.json").read_text(encoding="utf-8"))
    assert len(facts) == 23
    for file, fact in facts.items():
        robot = load_robot(folder / file)
        check(robot)
        assert (robot.mj.nq, robot.nv) == (fact["nq"], fact["nv"]), file
        assert robot.phi[:, 0].sum() == pytest.approx(fact["mass"], rel=1e-12)
        for state in fact["states"]:
            q, v, a = (np.array([state[key]]) for key in ("qpos", "qvel", "qacc"))
            motion = Trajectory(np.zeros(1), q, v, a)
            Y = regression(robot, robot.inertial_columns).dense(motion).Y[0]
            recorded = np.array(state["tau_rne"])
            assert relative_gap(Y @ robot.phi.ravel(), recorded) < 1e-9, file
            assert np.linalg.norm(Y) == pytest.approx(state["frobY"], rel=1e-9), file
