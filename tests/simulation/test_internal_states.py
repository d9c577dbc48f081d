"""Force laws with internal states and elastic transmissions: compiled or in Python, their limits,
energy and resonance."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import UnsupportedError, UsageError
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import Fourier
from sysid_bench.models.random_robot import RandomRobot, random_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation import compiled_steps, tracking_model
from sysid_bench.simulation.compiled_steps import compiled_torque, steps_library
from sysid_bench.simulation.effects.presliding import Lugre, Stribeck
from sysid_bench.simulation.effects.springs import (
    LEAST_LOAD,
    ElasticJoints,
    least_load,
)
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.plant import plant_of
from sysid_bench.simulation.tracking_control import TrackingControl
from sysid_bench.types import Array, Oracle, Trajectory
from tests.robots import named_robot, robot_of

ARMS = RandomRobot(bodies=(3, 6), roots=(1, 1), ball=0.0, free_root=0.0, no_gravity=0.0)
ROBOTS = [named_robot("ur5"), named_robot("scara"), robot_of(random_robot(1, ARMS))]
EFFECTS = {
    "LuGre": [Lugre(peak=0.3)],
    "elastic": [ElasticJoints()],
    "backlash": [ElasticJoints(gap=3e-4), Lugre(), Stribeck()],
    "link-side": [ElasticJoints(encoders="link")],
}


def run(robot: RobotModel, effects: list[Any], seconds: float = 0.5, **settings: Any) -> Oracle:
    motion = Fourier(harmonics=3, period=seconds, cycles=1).design(
        design_problem(robot, 1000.0), np.random.default_rng(3)
    )
    still = np.zeros((len(motion), len(robot.torque_dofs)))
    return TrackingControl(**settings).run(plant_of(robot, effects), motion, still)[0]


@pytest.mark.parametrize("effects", EFFECTS.values(), ids=EFFECTS)
@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
def test_compiled_states_equal_those_in_python(
    robot: RobotModel, effects: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    if isinstance(steps_library(), str):
        pytest.skip(steps_library())
    compiled = run(robot, effects, 0.1)
    monkeypatch.setattr(compiled_steps, "steps_library", lambda: "absent")
    python = run(robot, effects, 0.1)
    for ours, theirs in (
        (compiled.tau, python.tau),
        (compiled.motion.q, python.motion.q),
        ((compiled.encoders or compiled.motion).a, (python.encoders or python.motion).a),
    ):
        assert np.abs(ours - theirs).max() <= 1e-12 * max(np.abs(theirs).max(), 1.0)


@pytest.mark.parametrize("effect", [Lugre(presliding=0.0), ElasticJoints(windup=0.0)])
def test_an_effect_of_size_zero_changes_nothing(effect: Any) -> None:
    robot = named_robot("ur5")
    for ours, plain in zip(
        (run(robot, [effect]), _played(robot, [effect])), (run(robot, []), _played(robot, [])),
        strict=True,
    ):  # fmt: skip
        np.testing.assert_array_equal(ours.tau, plain.tau)
        np.testing.assert_array_equal(ours.motion.q, plain.motion.q)


def _played(robot: RobotModel, effects: list[Any]) -> Oracle:
    motion = Fourier(harmonics=3, period=2.0).design(
        design_problem(robot, 200.0), np.random.default_rng(3)
    )
    still = np.zeros((len(motion), len(robot.torque_dofs)))
    return Inverse().run(plant_of(robot, effects), motion, still)[0]


def _presliding_torque(q: Array, t: Array, each: int) -> Array:
    """Torque of LuGre friction of ur5 along one common joint motion q (N,)."""
    robot = named_robot("ur5")
    law = Lugre().prepare(robot)
    assert law is not None
    v = np.gradient(q, t)
    v[0] = 0.0  # from rest
    every, rate, load = (np.repeat(x[:, None], robot.nv, axis=1) for x in (q, v, 0 * v))
    return compiled_torque([law], t, every, rate, load, each)


@pytest.mark.parametrize("amplitude", [1e-4, 1e-3, 0.1])
def test_presliding_dissipates_over_a_closed_cycle(amplitude: float) -> None:
    t = np.linspace(0.0, 3.0, 6001)
    q = amplitude * np.sin(2 * np.pi * t)
    tau = _presliding_torque(q, t, 4)
    last = t >= 2.0
    work = np.trapezoid(tau[last], q[last], axis=0)
    coulomb = named_robot("ur5").joint_terms.coulomb
    assert (work > 0).all()
    # A cycle of sliding costs 4 Fc per unit of amplitude; presliding motions cost less.
    assert (work <= 4 * coulomb * amplitude * (1 + 1e-6)).all()
    if amplitude == 0.1:
        np.testing.assert_allclose(work, 4 * coulomb * amplitude, rtol=0.02)


def test_presliding_is_a_spring_at_first_and_coulomb_friction_in_the_end() -> None:
    t = np.linspace(0.0, 1.0, 2001)
    tau = _presliding_torque(1e-5 * t, t, 4)
    coulomb = named_robot("ur5").joint_terms.coulomb
    np.testing.assert_allclose(tau[-1], coulomb * 1e-5 / Lugre().presliding, rtol=0.02)
    np.testing.assert_allclose(_presliding_torque(0.1 * t, t, 4)[-1], coulomb, rtol=1e-3)


@pytest.mark.parametrize("presliding", [2e-4, 2e-3])
def test_a_hysteresis_loop_has_the_stated_width(presliding: float) -> None:
    """After a reversal in sliding, dz/dq = 1 + z / zs from z = zs on: friction crosses zero after
    zs ln 2, and is that of sliding but for 1 % after zs ln 200."""
    robot, t = named_robot("ur5"), np.linspace(0.0, 2.0, 20001)
    speed = 20 * presliding  # the dampers of the bristles hardly matter
    q = speed * (1 - np.abs(t - 1.0))
    law = Lugre(presliding=presliding).prepare(robot)
    assert law is not None
    v = np.where(t < 1.0, speed, -speed)
    v[0] = 0.0  # from rest
    every, rate = (np.repeat(x[:, None], robot.nv, axis=1) for x in (q, v))
    tau = compiled_torque([law], t, every, rate, 0 * every, 1)[t >= 1.0]
    tau = tau / np.abs(tau[-1])
    back = speed * (t[t >= 1.0] - 1.0)
    crossed, slides = (back[np.argmax(tau < limit, axis=0)] for limit in (0.0, -0.99))
    np.testing.assert_allclose(crossed, presliding * np.log(2), rtol=0.05)
    np.testing.assert_allclose(slides, presliding * np.log(200), rtol=0.05)


def test_a_joint_with_presliding_comes_to_rest() -> None:
    """Constant commands: bristles hold the arm, while sign(v) alone would creep."""
    robot = named_robot("ur5")
    motion = Fourier(harmonics=1, period=1.0).design(
        design_problem(robot, 1000.0), np.random.default_rng(0)
    )
    held = type(motion)(
        motion.t, np.tile(motion.q[:1], (len(motion), 1)), 0 * motion.v, 0 * motion.a, "held"
    )
    oracle = TrackingControl().run(plant_of(robot, [Lugre()]), held, 0 * held.v)[0]
    assert np.abs(oracle.motion.v[-1]).max() < 1e-4


def test_elastic_joints_tend_to_rigid_ones() -> None:
    robot = ROBOTS[-1]
    rigid = run(robot, [], substeps=16)
    errors = []
    for K in (1e3, 1e4, 1e5):
        soft = run(robot, [ElasticJoints(stiffness=K, damping=1e-3)], substeps=16)
        errors.append(np.abs(soft.motion.q - rigid.motion.q).max())
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.1 * errors[0]


ROTOR = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="link">
      <joint name="j" axis="0 0 1" range="-3 3" armature="0.2" limited="true"/>
      <inertial mass="2" pos="0.5 0 0" diaginertia="0.1 0.1 0.1"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize("name", ["ur5", "scara", "tx40"])
def test_an_elastic_motion_starts_without_a_transient(name: str) -> None:
    """The motion before the first sample winds the springs and bristles up."""
    robot = named_robot(name)
    oracle = run(robot, [ElasticJoints(), Lugre(peak=0.3)], 1.0)
    a = oracle.motion.a[:, robot.torque_dofs]
    start, later = (np.abs(np.diff(x, axis=0)).max(axis=0) for x in (a[:20], a[20:]))
    assert (start <= 2.0 * later).all()


def test_slides_and_hinges_have_loads_of_their_own() -> None:
    """Newtons of a slide are no newton metres: a heavier quill leaves the hinges' springs alone."""
    robot = named_robot("scara")
    slide = [joint.vadr for joint in robot.joints if joint.kind == "slide"]
    found = []
    for mass in (1.0, 100.0):
        loads = np.ones(robot.nv)
        loads[slide] = mass
        found.append(least_load(robot, loads))
    hinges = np.delete(np.arange(robot.nv), slide)
    np.testing.assert_array_equal(found[0][hinges], found[1][hinges])
    weak = least_load(robot, np.where(np.arange(robot.nv) == hinges[-1], 0.0, 5.0))
    assert weak[hinges[-1]] == 5.0 * LEAST_LOAD


