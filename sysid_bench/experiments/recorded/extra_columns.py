"""Regressor columns besides rigid bodies and joint terms: features of joints, terms of motors."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.experiments.recorded.process_log import ProcessedLog
from sysid_bench.experiments.tasks.task import joint_of
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.plugin_names import build, resolve_files
from sysid_bench.regressors.joint_features import (
    JointFeatures,
    MotorColumns,
    features_of,
    motor_names,
)
from sysid_bench.signals.log_description import NO_JOINT
from sysid_bench.types import Array, Trajectory
from sysid_bench.words import MOTOR

# Shares of a joint's range: backlash of cables is of this order.
_WIDTHS = [{"width": 0.003}, {"width": 0.01}, {"width": 0.03}]
# rad/s, m/s, of the smooth transition of Coulomb friction through zero velocity.
_SCALES = [{"scale": 0.01}, {"scale": 0.05}]

VARIANTS: Final[Mapping[str, Sequence[Mapping[str, float]]]] = {
    "play": _WIDTHS, "playq": _WIDTHS, "tanh": _SCALES,
}  # fmt: skip
"""Settings of features that are nonlinear in a parameter and are used with several values of it: a
weighted sum of plays (Prandtl-Ishlinskii) approximates hysteresis whose width is unknown."""

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
        acting = [name for name in chosen if row in self.rows_of(name)]
        names = [name for name in acting if name in self.joints.columns]
        values = self.joints.of_joint(row, motion, names)
        if self.motors is None or motors is None:
            return names, values
        coupled = [name for name in acting if name in self.motors.columns]
        if not coupled:
            return names, values
        return names + coupled, np.column_stack([values, self.motors.on_row(row, coupled, motors)])

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
        address, coordinates = _addresses(robot), self.motors.coordinates
        q, v, a = np.zeros((3, len(motion), len(coordinates)))
        for i, name in enumerate(coordinates):
            if name != NO_JOINT:
                qadr, dof = address[name]
                q[:, i], v[:, i], a[:, i] = motion.q[:, qadr], motion.v[:, dof], motion.a[:, dof]
        inverse = self.motors.inverse.T
        return Trajectory(motion.t, q @ inverse, v @ inverse, a @ inverse, "motors")


def _addresses(robot: RobotModel) -> dict[str, tuple[int, int]]:
    """Indices (in q, in v) of each degree of freedom's joint, by name."""
    return {dof: (joint.qadr, joint.vadr) for joint in robot.joints for dof in joint.dofs}


def _joint_features(words: Sequence[str], rows: Sequence[str]) -> list[tuple[str, str]]:
    """(joint, feature) of those words that name features of joints: "play", of all joints and
    without one, or "j2.poly"; not of motors: "motor.play"."""
    parts = ((joint_of(word, rows), word) for word in words if not word.startswith(f"{MOTOR}."))
    return [(joint, word.removeprefix(f"{joint}.") if joint else word) for joint, word in parts]


def columns_of_features(
    words: Sequence[str], rows: Sequence[str], folder: Path | None, several: bool = False
) -> tuple[str, ...]:
    """The columns of features of joints: of one joint where the word names it, else of all.
    `several`: with each setting of VARIANTS."""
    return tuple(
        f"{row}.{suffix}"
        for joint, name in _joint_features(words, rows)
        for row in ((joint,) if joint else rows)
        for feature in _features([name], folder, several)
        for suffix in feature.suffixes
    )


def extra_columns(
    robot: RobotModel,
    rows: Sequence[str],
    words: Sequence[str],
    training: Sequence[ProcessedLog],
    candidates: Sequence[str] = (),
) -> ExtraColumns:
    """The named features, of joints ("play") and of motors ("motor.play"), and those of which a
    selection chooses: joints' features with their default setting, candidates with several.

    Raises UsageError for unknown names, and for motors where a log states no transmission.
    """
    address = _addresses(robot)
    motions = [log.recording.motion for log in training]
    folder = plugin_folder(robot)
    named, more = (
        tuple(dict.fromkeys(name for _, name in _joint_features(some, rows)))
        for some in (words, candidates)
    )
    features = [*_features(named, folder, False), *_features(more, folder)]
    table = features_of(features, rows, [address[row] for row in rows], motions)
    every = (*words, *candidates)
    of_motors = [w.removeprefix(f"{MOTOR}.") for w in every if w.startswith(f"{MOTOR}.")]
    return ExtraColumns(table, _motors(of_motors, training) if of_motors else None)


def plugin_folder(robot: RobotModel) -> Path | None:
    """The folder that "file:mine.py:Spring" is relative to: that of the manifest, if it has a
    file."""
    file = robot.manifest.manifest_file
    return None if file is None else file.parent


def _motors(words: Sequence[str], training: Sequence[ProcessedLog]) -> MotorColumns:
    """The columns of motors, which all training logs have to drive alike."""
    first, motions = training[0].log.description, list(_motor_motions(words[0], training))
    unknown = [word for word in words if word in SUFFIX and word not in MOTOR_TERMS]
    if unknown:  # such as a spring
        advice = "Features, such as play, are also possible."
        raise unknown_name("term of motors", unknown[0], MOTOR_TERMS, advice)
    names = motor_names(len(first.joints))
    features = _features([word for word in words if word not in MOTOR_TERMS])
    table = features_of(features, names, [(k, k) for k in range(len(names))], motions)
    inverse = np.linalg.inv(np.asarray(first.transmission))
    # Rounding of the inverse would give a column to every joint that the motor does not move.
    inverse[np.abs(inverse) < 1e-12 * np.abs(inverse).max()] = 0.0
    plain = tuple(SUFFIX[word] for word in words if word in MOTOR_TERMS)
    return MotorColumns(inverse, first.joints, plain, table)


def _motor_motions(word: str, training: Sequence[ProcessedLog]) -> Iterator[Trajectory]:
    """Yield the motions of the motors; raise UsageError for a log without a transmission or with
    another one than the first."""
    first = training[0].log.description
    for log in training:
        if log.motors is None:
            raise UsageError(
                f"'motor.{word}' needs transmission = [[...], ...] (q = G q_motor) in "
                f"{first.source}: motors that move joints together."
            )
        yield log.motors
        other = log.log.description
        same = np.array_equal(np.asarray(other.transmission), np.asarray(first.transmission))
        if other.joints != first.joints or not same:
            raise UsageError(f"{other.source} has another transmission than {first.source}.")


def _features(names: Sequence[str], folder: Path | None = None, several: bool = True) -> list[Any]:
    """The feature plug-ins of these names; `several`: in several widths or scales."""
    return [
        build("term", resolve_files({"use": name, **settings}, folder))
        for name in names
        for settings in (VARIANTS.get(name, ({},)) if several else ({},))
    ]
