"""Simulation callables for methods, without access to the ground truth."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from sysid_bench.errors import EstimationError, UnsupportedError
from sysid_bench.experiments.processed_rows import sampled_motion
from sysid_bench.experiments.simulated.problem import term_torque
from sysid_bench.experiments.tasks.task import Task
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.simulation.candidate import Candidate, KnownModel, kinematics_of, plant_of_model
from sysid_bench.types import Array, Controller, Recording, Trajectory


@dataclass(frozen=True, eq=False)
class KnownTorque:
    """Torque (N, rows) of the known parts of a task along any motion."""

    model: KnownModel
    rows: tuple[int, ...]

    @cached_property
    def _parts(self) -> tuple[bool, dict[str, Array], Array | None]:
        """Parts of links, joint terms and viscous coupling other than zero: filters ask at every
        step."""
        model = self.model
        terms = {name: values for name, values in model.known_terms.items() if values.any()}
        coupling = model.known_coupling if model.known_coupling.any() else None
        return bool(model.known_links.any()), terms, coupling

    def __call__(self, motion: Trajectory) -> Array:
        model = self.model
        links, terms, coupling = self._parts
        if not links and not terms and coupling is None:
            return np.zeros((len(motion.a), len(self.rows)))
        tau = np.zeros_like(motion.a)
        if links:
            tau += newton_euler(model.robot.tree, model.known_links, motion)
        tau += term_torque(model.robot, terms, coupling, motion)
        return model.robot.reduced(motion.q, tau)[:, list(self.rows)]


@dataclass(frozen=True, eq=False)
class SimulatedModel:
    """The method's own model along the commanded motion, under the declared controller, or under
    one with other gains.

    Raises UnsupportedError without a controller, EstimationError for `theta` (p,) that cannot be
    simulated.
    """

    model: KnownModel
    raw: Recording
    candidate: Candidate

    def __call__(self, theta: Array, controller: Controller | None = None) -> Recording:
        controller, commanded = controller or self.raw.controller, self.raw.commanded
        if controller is None or commanded is None:
            raise UnsupportedError(
                "This recording declares no controller: nothing to simulate with."
            )
        theta = np.asarray(theta, dtype=float)
        names = self.model.parameters
        if theta.shape != (len(names),):
            raise EstimationError(f"theta has the shape {theta.shape}; expected ({len(names)},).")
        if not np.isfinite(theta).all():
            bad = names[int(np.flatnonzero(~np.isfinite(theta))[0])]
            raise EstimationError(f"theta cannot be simulated: {bad} is not finite.")
        plant = self.candidate.plant(plant_of_model(self.model, theta))
        oracle = self.candidate.control(controller.rate).follow(
            plant, controller, commanded, np.zeros((len(commanded), len(controller.kp)))
        )
        # The loop runs at the rate of the controller; its signals are sampled like the measured.
        decimation = round(controller.rate / self.raw.rate)
        motion, tau = sampled_motion(oracle.motion, decimation), oracle.tau[::decimation]
        return replace(self.raw, t=motion.t, q=motion.q, v=motion.v, a=motion.a, tau=tau)


def known_model(robot: RobotModel, task: Task) -> KnownModel:
    """The robot without its unknown parameters: kinematics, and the parts that the task knows."""
    coupling = task.known_coupling
    return KnownModel(
        kinematics_of(robot), task.parameters, task.bodies, task.known_links, task.known_terms,
        np.zeros((robot.nv, robot.nv)) if coupling is None else coupling,
    )  # fmt: skip


def check_simulation(*_: Any) -> Any:
    """Raise UnsupportedError: a closed loop needs more of the robot than the sensors see."""
    raise UnsupportedError(
        "A task with force/torque sensors declares no whole robot: nothing to simulate with."
    )
