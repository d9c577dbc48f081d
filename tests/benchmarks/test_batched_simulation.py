"""Simulation of many plants at once against MuJoCo's batched rollout, one thread each.

Both run 32 servos from the same starts along the same commands and record q, v and a; ours have
masses and friction of their own, MuJoCo's are copies of the first."""

from collections.abc import Callable
from dataclasses import replace
from statistics import median

import numpy as np
import pytest
from mujoco.batch import Batch

from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import Fourier
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.candidate import Candidate
from sysid_bench.simulation.plant import plant_of
from sysid_bench.simulation.plant_batch import lanes_library
from sysid_bench.simulation.tracking_control import TrackingControl, commands
from sysid_bench.simulation.tracking_model import tracking_model
from tests.robots import named_robot, urdf_files, urdf_robot
from tests.simulation.test_plant_batch import batch_of, variants

Compare = Callable[..., dict[str, float]]
Line = Callable[..., None]

PLANTS = 32
SECONDS = 2.0


def arms() -> dict[str, RobotModel]:
    """Twenty arms: fixed bases with five to nine hinges and slides, one file per folder first."""
    found: dict[str, RobotModel] = {name: named_robot(name) for name in ("tx40", "scara", "so100")}
    for file in urdf_files():
        robot = urdf_robot(file).without_coupling
        if 5 <= robot.nv <= 9 and len(robot.scalar_dofs) == robot.nv:
            found.setdefault(file, robot)
    return dict(list(found.items())[:20])


def legged() -> dict[str, RobotModel]:
    """Two humanoids and a quadruped on free bases."""
    words = ("talos_data/robots/talos_reduced.urdf", "romeo_description/urdf/romeo.urdf")
    files = {word: urdf_robot(word, free_base=True) for word in words}
    return {**files, "solo12": named_robot("solo12")}


def subject(robot: RobotModel, friction: str) -> tuple[Callable[[], None], Callable[[], None]]:
    """Our simulation and MuJoCo's rollout; friction "sticking", "smooth" or "none"."""
    coulomb = np.zeros(robot.nv)
    coulomb[robot.scalar_dofs] = 0.0 if friction == "none" else 0.5
    plants = variants(robot, PLANTS, coulomb=coulomb)
    batch = batch_of(plants, "implicitfast", SECONDS)
    if friction == "smooth":  # MuJoCo has none of it: its rollout is without
        plants = [Candidate(friction="smooth").plant(plant) for plant in plants]
        batch = replace(batch, plants=plants)
        batch.mj.dof_frictionloss[:] = 0.0
    rollouts = Batch(batch.mj, PLANTS, nthread=1)
    control = np.repeat(batch.control[None], PLANTS, 0)

    def ours() -> None:
        """All of a call: packing, steps and signals."""
        assert np.isfinite(batch.run().q).all()

    def mujoco() -> None:
        rollouts.bind("qpos")[:], rollouts.bind("qvel")[:] = batch.q, batch.v
        rollouts.rollout(len(batch.t), control, record=["qpos", "qvel", "qacc"])

    return ours, mujoco


CASES = {
    "20 arms, smooth friction": (arms, "smooth", 15.0),
    "20 arms, friction that sticks": (arms, "sticking", 6.0),
    "two humanoids and a quadruped": (legged, "none", 6.0),
}


@pytest.mark.parametrize("case", CASES)
def test_batched_simulation(case: str, compare: Compare, line: Line) -> None:
    if isinstance(lanes_library(), str):
        pytest.skip(lanes_library())
    robots, friction, aim = CASES[case]
    functions = {}
    for name, robot in robots().items():
        functions[f"ours {name}"], functions[f"mujoco {name}"] = subject(robot, friction)
    seconds = compare(functions, 4)
    names = [name.removeprefix("ours ") for name in functions if name.startswith("ours ")]
    found = {name: seconds[f"mujoco {name}"] / seconds[f"ours {name}"] for name in names}
    print(case, {name: round(x, 1) for name, x in found.items()})
    line(f"MuJoCo's batched rollout / batched simulation, {case}, median", median(found.values()),
         aim, aim, True)  # fmt: skip
    line(f"the same, least of them ({min(found, key=lambda name: found[name])})",
         min(found.values()), 0.5 * aim, aim, True)  # fmt: skip


@pytest.mark.parametrize("count", [1, 64])
def test_closed_loops(compare: Compare, line: Line, count: int) -> None:
    """An arm with friction that sticks, 2 s at 1 kHz with the default four steps a period, along
    several motions; beside it the bare rollout of the same steps, one for each motion."""
    if isinstance(lanes_library(), str):
        pytest.skip(lanes_library())
    robot = named_robot("xarm7")
    plant, loop = plant_of(robot), TrackingControl(simulator="lanes")
    controller = loop.controller(plant)
    designs = [Fourier(period=SECONDS).design(design_problem(robot, 1000.0),
                                              np.random.default_rng(k))
               for k in range(min(count, 8))]  # fmt: skip
    motions = [designs[k % len(designs)] for k in range(count)]
    silence = [np.zeros_like(motion.v) for motion in motions]
    mj = tracking_model(plant, controller)
    each = round((motions[0].t[1] - motions[0].t[0]) / mj.opt.timestep)
    control = np.array([commands(controller, x, e, robot).repeat(each, axis=0)
                        for x, e in zip(motions, silence, strict=True)])  # fmt: skip
    rollouts = Batch(mj, count, nthread=1)

    def mujoco() -> None:
        for name in ("q", "v"):
            rollouts.bind(f"q{'pos' if name == 'q' else 'vel'}")[:] = [
                getattr(motion, name)[0] for motion in motions
            ]
        rollouts.rollout(control.shape[1], control, record=["qpos", "qvel", "qacc"])

    functions = {
        "lanes": lambda: loop.run_many(plant, motions, silence),
        "loop in MuJoCo": lambda: replace(loop, simulator="mujoco").run_many(
            plant, motions[:2], silence[:2]
        ),
        "rollout": mujoco,
    }
    seconds = compare(functions, 3)
    of_mujoco = seconds["loop in MuJoCo"] * count / min(count, 2)
    line(f"closed loop in lanes / bare rollout of its steps, {count} motions",
         seconds["lanes"] / seconds["rollout"], 1.5 if count == 1 else 0.5)  # fmt: skip
    line(f"the same / the loop with MuJoCo, {count} motions", seconds["lanes"] / of_mujoco,
         1.0 if count == 1 else 0.3)  # fmt: skip
