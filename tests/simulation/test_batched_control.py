"""The closed loop of many plants at once is that of each alone, with every effect."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import EstimationError, SimulationError, UsageError
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import Fourier
from sysid_bench.simulation import batched_control, plant_batch
from sysid_bench.simulation.batched_control import BatchedControl
from sysid_bench.simulation.candidate import Candidate
from sysid_bench.simulation.effects.friction import CurvedFriction, LoadFriction, WarmUp
from sysid_bench.simulation.effects.periodic import Periodic, TorqueRipple
from sysid_bench.simulation.effects.presliding import Lugre, Stribeck
from sysid_bench.simulation.effects.springs import Cables, ElasticJoints, GravitySpring
from sysid_bench.simulation.plant import Plant, plant_of
from sysid_bench.simulation.plant_batch import lanes_library
from sysid_bench.simulation.tracking_control import TrackingControl
from sysid_bench.types import Oracle, Trajectory
from tests.robots import named_robot

EFFECTS: dict[str, list[Any]] = {
    "none": [],
    "stribeck": [Stribeck()],
    "lugre": [Lugre()],
    "friction": [CurvedFriction(), LoadFriction(), WarmUp()],
    "periodic": [Periodic(), TorqueRipple()],
    "springs": [GravitySpring(), Cables()],
    "elastic joints": [ElasticJoints()],
}
# The controller's period, the steps in it, the integrator.
CONTROLS = {
    "four steps": TrackingControl(),
    "one step": TrackingControl(substeps=1),
    "implicit": TrackingControl(integrator="implicitfast"),
}


def motion_of(plant: Plant, samples: int = 150) -> Trajectory:
    whole = Fourier(harmonics=3, period=1.0).design(
        design_problem(plant.robot, 1000.0), np.random.default_rng(3)
    )
    part = {name: getattr(whole, name)[:samples] for name in ("t", "q", "v", "a")}
    return replace(whole, **part)


def compiled() -> None:
    if isinstance(lanes_library(), str):
        pytest.skip(lanes_library())


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("effects", EFFECTS)
@pytest.mark.parametrize("name", ["ur5", "scara"])
def test_repeats_are_those_of_mujoco(name: str, effects: str, control: str) -> None:
    compiled()
    plant, loop = plant_of(named_robot(name), EFFECTS[effects]), CONTROLS[control]
    motion, controller = motion_of(plant), loop.controller(plant)
    encoders = 1e-5 * np.random.default_rng(0).normal(size=(3, *motion.q.shape))
    batch = BatchedControl(loop, plant, controller)
    assert batch.simulator == "lanes"
    for encoder, ours in zip(encoders, batch.follow([plant] * 3, motion, encoders), strict=True):
        theirs = loop.follow(plant, controller, motion, encoder)
        assert isinstance(ours, Oracle)
        assert ours.step == theirs.step
        # Friction that sticks is solved to 1e-8 by MuJoCo.
        exact, share = (1e-7, 1e-4) if plant.terms.coulomb.any() else (1e-12, 1e-9)
        for x, y in ((ours.motion.q, theirs.motion.q), (ours.measured.q, theirs.measured.q)):
            np.testing.assert_allclose(x, y, rtol=0, atol=exact)
        np.testing.assert_allclose(ours.tau, theirs.tau, atol=share * np.abs(theirs.tau).max())


def test_candidates_that_cannot_exist_have_their_error() -> None:
    robot = named_robot("ur5")
    plant = plant_of(robot)
    smooth, motion = Candidate(friction="smooth").plant, motion_of(plant)
    loop = Candidate().control(1000.0)
    controller = loop.controller(plant)
    negative = robot.phi.copy()
    negative[2, 0] = -1.0
    coulomb, huge = (replace(robot.joint_terms, coulomb=x * np.ones(6)) for x in (-1.0, 1e300))
    plants = [
        smooth(replace(plant, phi=robot.phi * 1.01)),
        smooth(replace(plant, phi=negative)),
        smooth(replace(plant, phi=robot.phi, terms=replace(coulomb, armature=coulomb.coulomb))),
        smooth(replace(plant, phi=robot.phi, terms=huge)),
        smooth(replace(plant, phi=robot.phi * 0.99)),
    ]
    batch = BatchedControl(loop, plant, controller)
    together = list(batch.follow(plants, motion, None))
    kinds = [Oracle, EstimationError, EstimationError, SimulationError, Oracle]
    for plant, outcome, kind in zip(plants, together, kinds, strict=True):
        assert isinstance(outcome, kind)
        if isinstance(outcome, Oracle):
            continue
        with pytest.raises(kind) as one:
            loop.follow(plant, controller, motion, np.zeros_like(motion.q))
        assert str(one.value) == str(outcome)


@pytest.mark.parametrize(
    ("robot", "control", "reason"),
    [("ur5", TrackingControl(integrator="rk4"), "integrator"), ("dvrk_psm", None, "coupled")],
)
def test_mujoco_simulates_what_is_not_covered(
    robot: str, control: TrackingControl | None, reason: str
) -> None:
    compiled()
    plant, loop = plant_of(named_robot(robot)), control or TrackingControl()
    motion, controller = motion_of(plant, 20), loop.controller(plant)
    batch = BatchedControl(loop, plant, controller)
    assert batch.simulator.startswith("mujoco")
    assert reason in batch.simulator
    (ours,) = batch.follow([plant], motion, None)
    still = np.zeros((20, len(controller.kp)))
    assert isinstance(ours, Oracle)
    np.testing.assert_array_equal(ours.tau, loop.follow(plant, controller, motion, still).tau)


@pytest.mark.parametrize("effects", EFFECTS)
def test_a_plant_may_move_by_either_simulator(effects: str) -> None:
    plant = plant_of(named_robot("scara"), EFFECTS[effects])
    motion = motion_of(plant)
    encoder = 1e-5 * np.random.default_rng(0).normal(size=motion.q.shape)
    theirs, controller = TrackingControl().run(plant, motion, encoder)
    ours, same = TrackingControl(simulator="lanes").run(plant, motion, encoder)
    assert controller is not None
    assert same is not None
    np.testing.assert_array_equal(same.kp, controller.kp)
    np.testing.assert_allclose(ours.motion.q, theirs.motion.q, rtol=0, atol=1e-7)


def test_a_plant_in_lanes_is_the_simulator_of_candidates() -> None:
    fine, plant = Candidate(2.5e-4, "euler"), TrackingControl(integrator="rk4")
    assert not fine.has_steps_of(plant, 2.5e-4)
    assert fine.has_steps_of(replace(plant, simulator="lanes"), 2.5e-4)
    with pytest.raises(UsageError, match="lanes"):
        TrackingControl(simulator="lane")


def test_mujoco_simulates_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batched_control, "uncovered", lambda *_: "nothing was compiled")
    plant, loop = plant_of(named_robot("ur5")), TrackingControl()
    motion, controller = motion_of(plant, 20), loop.controller(plant)
    batch = BatchedControl(loop, plant, controller)
    assert batch.simulator == "mujoco: nothing was compiled"
    (ours,) = batch.follow([plant], motion, None)
    assert isinstance(ours, Oracle)


@pytest.mark.parametrize("simulator", ["lanes", "mujoco"])
@pytest.mark.parametrize("effects", ["friction", "elastic joints"])
def test_motions_together_are_each_alone_bit_for_bit(effects: str, simulator: str) -> None:
    plant, loop = plant_of(named_robot("scara"), EFFECTS[effects]), TrackingControl()
    loop = replace(loop, simulator=simulator)
    one = motion_of(plant)
    # Another length, which lanes do not share
    for motions in ([one, replace(one, q=one.q[::-1].copy(), v=-one.v[::-1])],
                    [one, motion_of(plant, 100)]):  # fmt: skip
        errors = [1e-5 * np.random.default_rng(k).normal(size=x.q.shape)
                  for k, x in enumerate(motions)]  # fmt: skip
        together = loop.run_many(plant, motions, errors)
        for motion, error, (oracle, _) in zip(motions, errors, together, strict=True):
            alone, _ = loop.run(plant, motion, error)
            for name in ("q", "v", "a"):
                np.testing.assert_array_equal(
                    getattr(oracle.motion, name), getattr(alone.motion, name)
                )
            np.testing.assert_array_equal(oracle.tau, alone.tau)


def test_friction_that_is_not_solved_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """With one piece a step cannot follow a joint that starts or stops to stick. Of two plants the
    one without friction is not concerned."""
    compiled()
    plant, loop = plant_of(named_robot("scara")), TrackingControl(simulator="lanes")
    controller = loop.controller(plant)
    smooth = Candidate(friction="smooth").plant(plant)
    assert plant.terms.coulomb.any()
    monkeypatch.setattr(plant_batch, "MOST_PIECES", 1)
    with pytest.raises(SimulationError, match=r"not solved in \d+ steps.*mujoco"):
        loop.run(plant, motion_of(plant), np.zeros_like(motion_of(plant).q))
    loop.run(smooth, motion_of(plant), np.zeros_like(motion_of(plant).q))
    batch = BatchedControl(loop, plant, controller)
    still = replace(plant, terms=smooth.terms)
    stuck, free = batch.follow([plant, still], motion_of(plant), None)
    assert isinstance(stuck, SimulationError)
    assert isinstance(free, Oracle)
