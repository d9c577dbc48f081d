"""Model errors: the plant's robot has other geometry, the same truth, and obeys mechanics."""

from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.models.coupling.group import residual_jacobian
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.plugin_names import BUILTIN, build
from sysid_bench.regressors.coupled import torque_regression
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.model_errors import (
    BaseTilt,
    CouplingError,
    GearRatio,
    Kinematics,
    PayloadMount,
    PlantCoordinates,
)
from sysid_bench.simulation.plant import plant_of
from sysid_bench.simulation.tracking_control import TrackingControl
from sysid_bench.types import Array, Oracle, Trajectory
from tests.experiments.experiment_world import RICH, motion_of, robot_of

ROBOTS = ("ur5", "random:7", "random:mimic-gripper:1", RICH)
TERMS = tuple(SUFFIX)
SHORT = {"use": "fourier", "period": "2 s", "cycles": 1}


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def on(robot: RobotModel, plant: RobotModel) -> tuple[Trajectory, Oracle]:
    """A motion of the model's joints, and the ground truth of the plant that carries it out."""
    motion = motion_of(robot, SHORT, 50.0)
    moved = PlantCoordinates(robot, plant).to_plant(motion)
    no_error = np.zeros((len(moved), len(plant.torque_dofs)))
    return motion, Inverse().run(plant_of(plant), moved, no_error)[0]


def rms(x: Array) -> float:
    return float(np.sqrt((x**2).mean()))


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("use", ["kinematics", "base-tilt", "coupling"])
def test_the_truth_in_the_links_own_frames_explains_the_plants_torque(use: str, name: str) -> None:
    # Our regressor of the plant's geometry times the model's true parameters, against MuJoCo.
    robot = robot_of(name)
    plant = build("model_error", use).apply(robot, rng())
    _, oracle = on(robot, plant)
    columns = (*robot.inertial_columns, *robot.term_columns(TERMS))
    theta = np.concatenate([robot.phi.ravel(), robot.term_values(TERMS)])
    regression = torque_regression(plant, columns)
    blocks = [block.dense() for block in regression.blocks(oracle.motion)]
    scalar = np.isin(robot.torque_dofs, robot.scalar_dofs)  # balls have friction without a column
    ours, theirs = (np.concatenate(blocks) @ theta)[:, scalar], oracle.tau[:, scalar]
    np.testing.assert_allclose(ours, theirs, atol=1e-7 * np.abs(theirs).max())


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("use", ["kinematics", "base-tilt", "gear-ratio"])
def test_errors_change_torque_in_proportion_to_their_size(use: str, name: str) -> None:
    robot = robot_of(name)
    error = build("model_error", use)
    halved = type(error)(**{size: 0.5 * getattr(error, size) for size in error.sizes})
    exact = on(robot, robot)[1].tau
    change, half = (
        PlantCoordinates(robot, plant).to_model(on(robot, plant)[1]).tau - exact
        for plant in (error.apply(robot, rng()), halved.apply(robot, rng()))
    )
    assert rms(change) > 1e-6 * rms(exact)
    assert rms(2.0 * half - change) < 0.05 * rms(change)


@pytest.mark.parametrize("name", ["random:four-bar:2"])
def test_a_closed_chain_with_displaced_links_still_closes(name: str) -> None:
    robot = robot_of(name)
    plant = Kinematics().apply(robot, rng())
    motion = on(robot, plant)[1].motion
    assert plant.coupling is not None
    assert robot.coupling is not None
    for here, there in zip(plant.coupling.groups, robot.coupling.groups, strict=True):
        x = motion.q[:, plant.coupling.qadr[here.dofs]] - plant.coupling.q0[here.dofs]
        assert np.abs(residual_jacobian(here.constraints, here.dofs, x)[0]).max() < 1e-9
        assert np.abs(residual_jacobian(there.constraints, there.dofs, x)[0]).max() > 1e-6


@pytest.mark.parametrize("angle", [0.002, 0.01])
@pytest.mark.parametrize("seed", range(3))
def test_a_tilted_base_turns_gravity_by_its_angle(angle: float, seed: int) -> None:
    robot = robot_of("ur5")
    tilted = BaseTilt(angle).apply(robot, rng(seed)).tree.gravity
    exact = robot.tree.gravity
    size = np.linalg.norm(exact)
    assert np.linalg.norm(tilted) == pytest.approx(size, rel=1e-12)
    assert np.linalg.norm(np.cross(exact, tilted)) / size**2 == pytest.approx(np.sin(angle))


