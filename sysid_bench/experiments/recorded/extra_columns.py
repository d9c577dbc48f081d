"""Regressor columns besides rigid bodies and joint terms: features of joints, terms of motors."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.experiments.recorded.preprocess import ProcessedLog
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.naming import build
from sysid_bench.regressors.joint_features import JointFeatures, features_of
from sysid_bench.regressors.motor_terms import MOTOR, MotorColumns, motor_names
from sysid_bench.signals.log_description import NO_JOINT
from sysid_bench.types import Array, Trajectory

WIDTHS: Final = (0.003, 0.01, 0.03)
"""Widths of play as shares of a joint's range: backlash of cables is of this order."""

SCALES: Final = (0.01, 0.05)
"""rad/s, m/s, of the smooth transition of Coulomb friction through zero velocity."""

MOTOR_TERMS: Final = ("viscous", "coulomb", "armature")
"""Joint terms that motors may have ("motor.armature"); any other name is a feature ("motor.play").
"""


@dataclass(frozen=True, eq=False)
class ExtraColumns:
    """The columns of features and motors, by name."""

    joints: JointFeatures
    motors: MotorColumns | None = None

    @property
    def motor_terms(self) -> tuple[str, ...]:
        """The terms of motors among them."""
        return () if self.motors is None else self.motors.plain

    def rows_of(self, name: str) -> tuple[str, ...]:
        """The joints in whose rows a column is not zero."""
        if self.motors is not None and name in self.motors.columns:
            return self.motors.rows_of(name)
        return (name.rpartition(".")[0],)

    def on_row(
        self, row: str, chosen: Sequence[str], motion: Trajectory, motors: Trajectory | None
    ) -> tuple[list[str], Array]:
        """Those of the chosen names that act in a joint's row, and their values (N, k)."""
        names = [name for name in chosen if name in self.joints.columns]
        names = [name for name in names if name.rpartition(".")[0] == row]
        parts = [self.joints.of_joint(row, motion, names) if names else np.zeros((len(motion), 0))]
        if self.motors is not None and motors is not None:
            coupled = [name for name in chosen if name in self.motors.columns]
            coupled = [name for name in coupled if row in self.motors.rows_of(name)]
            if coupled:
                names = names + coupled
                parts.append(self.motors.on_row(row, coupled, motors))
        return names, np.column_stack(parts)

    def on_rows(
        self, robot: RobotModel, rows: Sequence[str], chosen: Sequence[str], motion: Trajectory
    ) -> Array:
        """Columns (N, rows, k) of the chosen names along any motion of the robot."""
        motors = self.motors_of(robot, motion)
        out = np.zeros((len(motion), len(rows), len(chosen)))
        for i, row in enumerate(rows):
            names, values = self.on_row(row, chosen, motion, motors)
            out[:, i, [list(chosen).index(name) for name in names]] = values
        return out

    def motors_of(self, robot: RobotModel, motion: Trajectory) -> Trajectory | None:
        """Motion of the motors, q_m = G^-1 q, along any motion of the robot; coordinates without a
        joint stand still. None without a transmission."""
        if self.motors is None:
            return None
        address = {dof: (joint.qadr, joint.vadr) for joint in robot.joints for dof in joint.dofs}
        q, v, a = (np.zeros((len(motion), len(self.motors.coordinates))) for _ in range(3))
        for i, name in enumerate(self.motors.coordinates):
            if name != NO_JOINT:
                qadr, dof = address[name]
                q[:, i], v[:, i], a[:, i] = motion.q[:, qadr], motion.v[:, dof], motion.a[:, dof]
        inverse = self.motors.inverse.T
        return Trajectory(motion.t, q @ inverse, v @ inverse, a @ inverse, "motors")


def is_motor(word: str) -> bool:
    """True for a term or feature of motors: "motor.play"."""
    return word.startswith(f"{MOTOR}.")


def extra_columns(
    robot: RobotModel, rows: Sequence[str], words: Sequence[str], training: Sequence[ProcessedLog]
) -> ExtraColumns:
    """The named features, of joints ("play") and of motors ("motor.play").

    Raises UsageError for unknown names, and for motors where a log states no transmission.
    """
    of_joints = [word for word in words if not is_motor(word)]
    address = {dof: (joint.qadr, joint.vadr) for joint in robot.joints for dof in joint.dofs}
    motions = [log.recording.motion for log in training]
    table = features_of(_features(of_joints), rows, [address[row] for row in rows], motions)
    of_motors = [word.removeprefix(f"{MOTOR}.") for word in words if is_motor(word)]
    return ExtraColumns(table, _motors(of_motors, training) if of_motors else None)


def _motors(words: Sequence[str], training: Sequence[ProcessedLog]) -> MotorColumns:
    first = training[0].log.description
    if any(log.motors is None for log in training):
        raise UsageError(
            f"'motor.{words[0]}' needs transmission = [[...], ...] (q = G q_motor) in "
            f"{first.source}: motors that move joints together."
        )
    assert first.transmission is not None
    for log in training[1:]:
        other = log.log.description
        if other.joints != first.joints or not np.array_equal(
            np.asarray(other.transmission), first.transmission
        ):
            raise UsageError(f"{other.source} has another transmission than {first.source}.")
    plain = [SUFFIX[word] for word in words if word in MOTOR_TERMS]
    unknown = [word for word in words if word in SUFFIX and word not in MOTOR_TERMS]
    if unknown:
        advice = "Features, such as play, are also possible."
        raise unknown_name("term of motors", unknown[0], MOTOR_TERMS, advice)
    names = motor_names(len(first.joints))
    motions = [log.motors for log in training if log.motors is not None]
    features = _features([word for word in words if word not in MOTOR_TERMS])
    table = features_of(features, names, [(k, k) for k in range(len(names))], motions)
    inverse = np.linalg.inv(first.transmission)
    # Rounding of the inverse would give a column to every joint that the motor does not move.
    inverse[np.abs(inverse) < 1e-12 * np.abs(inverse).max()] = 0.0
    return MotorColumns(inverse, first.joints, tuple(plain), table)


def _features(names: Sequence[str]) -> list[Any]:
    """The feature plug-ins of these names, in several widths or scales where they have one."""
    features: list[Any] = []
    for name in names:
        if name in ("play", "playq"):
            features += [build("term", {"use": name, "width": width}) for width in WIDTHS]
        elif name == "tanh":
            features += [build("term", {"use": name, "scale": scale}) for scale in SCALES]
        else:
            features.append(build("term", name))
    return features