def test_an_elastic_joint_resonates_where_the_formula_puts_it() -> None:
    """omega^2 = K (1/B + 1/M) after a step of the command, with hardly any feedback."""
    robot, K, B, M = robot_of(ROTOR), 400.0, 0.2, 0.1 + 2 * 0.5**2
    elastic = ElasticJoints(stiffness=K, damping=0.0)
    t = np.arange(2000) / 1000.0
    still = np.zeros((len(t), 1))
    commanded = Trajectory(t, np.where(t[:, None] > 0, 0.5, 0.0), still, still)
    control = TrackingControl(kp=1e-3, kd=1e-6, substeps=8)
    oracle = control.run(plant_of(robot, [elastic]), commanded, still)[0]
    assert oracle.encoders is not None
    wound = (oracle.encoders.q - oracle.motion.q)[:, 0]
    up = np.flatnonzero(np.diff(np.sign(wound - wound.mean())) > 0)
    found = 2 * np.pi * (len(up) - 1) / (t[up[-1]] - t[up[0]])
    expected = np.sqrt(K * (1 / B + 1 / M))
    np.testing.assert_allclose(found, expected, rtol=0.005)
    transmission = elastic.prepare(robot)
    assert transmission is not None
    np.testing.assert_allclose(transmission.resonance(np.array([M])), expected)