@pytest.mark.parametrize("name", ["ur5", "random:7", "random:mimic-gripper:1"])
def test_drives_of_another_ratio_keep_power_and_report_the_commanded_motion(name: str) -> None:
    robot = robot_of(name)
    errors = np.linspace(-0.02, 0.03, len(robot.torque_dofs)).tolist()
    plant = GearRatio(errors).apply(robot, rng())
    joints = PlantCoordinates(robot, plant)
    motion, oracle = on(robot, plant)
    seen = joints.to_model(oracle)
    np.testing.assert_allclose(seen.motion.q, motion.q, atol=1e-12)
    dofs = robot.torque_dofs
    scale = np.abs(oracle.tau * oracle.motion.v[:, dofs]).max()
    np.testing.assert_allclose(
        seen.tau * seen.motion.v[:, dofs], oracle.tau * oracle.motion.v[:, dofs], atol=1e-12 * scale
    )
    scalar = np.isin(dofs, robot.scalar_dofs)
    ratio = oracle.motion.v[:, dofs[scalar]] / seen.motion.v[:, dofs[scalar]]
    np.testing.assert_allclose(ratio[5], 1.0 + np.array(errors)[scalar], rtol=1e-9)


def test_the_controller_is_declared_for_the_joints_that_the_model_sees() -> None:
    robot = robot_of("ur5")
    plant = GearRatio([0.02, -0.02, 0.01, 0.03, -0.03, 0.01]).apply(robot, rng())
    joints = PlantCoordinates(robot, plant)
    commanded = motion_of(robot, SHORT, 2000.0)
    oracle, controller = TrackingControl(rate=2000.0).run(
        plant_of(plant), joints.to_plant(commanded), np.zeros((len(commanded), 6))
    )
    assert controller is not None
    seen = joints.to_model(oracle)
    assert controller.held  # else the feedback is that of the rates at the end of a step
    declared = controller.kp * (commanded.q - seen.motion.q)
    declared += controller.kd * (commanded.v - seen.motion.v)
    np.testing.assert_allclose(seen.tau, declared, atol=1e-9 * np.abs(seen.tau).max())
    nominal = TrackingControl(rate=2000.0).run(
        plant_of(robot), commanded, np.zeros((len(commanded), 6))
    )[1]
    assert nominal is not None  # gains of one digit tell nothing about the ratio
    np.testing.assert_array_equal(controller.kp, nominal.kp)


@pytest.mark.parametrize("error", [-0.05, 0.02])
def test_a_coupling_error_changes_the_slope_of_a_follower(error: float) -> None:
    robot = robot_of("random:mimic-gripper:1")
    plant = CouplingError(error).apply(robot, rng())
    motion, oracle = on(robot, plant)
    assert robot.coupling is not None
    dependent = robot.coupling.dependent
    np.testing.assert_allclose(
        oracle.motion.v[:, dependent], (1.0 + error) * motion.v[:, dependent], rtol=1e-9, atol=1e-12
    )
    seen = PlantCoordinates(robot, plant).to_model(oracle).motion
    np.testing.assert_allclose(seen.q, motion.q, atol=1e-9)


def test_a_payload_mount_turns_the_payload_alone() -> None:
    bare, loaded = robot_of("ur5"), robot_of("ur5", "sphere-offset-1kg")
    assert PayloadMount().apply(bare, rng()) is bare
    plant = PayloadMount(position=0.0, rotation=0.01).apply(loaded, rng())
    moved = [b for b, name in enumerate(loaded.body_names) if _pose(plant, b) != _pose(loaded, b)]
    assert moved == [loaded.payload_body]
    # An offset of 0.1 m turned by 0.01 rad moves 1 kg by up to 1 mm: 10 mN m.
    change = on(loaded, plant)[1].tau - on(loaded, loaded)[1].tau
    assert 1e-4 < np.abs(change).max() < 0.05


def _pose(robot: RobotModel, b: int) -> tuple[Any, ...]:
    return (*robot.mj.body_pos[b + 1], *robot.mj.body_quat[b + 1])


def test_every_model_error_has_the_size_of_its_settings_or_is_refused() -> None:
    robot = robot_of("ur5")
    with pytest.raises(UsageError, match=r"position has 2 values for the 6 joints shoulder_pan"):
        Kinematics(position=[0.001, 0.002]).apply(robot, rng())
    with pytest.raises(UsageError, match="give 0 or more"):
        BaseTilt(-0.1)
    with pytest.raises(UsageError, match="less than 50 %"):
        GearRatio(0.6)
    assert set(BUILTIN["model_error"]) == {
        *("kinematics", "base-tilt", "gear-ratio", "coupling", "payload-mount")
    }
