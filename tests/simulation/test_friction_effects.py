"""Effects of friction, position and load: sizes, energy, hysteresis and the limits of each."""

from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.models.random_robot import RandomRobot, random_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.plugin_names import BUILTIN, build, resolve
from sysid_bench.simulation.compiled_steps import compiled_torque
from sysid_bench.simulation.effects.friction import (
    Asymmetric,
    CurvedFriction,
    LoadFriction,
    WarmUp,
    friction_scale,
)
from sysid_bench.simulation.effects.periodic import LowHarmonics, TorqueRipple
from sysid_bench.simulation.effects.presliding import Play
from sysid_bench.simulation.effects.springs import Cables
from sysid_bench.simulation.plant import plant_of
from sysid_bench.simulation.tracking_control import TrackingControl
from sysid_bench.simulation.tracking_model import tracking_model
from sysid_bench.types import Array
from tests.closeness import assert_close
from tests.experiments.experiment_world import CLOSED_LOOP, ready
from tests.robots import named_robot, robot_of
from tests.simulation.test_internal_states import run

ARMS = RandomRobot(bodies=(3, 6), roots=(1, 1), ball=0.0, free_root=0.0, no_gravity=0.0)
ROBOTS = [named_robot("ur5"), named_robot("scara")] + [
    robot_of(random_robot(seed, ARMS)) for seed in (1, 2)
]
EFFECTS = sorted(set(BUILTIN["plant"]) - {"matched"})
TOGETHER = sorted({*EFFECTS} - {"play"})  # LuGre and play both are the robot's Coulomb friction
T = np.linspace(0.0, 4.0, 4001)
CYCLE = T >= 2.0

each_robot = pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)


def along(robot: RobotModel, effect: Any, q: Array, load: float = 0.0) -> Array:
    """Torque (N, nv) of an effect along a motion q (N,) of every joint, from rest."""
    v = np.gradient(q, T)
    v[0] = 0.0
    every, rate, loads = (np.repeat(x[:, None], robot.nv, axis=1) for x in (q, v, load + 0 * v))
    return compiled_torque([effect.prepare(robot)], T, every, rate, loads, 4)


def work(tau: Array, q: Array) -> Array:
    """Energy (nv,) that the second of two cycles takes."""
    return np.asarray(np.trapezoid(tau[CYCLE], q[CYCLE], axis=0))


@pytest.mark.parametrize("name", EFFECTS)
def test_sizes_of_zero_leave_a_closed_loop_as_it_is(name: str) -> None:
    effect = build("plant", {"use": name, **dict.fromkeys(resolve("plant", name).sizes, 0)})
    robot = ROBOTS[0]
    ours, plain = run(robot, [effect], 0.1), run(robot, [], 0.1)
    np.testing.assert_array_equal(ours.tau, plain.tau)
    np.testing.assert_array_equal(ours.motion.q, plain.motion.q)


@each_robot
def test_all_effects_together_move_every_joint_and_stay_finite(robot: RobotModel) -> None:
    effects = [build("plant", name) for name in TOGETHER]
    ours, plain = run(robot, effects, 0.1), run(robot, [], 0.1)
    change = np.abs(ours.tau - plain.tau).max(axis=0)
    assert (change > 1e-4 * np.abs(plain.tau).max()).all()
    assert (change < 2.0 * np.abs(plain.tau).max()).all()


@pytest.mark.parametrize("amplitude", [1e-4, 4e-4, 2e-3, 0.1])
@each_robot
def test_play_dissipates_the_area_of_its_loop(robot: RobotModel, amplitude: float) -> None:
    Fc, w = robot.joint_terms.coulomb, 5e-4
    q = amplitude * np.sin(np.pi * T)
    tau = along(robot, Play(width=w), q)
    expected = 4 * Fc * max(amplitude - w, 0.0)
    np.testing.assert_allclose(work(tau, q), expected, rtol=1e-3, atol=1e-6 * Fc.max() * amplitude)
    # Friction turns around within 2 w of a reversal, wherever it happens.
    if amplitude > 10 * w:
        back = np.flatnonzero(np.diff(np.sign(tau[:, np.argmax(Fc)])) < 0)
        np.testing.assert_allclose(amplitude - q[back[0]], w, atol=1e-3 * amplitude)


@each_robot
@pytest.mark.parametrize("load", [-20.0, 3.0])
def test_load_friction_is_proportional_to_the_load(robot: RobotModel, load: float) -> None:
    q = 0.2 * np.sin(np.pi * T)
    effect = LoadFriction(coulomb=0.08)
    once, twice = along(robot, effect, q, load), along(robot, effect, q, 2 * load)
    assert_close(twice, 2 * once, 1e-12)
    assert np.abs(once).max() == pytest.approx(0.08 * abs(load))
    assert not along(robot, effect, q, 0.0).any()
    np.testing.assert_allclose(work(once, q), 4 * 0.08 * abs(load) * (0.2 - 5e-4), rtol=1e-3)


@each_robot
def test_friction_tends_to_that_of_the_warm_robot(robot: RobotModel) -> None:
    q = 0.2 * np.sin(np.pi * T)
    cold = np.abs(along(robot, WarmUp(), q)).max(axis=0)
    for times in (1.0, 2.0, 20.0):
        warmer = np.abs(along(robot, WarmUp(elapsed=times * 1800.0), q)).max(axis=0)
        assert_close(warmer, np.exp(-times) * cold, 1e-9)
    quick = along(robot, WarmUp(time=0.1), q)
    assert (np.abs(quick[-100:]).max(axis=0) < 1e-12 * cold).all()


