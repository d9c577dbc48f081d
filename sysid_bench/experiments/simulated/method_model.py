"""What methods that simulate are told beside their problem: functions that keep their secrets."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sysid_bench.errors import EstimationError, UnsupportedError
from sysid_bench.experiments.simulated.problem import term_torque
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.simulation.closed_loop import ClosedLoop
from sysid_bench.simulation.kinematics_only import kinematics_only
from sysid_bench.simulation.parametrised_plant import KnownModel, parametrised_plant
from sysid_bench.tasks.task import Task
from sysid_bench.types import (
    Array,
    Recording,
    Trajectory,
)


@dataclass(frozen=True, eq=False)
class KnownTorque:
    """What methods are told of the torque along any motion."""

    told: KnownModel
    places: tuple[int, ...]

    def __call__(self, motion: Trajectory) -> Array:
        told = self.told
        tau = newton_euler(told.robot.tree, told.known_links, motion)
        tau += term_torque(told.robot, told.known_terms, told.known_coupling, motion)
        return told.robot.reduced(motion.q, tau)[:, list(self.places)]


@dataclass(frozen=True, eq=False)
class SimulateModel:
    """The method's own model along the commanded motion, under the declared controller."""

    told: KnownModel
    raw: Recording

    def __call__(self, theta: Array) -> Recording:
        controller, commanded = self.raw.controller, self.raw.commanded
        if controller is None or commanded is None:
            raise UnsupportedError(
                "This recording declares no controller: nothing to simulate with."
            )
        theta, size = np.asarray(theta, dtype=float), len(self.told.parameters)
        if theta.shape != (size,):
            raise EstimationError(f"theta has the shape {theta.shape}; expected ({size},).")
        if not np.isfinite(theta).all():
            bad = self.told.parameters[int(np.flatnonzero(~np.isfinite(theta))[0])]
            raise EstimationError(f"theta cannot be simulated: {bad} is not finite.")
        plant = parametrised_plant(self.told, theta)
        oracle = ClosedLoop(rate=controller.rate).track(
            plant, controller, commanded, np.zeros((len(commanded), len(controller.kp)))
        )
        every = round(controller.rate / self.raw.rate)
        kept = slice(None, None, every)
        motion = oracle.motion
        return replace(
            self.raw,
            t=motion.t[kept],
            q=motion.q[kept],
            v=motion.v[kept],
            a=motion.a[kept],
            tau=oracle.tau[kept],
        )


def known_model(robot: RobotModel, task: Task) -> KnownModel:
    """What the task tells of the robot."""
    bare = kinematics_only(robot)
    coupling = task.known_coupling
    return KnownModel(
        bare, task.parameters, task.bodies, task.known_links, task.known_terms,
        np.zeros((robot.nv, robot.nv)) if coupling is None else coupling,
    )  # fmt: skip


def refuse_simulation(asked: Any) -> Any:
    """What a loop needs beside the sensors is not declared."""
    raise UnsupportedError(
        "A task with force/torque sensors declares no whole robot: nothing to simulate with."
    )
