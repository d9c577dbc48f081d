"""Closed-loop laws: what is recorded closes the equation of motion, and trouble is said."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import SimulationError, UnsupportedError, UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.regression import regression
from sysid_bench.simulation.candidate import kinematics_of
from sysid_bench.simulation.plant import plant_of
from sysid_bench.simulation.tracking_control import TrackingControl, commands
from sysid_bench.types import Array, Controller, Oracle
from tests.closeness import assert_close
from tests.experiments.experiment_world import MODELS, RICH, SMOOTH, Law, motion_of, robot_of

RATE = 500.0
LOOP = TrackingControl(rate=RATE)
FOURIER = {"use": "fourier", "period": "2 s", "cycles": 1}


def zero(t: Array, q: Array, v: Array) -> Array:
    return np.zeros_like(v)


def run(
    robot: RobotModel,
    effects: tuple[Any, ...] = (),
    noise: float = 0.0,
    loop: TrackingControl = LOOP,
) -> tuple[Oracle, Controller]:
    motion = motion_of(robot, FOURIER, loop.rate)
    encoder = noise * np.random.default_rng(3).normal(size=motion.v.shape)
    oracle, controller = loop.run(plant_of(robot, effects), motion, encoder)
    assert controller is not None
    return oracle, controller


def modelled(robot: RobotModel, oracle: Oracle) -> Array:
    """Y theta (N, nv) of every parameter that the robot has, Coulomb friction apart."""
    terms = ("viscous", "offset", "armature", "spring")
    columns = robot.inertial_columns + robot.term_columns(terms)
    theta = np.concatenate([robot.phi.ravel(), robot.term_values(terms)])
    return regression(robot, columns).torque(oracle.motion, theta)


@pytest.mark.parametrize("effects", [(), (Law(zero),)], ids=["batched", "stepping"])
@pytest.mark.parametrize("noise", [0.0, 1e-4])
@pytest.mark.parametrize("payload", ["none", "box-2kg"])
@pytest.mark.parametrize("name", [SMOOTH, RICH, "file:arm.xml"])
def test_a_recording_closes_the_equation_of_motion(
    name: str, payload: str, noise: float, effects: tuple[Law, ...]
) -> None:
    robot = robot_of(name, payload)
    oracle, _ = run(robot, effects, noise)
    gap = np.abs(modelled(robot, oracle) - oracle.tau).max()
    assert gap <= 1e-9 * np.abs(oracle.tau).max()


@pytest.mark.parametrize("name", ["ur5", RICH])
def test_both_ways_of_stepping_are_one(name: str) -> None:
    robot = robot_of(name, "box-2kg")
    (batched, _), (stepped, _) = run(robot, (), 1e-4), run(robot, (Law(zero),), 1e-4)
    for field in ("q", "v", "a"):
        np.testing.assert_allclose(
            getattr(batched.motion, field), getattr(stepped.motion, field), rtol=0, atol=1e-12
        )
    np.testing.assert_allclose(batched.tau, stepped.tau, rtol=0, atol=1e-10)


def test_effects_are_supplied_by_the_motors_here_too() -> None:
    robot = robot_of(RICH)
    oracle, _ = run(robot, (Law(lambda t, q, v: 0.5 * v**3 + 0.2 * np.cos(q)),))
    m = oracle.motion
    rest = oracle.tau - modelled(robot, oracle)
    np.testing.assert_allclose(rest, 0.5 * m.v**3 + 0.2 * np.cos(m.q), atol=1e-9)


def test_coulomb_friction_of_moving_joints_is_nearly_the_law() -> None:
    """Friction is a soft constraint of the engine: joints that move leave little of it."""
    robot = robot_of("ur5")
    oracle, _ = run(robot)
    v, coulomb = oracle.motion.v, robot.joint_terms.coulomb
    rest = oracle.tau - modelled(robot, oracle) - coulomb * np.sign(v)
    moving = np.abs(v) > 0.2
    assert moving.mean() > 0.5
    assert np.quantile((np.abs(rest) / coulomb)[moving], 0.95) < 0.02


def test_the_joints_follow_the_commanded_motion() -> None:
    robot = robot_of(SMOOTH, "box-2kg")
    oracle, _ = run(robot)
    reach = robot.limits.q_high - robot.limits.q_low
    commanded = motion_of(robot, FOURIER, RATE)
    # "droop" is 0.5 % of the range; inertia and a moving reference add a little.
    assert (np.abs(oracle.motion.q - commanded.q).max(axis=0) < 0.05 * reach).all()


def test_the_controller_sees_the_noise_of_the_encoders() -> None:
    robot = robot_of(SMOOTH)
    (exact, gains), (noisy, same), (worse, _) = (run(robot, (), s) for s in (0.0, 1e-4, 1e-3))
    first = np.abs(noisy.motion.q - exact.motion.q).max()
    second = np.abs(worse.motion.q - exact.motion.q).max()
    assert 1e-6 < first < second
    np.testing.assert_array_equal(gains.kp, same.kp)  # declared gains know no noise


def test_the_feedback_law_is_the_declared_one() -> None:
    """tau = kp (q_ref - q) + kd (v_ref - v) of what really happened, without noise and limits."""
    robot = robot_of(RICH)
    oracle, controller = run(robot)
    commanded, m = motion_of(robot, FOURIER, RATE), oracle.motion
    law = controller.kp * (commanded.q - m.q) + controller.kd * (commanded.v - m.v)
    np.testing.assert_allclose(oracle.tau, law, atol=1e-9 * np.abs(law).max())
    assert controller.rate == RATE


def test_the_velocity_feedback_carries_the_low_passed_slope_of_the_error() -> None:
    robot = robot_of(RICH)
    commanded = motion_of(robot, FOURIER, RATE)
    controller = Controller(np.full(3, 4.0), np.full(3, 2.0), RATE, 30.0)
    ramp = 0.1 * commanded.t[:, None] * np.ones(3)
    u = commands(controller, commanded, ramp, robot)
    still = commands(controller, commanded, np.zeros_like(ramp), robot)
    settled = commanded.t > 0.2  # long after 1 / (2 pi 30 Hz)
    assert_close((u - still + ramp)[settled], -0.5 * 0.1, 1e-6)


def limited(folder: Path, limit: float) -> RobotModel:
    manifest = folder / "robot.toml"
    manifest.write_text(
        f'name = "limited"\nfile = "{MODELS / "arm.xml"}"\n[limits.shoulder]\ntau = {limit}\n'
    )
    return load_robot(str(manifest))


def test_torque_limits_hold_in_closed_loop(tmp_path: Path) -> None:
    free, _ = run(limited(tmp_path, 1e6))
    peak = np.abs(free.tau[:, 0]).max()
    held, _ = run(limited(tmp_path, 0.9 * peak))
    assert np.abs(held.tau[:, 0]).max() == pytest.approx(0.9 * peak, rel=1e-12)
    robot = limited(tmp_path, 0.9 * peak)
    gap = np.abs(modelled(robot, held) - held.tau).max()
    assert gap <= 1e-9 * peak  # the recorded torque is the one that acted


FORCES = {
    "gravcomp": ('gravcomp="1"', "", ""),
    "medium": ("", 'density="1000" viscosity="1"', ""),
    "spring": ("", "", '<fixed name="t" stiffness="30" damping="2">JOINTS</fixed>'),
    "friction": ("", "", '<fixed name="t" frictionloss="2">JOINTS</fixed>'),
    "rotor": ("", "", '<fixed name="t" armature="1">JOINTS</fixed>'),
}


@pytest.mark.parametrize("force", FORCES)
def test_forces_that_are_no_joint_terms_are_off_on_the_bench(force: str, tmp_path: Path) -> None:
    body, option, tendon = FORCES[force]
    joints = '<joint joint="shoulder" coef="1"/><joint joint="elbow" coef="0.5"/>'
    text = (MODELS / "arm.xml").read_text().replace('name="fore"', f'name="fore" {body}')
    text = text.replace("<worldbody>", f"<option {option}/><worldbody>")
    tendons = f"<tendon>{tendon.replace('JOINTS', joints)}</tendon>" if tendon else ""
    (tmp_path / "arm.xml").write_text(text.replace("</mujoco>", f"{tendons}</mujoco>"))
    robot = load_robot(str(tmp_path / "arm.xml"))
    oracle, _ = run(robot)
    gap = np.abs(modelled(robot, oracle) - oracle.tau).max()
    assert gap <= 1e-9 * np.abs(oracle.tau).max()


LAWS = {
    "unstable": lambda t, q, v: -3000.0 * v,
    "explosive": lambda t, q, v: -1e9 * v,
    "not a number": lambda t, q, v: np.nan * v,
}


@pytest.mark.parametrize("law", LAWS)
def test_divergence_is_an_error(law: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # the engine logs its warnings into the working folder
    with pytest.raises(SimulationError, match="smooth"):
        run(robot_of(SMOOTH), (Law(LAWS[law]),))


@pytest.mark.parametrize("place", range(3))
def test_a_coupled_robot_with_a_link_of_no_inertia_names_its_joint(
    place: int, tmp_path: Path
) -> None:
    branches = "".join(
        f"""<body name="b{k}" pos="{k} 0 0"><joint name="j{k}" range="-1 1" damping="0.1"/><inertial
        pos="0.1 0 0" mass="{m}" diaginertia="{m} {m} {m}"/></body>"""
        for k, m in enumerate((1e-9 if k == place else 1.0) for k in range(3))
    )
    file = tmp_path / "coupled.xml"
    file.write_text(
        f"""<mujoco><compiler angle="radian"/><worldbody>{branches}<body name="d" pos="0 1 0">
        <joint name="d"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody>
        <equality><joint joint1="d" joint2="j{(place + 1) % 3}"/></equality></mujoco>"""
    )
    robot = load_robot(file)
    motion = motion_of(robot, FOURIER, RATE)
    with pytest.raises(UnsupportedError, match=f"joint 'j{place}' moves .* rotor inertia"):
        LOOP.run(plant_of(robot), motion, np.zeros_like(motion.v))


@pytest.mark.parametrize("noise", [3.0, 1e6, np.nan])
def test_a_loop_that_loses_its_motion_is_an_error(
    noise: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SimulationError, match="smooth"):
        run(robot_of(SMOOTH), (), noise)


@pytest.mark.parametrize("name", ["solo12", "file:ball.xml", "file:free.xml"])
def test_floating_and_ball_joints_are_unsupported(name: str) -> None:
    robot = robot_of(name)
    motion = motion_of(robot, FOURIER, RATE)
    with pytest.raises(UnsupportedError, match="fixed base"):
        LOOP.run(plant_of(robot), motion, np.zeros_like(motion.v))


@pytest.mark.parametrize(("recording", "good"), [(500.0, True), (250.0, True), (50.0, True)])
def test_the_recording_rate_divides_the_control_rate(recording: float, good: bool) -> None:
    assert LOOP.design_rate(recording) == RATE


@pytest.mark.parametrize("recording", [300.0, 499.0, 1000.0])
def test_other_recording_rates_are_refused(recording: float) -> None:
    with pytest.raises(UsageError, match="divide"):
        LOOP.design_rate(recording)


@pytest.mark.parametrize("name", ["ur5", "icub", "file:free.xml", "file:ball.xml", RICH])
def test_a_bare_robot_keeps_its_kinematics_and_nothing_else(name: str) -> None:
    robot = robot_of(name, "box-2kg")
    bare = kinematics_of(robot)
    for field in ("body_pos", "body_quat", "body_parentid", "jnt_type", "jnt_qposadr", "qpos0"):
        np.testing.assert_allclose(
            getattr(bare.mj, field), getattr(robot.mj, field), rtol=0, atol=1e-15
        )
    scalar = [j for j, joint in enumerate(robot.joints) if joint.kind in ("hinge", "slide")]
    for field in ("jnt_axis", "jnt_pos"):
        ours, theirs = getattr(bare.mj, field), getattr(robot.mj, field)
        np.testing.assert_allclose(ours[scalar], theirs[scalar], rtol=0, atol=1e-15)
    assert (bare.mj.body_mass[1:] == 1.0).all()
    assert (bare.mj.body_inertia[1:] == 1.0).all()
    assert not bare.mj.body_ipos.any()
    assert bare.mj.ngeom == bare.mj.ntendon == 0
    for field in ("dof_damping", "dof_frictionloss", "dof_armature", "jnt_stiffness"):
        assert not getattr(bare.mj, field).any(), field
    assert bare.body_names == robot.body_names
    assert bare.rows == robot.rows


@pytest.mark.parametrize("name", [SMOOTH, RICH])
def test_a_held_torque_moves_the_positions_as_the_equation_of_motion_says(name: str) -> None:
    """Second differences of the positions are the accelerations that the torques make; an implicit
    step would move them as if kd times the step were inertia."""
    robot, loop = robot_of(name), TrackingControl(rate=2000.0, substeps=1)
    oracle, controller = run(robot, loop=loop)
    assert controller.held
    q, a = oracle.motion.q, oracle.motion.a
    second = np.diff(q, 2, axis=0) * loop.rate**2
    np.testing.assert_allclose(second, a[1:-1], atol=1e-6 * np.abs(a).max())


@pytest.mark.parametrize(
    ("name", "gains"), [(SMOOTH, {"bandwidth": 20.0}), (RICH, {"kp": 5e3, "kd": 500.0})]
)
@pytest.mark.parametrize("effects", [(), (Law(zero),)], ids=["batched", "stepping"])
def test_an_implicit_step_reports_the_torque_that_it_applies(
    name: str, gains: dict[str, Any], effects: tuple[Law, ...]
) -> None:
    """Where the torque cannot be held, rates of dampers and feedback are those at the end of a
    step. The torque at its start would belong to a robot that is heavier by a step times kd."""
    robot, loop = robot_of(name), TrackingControl(rate=150.0, substeps=1, **gains)
    oracle, controller = run(robot, effects, loop=loop)
    assert not controller.held
    q, a = oracle.motion.q, oracle.motion.a
    second = np.diff(q, 2, axis=0) * loop.rate**2
    np.testing.assert_allclose(second, a[1:-1], atol=1e-6 * np.abs(a).max())
    gap = np.abs(modelled(robot, oracle) - oracle.tau).max()
    assert gap <= 1e-9 * np.abs(oracle.tau).max()


def test_a_loop_too_slow_for_its_damping_is_not_held() -> None:
    robot = robot_of("kinova")  # wrists without rotors, and much viscous friction
    assert not TrackingControl(rate=500.0).controller(plant_of(robot)).held
    oracle, _ = run(robot)
    assert np.isfinite(oracle.motion.q).all()


@pytest.mark.parametrize(("kp", "kd"), [(50.0, 5.0), ([50.0, 40.0, 30.0], [5.0, 4.0, 3.0])])
def test_declared_gains_are_the_controller(kp: Any, kd: Any) -> None:
    robot, loop = robot_of(RICH), TrackingControl(rate=RATE, kp=kp, kd=kd)
    oracle, controller = run(robot, loop=loop)
    np.testing.assert_array_equal(controller.kp, np.broadcast_to(kp, 3))
    np.testing.assert_array_equal(controller.kd, np.broadcast_to(kd, 3))
    assert len(oracle.motion) > 0


@pytest.mark.parametrize(
    ("gains", "reported"),
    [
        ({"kp": 1.0}, "both kp and kd"),
        ({"kp": [1.0, -1.0, 1.0], "kd": 1.0}, "positive"),
        ({"kp": "stiff", "kd": 1.0}, "positive"),
        ({"kp": [1.0, 1.0], "kd": 1.0}, "3 motors"),
    ],
)
def test_gains_that_are_no_controller_are_refused(gains: dict[str, Any], reported: str) -> None:
    with pytest.raises(UsageError, match=reported):
        TrackingControl(rate=RATE, **gains).controller(plant_of(robot_of(RICH)))
