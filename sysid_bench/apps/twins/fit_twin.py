"""Twin of a robot from recordings: effects that cross-validation keeps, and coloured noise."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from sysid_bench.apps.twins.body_torque import torque_of_bodies
from sysid_bench.apps.twins.coloured_noise import NOISE, coloured_noise
from sysid_bench.apps.twins.effect_columns import JointColumns, group_names
from sysid_bench.apps.twins.effect_selection import JointFit, JointLimits, select_effects
from sysid_bench.apps.twins.joint_signals import JointSignals, joint_signals, processed_recording
from sysid_bench.apps.twins.replay import Replay, replay_rate
from sysid_bench.apps.twins.twin_plant import OF_GRAVITY, plant_keys, with_friction
from sysid_bench.errors import UsageError
from sysid_bench.experiments.recorded.process_log import LogProcessing, ProcessedLog
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.effects.friction import rate_limit
from sysid_bench.simulation.motor_load import gravity_rms
from sysid_bench.types import Recording

SAMPLES: Final = 6000
"""Samples of a recording, about, that effects are fitted to: signals lie below 10 Hz."""

SHORTEST: Final = 3.0
"""s: all training recordings together, whose blocks of time decide on effects."""


@dataclass(frozen=True, eq=False)
class Twin:
    """A robot with its fitted friction, the keys of its plant file, and the fit of each joint."""

    robot: RobotModel
    plant: Mapping[str, Any]
    fits: Mapping[str, JointFit]
    rate: float  # Hz, of replays
    sizes: tuple[float, ...]  # RMS of the measured torque of each joint

    @property
    def left_out_residual(self) -> float:
        """RMS over joints of the residual on left-out blocks over the RMS torque."""
        parts = [fit.after / size for fit, size in zip(self.fits.values(), self.sizes, strict=True)]
        return float(np.sqrt(np.mean(np.square(parts))))

    @property
    def replay_plant(self) -> Replay:
        """The plant of replays."""
        return Replay(self.robot, self.plant)

    @property
    def noise_free_plant(self) -> Replay:
        """The plant of replays without coloured noise: what is repeated when a motion is."""
        sensors = [one for one in self.plant["sensors"] if one["use"] != NOISE]
        return Replay(self.robot, {**self.plant, "sensors": sensors})


def fit_twin(
    robot: RobotModel,
    logs: Sequence[ProcessedLog],
    preprocessing: LogProcessing,
    groups: Collection[str] | None = None,
) -> Twin:
    """Return the twin of `robot`, an identified model, from its training logs.

    `groups`: the effects that may be kept (None: all); without any it is the null twin, the robot
    with noise of the same residual. Raises UsageError for recordings that are too short.
    """
    recordings = [processed_recording(log, preprocessing) for log in logs]
    filter = preprocessing.processing.filter
    _check_length(recordings)
    signals = tuple(joint_signals(robot, one, filter) for one in recordings)
    step = max(1, round(sum(len(one.t) for one in signals) / SAMPLES))
    fits = {
        name: select_effects(
            JointColumns(signals, j, step),
            _allowed(robot, name, groups),
            _limits(robot, signals, j),
        )
        for j, name in enumerate(robot.torque_rows)
    }
    own, rate = with_friction(robot, fits), replay_rate(signals[0].rate)
    residuals = [fit.residual for fit in fits.values()]
    noise = coloured_noise(residuals, _interval(signals, step), filter, rate)
    return Twin(own, plant_keys(own, fits, noise), fits, rate, _sizes(signals))


def without_effects(
    found: Twin, logs: Sequence[ProcessedLog], preprocessing: LogProcessing
) -> list[ProcessedLog]:
    """Return the training logs of a twin without the torque of its effects, so that bodies can be
    fitted to the rest."""
    filter = preprocessing.processing.filter
    left = []
    for log in logs:
        signals = joint_signals(found.robot, log.recording, filter)
        tau = torque_of_bodies(found.fits, signals)
        left.append(replace(log, recording=replace(log.recording, tau=tau)))
    return left


def _check_length(recordings: Sequence[Recording]) -> None:
    """Raise UsageError for recordings that are too short for a twin."""
    seconds = sum(float(np.ptp(one.t)) for one in recordings)
    if seconds < SHORTEST:
        raise UsageError(
            f"The recordings to fit last {seconds:.2g} s together; a twin needs {SHORTEST:g} s at "
            "least, so that its effects can be judged on parts that are left out: give a longer "
            "--log, or more of them."
        )


def _limits(robot: RobotModel, signals: Sequence[JointSignals], j: int) -> JointLimits:
    """Bounds of the effects of measured joint j."""
    fastest = max(float(np.abs(one.v[:, j]).max()) for one in signals)
    limit = float(rate_limit(robot)[robot.torque_dofs[j]])
    return JointLimits(
        max(limit, fastest), max(float(np.abs(one.tau[:, j]).max()) for one in signals)
    )


def _sizes(signals: Sequence[JointSignals]) -> tuple[float, ...]:
    tau = np.concatenate([one.tau for one in signals])
    rms = np.sqrt(np.mean(tau**2, axis=0))
    return tuple(np.where(rms > 0.0, rms, 1.0).tolist())


def _interval(signals: Sequence[JointSignals], step: int) -> float:
    return step / signals[0].rate


def _allowed(robot: RobotModel, row: str, groups: Collection[str] | None) -> list[str]:
    """Groups of a joint that may be kept; sizes of some refer to the torque of gravity."""
    loaded = bool(gravity_rms(robot, robot.mj).any())
    hinges = {joint.dofs[0] for joint in robot.joints if joint.kind == "hinge"}
    known = [name for name in group_names(row in hinges) if groups is None or name in groups]
    return [name for name in known if loaded or not name.startswith(OF_GRAVITY)]
