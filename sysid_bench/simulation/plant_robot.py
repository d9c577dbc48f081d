"""Robot of the plant where it differs from the identified model's, and the change of coordinates
between the two."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, Controller, Oracle, Trajectory


class _ModelDefect(Protocol):
    """Difference between the plant and the identified model, which stays nominal.

    `apply(robot, rng)` returns the plant's robot from another one, whose arrays it leaves alone:
    the same bodies, joints and link parameters (in the links' own frames) with other geometry.
    Directions are drawn with `rng`. `sizes` names the settings that are zero without the error: the
    robot itself is then returned.
    """

    sizes: ClassVar[tuple[str, ...]]

    def apply(self, robot: RobotModel, rng: np.random.Generator) -> RobotModel:
        """Return the robot with this error."""
        ...


@dataclass(frozen=True, eq=False)
class PlantCoordinates:
    """Signals of a plant as its drives report them to the identified model, and the reverse.

    An independent hinge or slide at q of the model is at q0 + s (q - q0) in the plant, with the
    reference q0 and s = `plant.drive_ratio`; tau_model = s tau_plant (equal power). Dependent
    joints follow the coupling of either side.
    """

    model: RobotModel
    plant: RobotModel

    @property
    def _differ(self) -> bool:
        """True where signals change between the two sides."""
        coupled = self.plant.coupling is not self.model.coupling
        return coupled or self.plant.drive_ratio is not None

    def to_plant(self, motion: Trajectory) -> Trajectory:
        """Return a motion of the model's joints as the plant carries it out."""
        if not self._differ:
            return motion
        return self.plant.completed(_scaled(self.plant, motion, _ratios(self.plant)))

    def to_model(self, oracle: Oracle) -> Oracle:
        """Return the motion and torque of the plant as the model counts them."""
        if not self._differ:
            return oracle
        ratio = _ratios(self.plant)
        motion = self.model.completed(_scaled(self.model, oracle.motion, 1.0 / ratio))
        return replace(oracle, motion=motion, tau=self.torque_to_model(oracle.tau))

    def torque_to_model(self, tau: Array) -> Array:
        """Return torques (N, n) of the plant's independent joints as the model counts them."""
        if self.plant.drive_ratio is None:
            return tau
        return np.asarray(tau * self.plant.drive_ratio[self.plant.torque_dofs])

    def error_to_plant(self, error: Array) -> Array:
        """Return encoder errors (N, n) in the plant's coordinates."""
        if self.plant.drive_ratio is None:
            return error
        return np.asarray(error * self.plant.drive_ratio[self.plant.torque_dofs])


def with_model_errors(
    robot: RobotModel, errors: Sequence[_ModelDefect], rngs: Sequence[np.random.Generator]
) -> RobotModel:
    """Return the plant's robot from the model's, one error after the other."""
    for error, rng in zip(errors, rngs, strict=True):
        robot = error.apply(robot, rng)
    return robot


def plant_controller(controller: Controller, robot: RobotModel) -> Controller:
    """Return a controller that is declared for the model's joints in those of the plant: its gains
    over the squared drive ratio."""
    if robot.drive_ratio is None:
        return controller
    square = robot.drive_ratio[robot.torque_dofs] ** 2
    return replace(controller, kp=controller.kp / square, kd=controller.kd / square)


def _ratios(robot: RobotModel) -> Array:
    return np.ones(robot.nv) if robot.drive_ratio is None else robot.drive_ratio


def _scaled(robot: RobotModel, motion: Trajectory, ratio: Array) -> Trajectory:
    """The motion with every hinge and slide scaled about its reference by `ratio` (nv,)."""
    q = motion.q.copy()
    for joint in robot.joints:
        if joint.kind in ("hinge", "slide"):
            reference = float(robot.mj.qpos0[joint.qadr])
            moved = ratio[joint.vadr] * (q[:, joint.qadr] - reference)
            q[:, joint.qadr] = reference + moved
    return replace(motion, q=q, v=ratio * motion.v, a=ratio * motion.a)
