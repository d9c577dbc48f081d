"""Columns beside rigid bodies and joint terms: features of joints, and what acts in motors."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.experiments.recorded.preprocess import ProcessedLog
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.naming import build
from sysid_bench.regressors.friction_features import JointFeatures, features_of
from sysid_bench.regressors.transmission import MOTOR, MotorColumns, motor_names
from sysid_bench.signals.log_description import NO_JOINT
from sysid_bench.types import Array, Trajectory

WIDTHS: Final = (0.003, 0.01, 0.03)
"""Shares of a joint's reach that play may have: backlash of cables is of this order."""

SCALES: Final = (0.01, 0.05)
"""rad/s, m/s, below which Coulomb friction may be smooth."""

MOTOR_TERMS: Final = ("viscous", "coulomb", "armature")
"""Joint terms that motors may have, as "motor.armature"; what else a motor may have is a feature,
as "motor.play"."""


@dataclass(frozen=True, eq=False)
class ExtraColumns:
    """All columns that may be asked for by name."""

    joints: JointFeatures
    motors: MotorColumns | None = None

    @property
    def motor_terms(self) -> tuple[str, ...]:
        """The terms of motors among them."""
        return () if self.motors is None else self.motors.plain

    def rows_of(self, name: str) -> tuple[str, ...]:
        """The joints on whose rows a column stands."""
        if self.motors is not None and name in self.motors.columns:
            return self.motors.rows_of(name)
        return (name.rpartition(".")[0],)

    def on_row(
        self, row: str, chosen: Sequence[str], motion: Trajectory, motors: Trajectory | None
    ) -> tuple[list[str], Array]:
        """Those of the chosen names that stand on a joint's row, and their values (N, k)."""
        own = [name for name in chosen if name in self.joints.columns]
        own = [name for name in own if name.rpartition(".")[0] == row]
        parts = [self.joints.of_joint(row, motion, own) if own else np.zeros((len(motion), 0))]
        if self.motors is not None and motors is not None:
            felt = [name for name in chosen if name in self.motors.columns]
            felt = [name for name in felt if row in self.motors.rows_of(name)]
            if felt:
                own = own + felt
                parts.append(self.motors.on_row(row, felt, motors))
        return own, np.column_stack(parts)

    def on_rows(
        self, robot: RobotModel, rows: Sequence[str], chosen: Sequence[str], motion: Trajectory
    ) -> Array:
        """Columns (N, rows, k) of the chosen names along any motion of the robot."""
        motors = self.motors_of(robot, motion)
        out = np.zeros((len(motion), len(rows), len(chosen)))
        for i, row in enumerate(rows):
            own, values = self.on_row(row, chosen, motion, motors)
            out[:, i, [list(chosen).index(name) for name in own]] = values
        return out

    def motors_of(self, robot: RobotModel, motion: Trajectory) -> Trajectory | None:
        """Where the motors are along any motion of the robot; coordinates that are no joint of it
        stand still."""
        if self.motors is None:
            return None
        places = {dof: (joint.qadr, joint.vadr) for joint in robot.joints for dof in joint.dofs}
        q, v, a = (np.zeros((len(motion), len(self.motors.coordinates))) for _ in range(3))
        for i, name in enumerate(self.motors.coordinates):
            if name != NO_JOINT:
                at, dof = places[name]
                q[:, i], v[:, i], a[:, i] = motion.q[:, at], motion.v[:, dof], motion.a[:, dof]
        inverse = self.motors.inverse.T
        return Trajectory(motion.t, q @ inverse, v @ inverse, a @ inverse, "motors")


def is_motor(word: str) -> bool:
    """Whether a word asks for something of motors: "motor.play"."""
    return word.startswith(f"{MOTOR}.")


def extra_columns(
    robot: RobotModel, rows: Sequence[str], words: Sequence[str], training: Sequence[ProcessedLog]
) -> ExtraColumns:
    """The features that words name, of joints ("play") and of motors ("motor.play").

    Raises UsageError for unknown names, and for motors where no transmission is told.
    """
    of_joints = [word for word in words if not is_motor(word)]
    places = {dof: (joint.qadr, joint.vadr) for joint in robot.joints for dof in joint.dofs}
    motions = [log.recording.motion for log in training]
    table = features_of(_built(of_joints), rows, [places[row] for row in rows], motions)
    of_motors = [word.removeprefix(f"{MOTOR}.") for word in words if is_motor(word)]
    return ExtraColumns(table, _motors(of_motors, training) if of_motors else None)


def _motors(words: Sequence[str], training: Sequence[ProcessedLog]) -> MotorColumns:
    first = training[0].log.description
    if any(log.motors is None for log in training):
        raise UsageError(
            f"{first.source} tells of no motors that move joints together: 'motor."
            f"{words[0]}' needs transmission = [[...], ...] (q = G q_motor)."
        )
    assert first.transmission is not None
    for log in training[1:]:
        other = log.log.description
        if other.joints != first.joints or not np.array_equal(
            np.asarray(other.transmission), first.transmission
        ):
            raise UsageError(f"{other.source} has another transmission than {first.source}.")
    plain = [SUFFIX[word] for word in words if word in MOTOR_TERMS]
    wrong = [word for word in words if word in SUFFIX and word not in MOTOR_TERMS]
    if wrong:
        raise unknown_name("term of motors", wrong[0], MOTOR_TERMS, "Features, as play, go too.")
    names = motor_names(len(first.joints))
    motions = [log.motors for log in training if log.motors is not None]
    rest = _built([word for word in words if word not in MOTOR_TERMS])
    table = features_of(rest, names, [(k, k) for k in range(len(names))], motions)
    inverse = np.linalg.inv(first.transmission)
    inverse[np.abs(inverse) < 1e-12 * np.abs(inverse).max()] = 0.0
    return MotorColumns(inverse, first.joints, tuple(plain), table)


def _built(names: Sequence[str]) -> list[Any]:
    """The features of these names, in several widths where they have one."""
    found: list[Any] = []
    for name in names:
        if name in ("play", "playq"):
            found += [build("term", {"use": name, "width": width}) for width in WIDTHS]
        elif name == "tanh":
            found += [build("term", {"use": name, "scale": scale}) for scale in SCALES]
        else:
            found.append(build("term", name))
    return found