@each_robot
def test_friction_differs_between_the_two_directions_by_what_is_set(robot: RobotModel) -> None:
    share, scale = 0.2, friction_scale(robot)
    slow = 0.05 * np.sin(np.pi * T)
    tau = along(robot, Asymmetric(coulomb=share, viscous=0.0), slow)
    own = scale.coulomb - scale.missing
    forward, backward = tau[3999] + own, tau[3000] - own
    np.testing.assert_allclose(np.abs(forward), (1 + share) * scale.coulomb, rtol=1e-9)
    np.testing.assert_allclose(np.abs(backward), (1 - share) * scale.coulomb, rtol=1e-9)
    total = tau + own * np.sign(np.gradient(slow, T))[:, None]
    assert (work(total, slow) > 0).all()


@each_robot
def test_low_harmonics_and_bent_cables_store_energy_and_hysteresis_takes_it(
    robot: RobotModel,
) -> None:
    q = 0.7 * np.sin(np.pi * T) + 0.2
    for effect in (LowHarmonics(phase=0.3), Cables(hysteresis=0.0)):
        tau = along(robot, effect, q)
        assert (np.abs(work(tau, q)) <= 1e-4 * np.abs(tau).max(axis=0)).all()
    assert (work(along(robot, Cables(), q), q) > 0).all()


def test_ripple_multiplies_the_motors_torque_and_has_the_gears_period() -> None:
    robot = ROBOTS[0]
    effect = TorqueRipple(first=0.02, second=0.0, fourth=0.0, ratio=50.0)
    q = 0.1 * T
    tau = along(robot, effect, q, load=10.0)
    # The motor gives load + tau, and the link receives (1 + x) of it.
    x = 0.02 * np.sin(50.0 * q)[:, None]
    np.testing.assert_allclose((1 + x) * (10.0 + tau), 10.0, rtol=1e-12)


def test_curvature_is_the_change_of_viscous_friction_at_the_velocity_limit() -> None:
    robot = ROBOTS[0]
    law = CurvedFriction(curvature=-0.3).prepare(robot)
    assert law is not None
    scale, v = friction_scale(robot), robot.limits.v
    torque, _ = law.step(law.start(0 * v, v), 1e-3, 0.0, 0 * v, v, 0 * v)
    assert_close(torque, (scale.missing_viscous - 0.3 * scale.viscous) * v)


@pytest.mark.parametrize("setting", [
    {"use": "play", "width": -1e-4}, {"use": "load-friction", "coulomb": "60 %"},
    {"use": "asymmetric-friction", "coulomb": "-100 %"}, {"use": "warm-up", "time": 0},
    {"use": "periodic-friction", "first": "99 %"}, {"use": "torque-ripple", "fourth": "30 %"},
    {"use": "curved-friction", "curvature": "-120 %"}, {"use": "gravity-spring", "arm": 1.0},
    {"use": "cables", "width": 0}, {"use": "lugre", "vs": 0},
    {"use": "elastic-joints", "encoders": "both"},
], ids=str)  # fmt: skip
def test_impossible_sizes_are_refused(setting: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        build("plant", setting)


def test_a_width_for_some_joints_alone_is_refused() -> None:
    with pytest.raises(UsageError, match="every joint one"):
        Play(width=[0.0, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3]).prepare(ROBOTS[0])
    with pytest.raises(UsageError, match="6 joints"):
        Play(width=[1e-3, 1e-3]).prepare(ROBOTS[0])


def test_sizes_of_effects_are_drawn_for_each_joint() -> None:
    ranges = {
        "asymmetric-friction": ("coulomb", "-20 %", "20 %"), "cables": ("bending", 0.0, "5 %"),
        "curved-friction": ("curvature", "-50 %", 0.0), "gravity-spring": ("balance", 0.0, "50 %"),
        "elastic-joints": ("windup", "0.3 mrad", "1 mrad"), "load-friction": ("coulomb", 0, "10 %"),
        "low-harmonics": ("first", 0, "3 %"), "lugre": ("presliding", "0.2 mrad", "2 mrad"),
        "periodic-friction": ("first", 0, "5 %"), "stribeck": ("share", "2 %", "6 %"),
        "torque-ripple": ("phase", 0.0, "360 deg"), "warm-up": ("viscous", "40 %", "100 %"),
    }  # fmt: skip
    assert sorted(ranges) == TOGETHER
    listed = [
        {"use": use, key: {"from": low, "to": high}} for use, (key, low, high) in ranges.items()
    ]
    plant = {"use": "composed", "effects": listed}
    values = ready(plant=plant, simulation=CLOSED_LOOP, held_out=()).source.built.values
    drawn = [list(row["drawn"].values()) for row in values]
    assert [len(sizes) for sizes in drawn] == [6] * len(ranges)
    assert all(len(set(sizes)) == 6 for sizes in drawn)


def test_steps_follow_the_springs_of_all_laws_side_by_side() -> None:
    """Springs side by side add up, and need finer steps than each alone."""
    cables = Cables(hysteresis=0.5, width=1e-4)
    steps = []
    for count in (1, 4):
        plant = plant_of(ROBOTS[0], [cables] * count)
        mj = tracking_model(plant, TrackingControl().controller(plant))
        steps.append(round(1e-3 / mj.opt.timestep))
    assert steps[1] == pytest.approx(2 * steps[0], abs=1)
