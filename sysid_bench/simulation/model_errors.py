"""Differences between the plant's robot and the identified model, which stays nominal.

`apply(robot, rng)` of an error returns the plant's robot from another one, whose arrays it leaves
alone: the same bodies, joints and link parameters (in the links' own frames) with other geometry.
Directions are drawn with `rng`. `sizes` names the settings that are zero without the error: the
robot itself is then returned.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.coupling.constraints import ChainClosure, PolynomialCoupling
from sysid_bench.models.coupling.equalities import equalities_of
from sysid_bench.models.offset_robot import with_body_offset, with_gravity, with_scaled_coupling
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.size import Size, check_size, joint_size, joint_sizes
from sysid_bench.spatial import matrix_of_quaternion, quaternion_of_rotation
from sysid_bench.types import Array, Controller, Oracle, Trajectory


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


def _random_direction(count: int, rng: np.random.Generator, dimension: int = 3) -> Array:
    """Return unit vectors (count, dimension), uniform on the sphere."""
    x = rng.normal(size=(count, dimension))
    return np.asarray(x / np.linalg.norm(x, axis=1, keepdims=True))


# Gravity is not where the model takes it to be.
@dataclass(frozen=True)
class BaseTilt:
    """Rotation of gravity by `angle` about a random axis across it: a base that is not level.

    Bases mounted by hand are off by 0.1 to 0.5 deg (to be verified); 0.3 deg turn 0.5 % of gravity
    sideways.
    """

    angle: float = field(default=0.00524, metadata={"unit": "rad"})
    sizes: ClassVar[tuple[str, ...]] = ("angle",)

    def __post_init__(self) -> None:
        check_size("angle of the model error 'base-tilt'", self.angle)

    def apply(self, robot: RobotModel, rng: np.random.Generator) -> RobotModel:
        """Return the robot under tilted gravity."""
        gravity = np.array(robot.mj.opt.gravity)
        along = _random_direction(1, rng, dimension=2)[0]
        if self.angle == 0.0 or not gravity.any():
            return robot
        # Two unit vectors (2, 3) at right angles to gravity and to each other.
        down = gravity / np.linalg.norm(gravity)
        first = np.cross(down, np.eye(3)[int(np.argmin(np.abs(down)))])
        first /= np.linalg.norm(first)
        axis = along @ np.array([first, np.cross(down, first)])
        R = matrix_of_quaternion(quaternion_of_rotation(self.angle * axis))
        return with_gravity(robot, R @ gravity)


# Joints move by another amount than their drives report.
@dataclass(frozen=True)
class GearRatio:
    """Relative error `error` of the gear ratio of each independent hinge and slide.

    A joint moves by (1 + error) of what the model computes from the drive, and the model computes
    (1 + error) of its torque, since both have the same power. Gear ratios are exact; ratios of
    data sheets, belts and lead screws err by 0.1 to 1 % (to be verified).
    """

    error: Size = field(default=0.005, metadata={"unit": "%"})
    sizes: ClassVar[tuple[str, ...]] = ("error",)

    def __post_init__(self) -> None:
        if not (np.abs(np.asarray(self.error, dtype=float)) < 0.5).all():
            raise UsageError(
                f"error = {self.error!r} of the model error 'gear-ratio': give less than 50 %."
            )

    @staticmethod
    def size_names(robot: RobotModel) -> tuple[str, ...]:
        """Return the names of the joints that a list of errors is for."""
        return robot.torque_rows

    def apply(self, robot: RobotModel, rng: np.random.Generator) -> RobotModel:
        """Return the robot with these ratios; nothing is drawn."""
        error = joint_size(self.error, self.size_names(robot), "error")
        if not error.any():
            return robot
        ratio = np.ones(robot.nv) if robot.drive_ratio is None else robot.drive_ratio.copy()
        scalar = np.isin(robot.torque_dofs, robot.scalar_dofs)
        ratio[robot.torque_dofs[scalar]] *= 1.0 + error[scalar]
        return replace(robot, drive_ratio=ratio)


# A clamped payload is displaced and turned on its flange.
@dataclass(frozen=True)
class PayloadMount:
    """Displacement by `position` and rotation by `rotation` of the payload at the tool frame, in
    random directions; none without a payload.

    The payload's parameters stay those of its own frame. Flanges with a centring collar and a pin
    leave about 0.1 mm, hand-clamped weights 1 mm and 0.5 deg (to be verified).
    """

    position: float = field(default=0.001, metadata={"unit": "m"})
    rotation: float = field(default=0.00873, metadata={"unit": "rad"})
    sizes: ClassVar[tuple[str, ...]] = ("position", "rotation")

    def __post_init__(self) -> None:
        check_size("position of the model error 'payload-mount'", self.position)
        check_size("rotation of the model error 'payload-mount'", self.rotation)

    def apply(self, robot: RobotModel, rng: np.random.Generator) -> RobotModel:
        """Return the robot with the payload displaced."""
        shift, turn = _random_direction(2, rng)
        if robot.payload_body is None or (self.position == 0.0 and self.rotation == 0.0):
            return robot
        by = self.position * shift, self.rotation * turn
        return with_body_offset(robot, {robot.payload_body: by})


# Dependent joints follow with another slope than the model has.
@dataclass(frozen=True)
class CouplingError:
    """Relative error `error` of the slope of each coupling between joints: mimics, and equalities
    of joints or fixed tendons. Closed chains have none; their links have kinematic errors.

    Belts and linkages of grippers err by 0.1 to 2 % (to be verified).
    """

    error: Size = field(default=0.005, metadata={"unit": "%"})
    sizes: ClassVar[tuple[str, ...]] = ("error",)

    @staticmethod
    def size_names(robot: RobotModel) -> tuple[str, ...]:
        """Return the names of the couplings that a list of errors is for."""
        return tuple(_couplings(robot))

    def apply(self, robot: RobotModel, rng: np.random.Generator) -> RobotModel:
        """Return the robot with these slopes; nothing is drawn."""
        couplings = _couplings(robot)
        error = joint_size(self.error, list(couplings), "error")
        if not error.any():
            return robot
        factors = dict(zip(couplings.values(), 1.0 + error, strict=True))
        return with_scaled_coupling(robot, factors)


def _couplings(robot: RobotModel) -> dict[str, int]:
    """Number of each joint or tendon equality of the robot's model, by its name."""
    if robot.coupling is None:
        return {}
    found = equalities_of(robot.mj)
    return {
        constraint.name: e
        for e, constraint in zip(found.ids, found.constraints, strict=True)
        if isinstance(constraint, PolynomialCoupling)
    }


