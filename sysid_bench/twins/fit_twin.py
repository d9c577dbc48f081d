"""Twin of a robot from recordings: effects that cross-validation keeps, and coloured noise."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from sysid_bench.experiments.recorded.preprocess import LogProcessing, ProcessedLog
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.gravity import gravity_rms
from sysid_bench.twins.coloured_noise import coloured_noise
from sysid_bench.twins.effect_columns import JointColumns, groups_of
from sysid_bench.twins.effect_selection import JointFit, select_effects
from sysid_bench.twins.joint_signals import JointSignals, joint_signals, tested_recording
from sysid_bench.twins.replay import Replayed, replay_rate
from sysid_bench.twins.twin_plant import OF_GRAVITY, plant_keys, with_own_friction

SAMPLES: Final = 6000
"""Samples of a recording, about, that effects are fitted to: signals lie below 10 Hz."""


@dataclass(frozen=True, eq=False)
class Twin:
    """A robot with its fitted friction, the keys of its plant file, and the fit of each joint."""

    robot: RobotModel
    plant: Mapping[str, Any]
    fits: Mapping[str, JointFit]
    rate: float  # Hz, of replays

    @property
    def replayed(self) -> Replayed:
        """The plant of replays."""
        return Replayed(self.robot, self.plant)


def fit_twin(
    robot: RobotModel,
    logs: Sequence[ProcessedLog],
    preprocessing: LogProcessing,
    groups: Collection[str] | None = None,
) -> Twin:
    """Return the twin of `robot`, an identified model, from its training logs.

    `groups`: the effects that may be kept (None: all); without any it is the null twin, the robot
    with noise of the same residual.
    """
    recordings = [tested_recording(log, preprocessing) for log in logs]
    filter = preprocessing.processing.filter
    signals = tuple(joint_signals(robot, one, filter) for one in recordings)
    step = max(1, round(sum(len(one.t) for one in signals) / SAMPLES))
    fits = {
        name: select_effects(JointColumns(signals, j, step), _allowed(robot, name, groups))
        for j, name in enumerate(robot.torque_rows)
    }
    own, rate = with_own_friction(robot, fits), replay_rate(signals[0].rate)
    residuals = [fit.residual for fit in fits.values()]
    noise = coloured_noise(residuals, _interval(signals, step), filter, rate)
    return Twin(own, plant_keys(own, fits, noise), fits, rate)


def _interval(signals: Sequence[JointSignals], step: int) -> float:
    return step / signals[0].rate


def _allowed(robot: RobotModel, row: str, groups: Collection[str] | None) -> list[str]:
    """Groups of a joint that may be kept; sizes of some refer to the torque of gravity."""
    loaded = bool(gravity_rms(robot, robot.mj).any())
    hinges = {joint.dofs[0] for joint in robot.joints if joint.kind == "hinge"}
    known = [name for name in groups_of(row in hinges) if groups is None or name in groups]
    return [name for name in known if loaded or not name.startswith(OF_GRAVITY)]