@pytest.mark.parametrize("integrator", ["euler", "implicitfast", "implicit", "rk4"])
def test_fine_steps_of_any_integrator_agree(integrator: str) -> None:
    robot = named_robot("scara")
    fine, finer = run(robot, [], substeps=40), run(robot, [], substeps=8, integrator=integrator)
    reach = np.ptp(fine.motion.q, axis=0).max()
    assert np.abs(finer.motion.q - fine.motion.q).max() < 1e-3 * reach


def test_springs_that_no_step_follows_are_refused() -> None:
    with pytest.raises(UnsupportedError, match="steps per control period"):
        run(named_robot("ur5"), [ElasticJoints(stiffness=1e12)], 0.01)


def test_a_fast_damper_takes_the_most_steps_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Up to a product of 1 of step and rate, at 150 per control period; at 250 it is refused."""
    robot, K = robot_of(ROTOR), 1e5
    transmission = ElasticJoints(stiffness=K).prepare(robot)
    assert transmission is not None
    damping = 1e3 / float(transmission.resonance(np.array([0.6]))[0]) ** 2  # s, of one period
    drives = [[ElasticJoints(stiffness=K, damping=share * damping)] for share in (150, 250)]
    most = run(robot, drives[0], 0.3)
    with pytest.raises(UnsupportedError, match=r"internal damper .* joint 'j'"):
        run(robot, drives[1], 0.01)
    monkeypatch.setattr(tracking_model, "MOST_SPRING_STEPS", 400)
    fine = run(robot, drives[0], 0.3)
    for ours, theirs in ((most.tau, fine.tau), (most.motion.q, fine.motion.q)):
        assert 0 < np.abs(ours - theirs).max() < 2e-3 * np.ptp(theirs)


@pytest.mark.parametrize("setting", [{"substeps": 0}, {"substeps": 2.0}, {"integrator": "rk5"}])
def test_impossible_steps_are_refused(setting: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        TrackingControl(**setting)


def test_elastic_joints_need_a_closed_loop() -> None:
    with pytest.raises(UnsupportedError, match="closed-loop"):
        _played(named_robot("ur5"), [ElasticJoints()])


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
def test_motors_without_inertia_have_no_gap(robot: RobotModel) -> None:
    transmission = ElasticJoints(windup=1e-3, gap=1e-4).prepare(robot)
    assert transmission is not None
    has_rotor = robot.joint_terms.armature[robot.torque_dofs] > 0
    np.testing.assert_array_equal(transmission.gap, np.where(has_rotor, 1e-4, 0.0))


@pytest.mark.parametrize("place", [0, 2, 5])
def test_a_rotor_of_next_to_no_inertia_is_none(place: int) -> None:
    robot = named_robot("ur5")
    armature = np.full(6, 0.1)
    armature[place] = 1e-9
    light = replace(robot, joint_terms=replace(robot.joint_terms, armature=armature))
    transmission = ElasticJoints(gap=1e-4).prepare(light)
    assert transmission is not None
    expected = np.where(np.arange(6) == place, 0.0, 0.1)
    np.testing.assert_array_equal(transmission.inertia, expected)
    np.testing.assert_array_equal(transmission.gap > 0, expected > 0)
    run(light, [ElasticJoints()], 0.02)