@dataclass(frozen=True)
class Kinematics:
    """Displacement by `position` and rotation by `rotation` of every joint frame in its parent
    link, in random directions.

    The link parameters stay those of the model in the links' own frames, which move with their
    joints. Uncalibrated industrial arms have 0.5 to 2 mm and 0.05 to 0.2 deg per joint (Mooring,
    Roth and Driels 1991, ch. 1; to be verified for other robots). A free joint has no frame in a
    parent; links of a closed chain are displaced but not turned, since a planar loop with skew
    axes cannot move.
    """

    position: Size = field(default=0.001, metadata={"unit": "m"})
    rotation: Size = field(default=0.00175, metadata={"unit": "rad"})
    sizes: ClassVar[tuple[str, ...]] = ("position", "rotation")

    def __post_init__(self) -> None:
        check_size("position of the model error 'kinematics'", self.position)
        check_size("rotation of the model error 'kinematics'", self.rotation)

    def apply(self, robot: RobotModel, rng: np.random.Generator) -> RobotModel:
        """Return the robot with displaced joint frames."""
        names = [joint.name for joint in robot.joints]
        position, rotation = joint_sizes(self, names, "position", "rotation")
        shift, turn = _random_direction(len(names), rng), _random_direction(len(names), rng)
        chosen = {}
        for b, j, closed in _displaced_joints(robot):
            by = position[j] * shift[j], (0.0 if closed else rotation[j]) * turn[j]
            if any(part.any() for part in by):
                chosen[b] = by
        return with_body_offset(robot, chosen) if chosen else robot


def _displaced_joints(robot: RobotModel) -> list[tuple[int, int, bool]]:
    """(body, its first joint, True in a closed chain) of each link without a free joint."""
    # The degrees of freedom in closed chains.
    groups = () if robot.coupling is None else robot.coupling.groups
    closed = [g.dofs for g in groups if any(isinstance(c, ChainClosure) for c in g.constraints)]
    loops = np.concatenate([np.zeros(0, dtype=int), *closed])
    chosen = []
    for b in range(len(robot.body_names)):
        j = int(robot.mj.body_jntadr[b + 1])
        if j >= 0 and robot.joints[j].kind != "free":
            chosen.append((b, j, bool(np.isin(robot.joints[j].vadr, loops))))
    return chosen
