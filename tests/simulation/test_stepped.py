"""Simulations with force laws: compiled or in Python, one motion."""

from dataclasses import replace

import numpy as np
import pytest

from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import Fourier
from sysid_bench.models.random_robot import RandomRobot, random_robot
from sysid_bench.simulation import compiled_steps as stepped
from sysid_bench.simulation.effects.presliding import Stribeck
from sysid_bench.simulation.plant import Plant, coupling_law, plant_of
from sysid_bench.simulation.tracking_control import TrackingControl
from sysid_bench.types import Array, Oracle
from tests.robots import named_robot, robot_of

ARMS = RandomRobot(bodies=(3, 6), roots=(1, 1), ball=0.0, free_root=0.0, no_gravity=0.0)
ROBOTS = [
    *[named_robot(name) for name in ("ur5", "tx40", "dvrk_psm")],
    *[robot_of(random_robot(seed, ARMS)) for seed in (1, 2)],
]


def plant_with_laws(robot_plant: Plant) -> Plant:
    """Friction of both kinds that the compiled loop knows."""
    nv = robot_plant.robot.nv
    B = 0.02 * np.random.default_rng(0).normal(size=(nv, nv))
    terms = replace(robot_plant.terms, viscous_coupling=B)
    own = tuple(law for law in robot_plant.laws if law.kind != "coupled")
    return Plant(robot_plant.robot, terms, own + coupling_law(terms))


def simulated(plant: Plant) -> Oracle:
    motion = Fourier(harmonics=3, period=1.0).design(
        design_problem(plant.robot, 1000.0), np.random.default_rng(3)
    )
    oracle, _ = TrackingControl().run(
        plant, motion, np.zeros((len(motion), len(plant.robot.torque_dofs)))
    )
    return oracle


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
def test_the_compiled_loop_is_the_loop(robot, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    if isinstance(stepped.steps_library(), str):
        pytest.skip(stepped.steps_library())
    plant = plant_with_laws(plant_of(robot, [Stribeck()]))
    quick = simulated(plant)
    monkeypatch.setattr(stepped, "steps_library", lambda: "not here")
    slow = simulated(plant)
    for ours, theirs in ((quick.tau, slow.tau), (quick.motion.q, slow.motion.q)):
        assert np.abs(ours - theirs).max() <= 1e-9 * np.abs(theirs).max()
    assert np.abs(quick.tau - simulated(plant_of(robot)).tau).max() > 1e-4 * np.abs(quick.tau).max()


def test_a_law_of_a_plug_in_runs_in_python() -> None:
    robot = named_robot("ur5")
    seen: list[int] = []

    def law(t: Array, q: Array, v: Array) -> Array:
        seen.append(1)
        return 0.1 * v

    strange = simulated(Plant(robot, robot.joint_terms, (law,)))
    known = replace(robot.joint_terms, viscous_coupling=0.1 * np.eye(6))
    ours = simulated(Plant(robot, robot.joint_terms, coupling_law(known)))
    assert len(seen) == TrackingControl().substeps * len(strange.tau)
    np.testing.assert_allclose(strange.tau, ours.tau, atol=1e-9 * np.abs(ours.tau).max())
