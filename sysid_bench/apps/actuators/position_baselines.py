"""Errors of positions without an identification: the values of the model file, the commands
themselves, and the motion that was recorded under the same commands before."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from sysid_bench.apps.actuators.drive_estimate import DriveEstimate
from sysid_bench.apps.actuators.drive_part import DrivePart
from sysid_bench.apps.actuators.drive_rows import model_values
from sysid_bench.apps.actuators.rollout import Drives, missing_simulation, rollout_error
from sysid_bench.errors import SimulationError
from sysid_bench.evaluation.baselines import COMMAND, FILE, Baselines
from sysid_bench.types import Array, Row

SAME: Final = 1e-4
"""Mean square difference of commands over their variance within which they are the same."""

REPETITION: Final = "repetition"


@dataclass(frozen=True, eq=False)
class PositionBaselines:
    """RMS errors (k,) of each joint (rad, m) by name: FILE and COMMAND, and REPETITION where the
    judged commands were recorded in the training too."""

    joints: Mapping[str, Array] = field(default_factory=dict)

    @property
    def baselines(self) -> Baselines:
        """Errors over all joints; that of the repeated motion is the floor."""
        whole = {name: float(np.sqrt(np.mean(x**2))) for name, x in self.joints.items()}
        return Baselines(
            {x: whole[x] for x in (FILE, COMMAND) if x in whole}, whole.get(REPETITION)
        )


def position_baselines(
    judged: Sequence[DrivePart], found: DriveEstimate, training: Sequence[DrivePart]
) -> PositionBaselines:
    """Return the errors of the model file's own values, simulated with the delay that was found, of
    the commanded positions, and of the repeated motion; none where nothing is simulated."""
    parts = [part for part in judged if part.log.commands is not None]
    if not parts or missing_simulation(parts[0].robot):
        return PositionBaselines()
    joints, errors = found.rows.joints, {}
    drives = Drives(joints, model_values(parts[0].robot, joints), found.delay)
    of_joints = [(part, part.log.commands.of(joints)) for part in parts if part.log.commands]
    with suppress(SimulationError):  # without any friction a robot may diverge
        errors[FILE] = _rms([rollout_error(p.robot, drives, x, p.rows) ** 2 for p, x in of_joints])
    commanded = [np.mean((x.q_des - x.q)[part.rows] ** 2, axis=0) for part, x in of_joints]
    errors[COMMAND] = _rms(commanded)
    repeated = [_repeated(part, training, joints) for part in parts]
    if all(x is not None for x in repeated):
        errors[REPETITION] = _rms([x for x in repeated if x is not None])
    return PositionBaselines(errors)


def _rms(squares: Sequence[Array]) -> Array:
    return np.asarray(np.sqrt(np.mean(squares, axis=0)))


def _repeated(
    part: DrivePart, training: Sequence[DrivePart], joints: Sequence[str]
) -> Array | None:
    """Return the mean square difference (k,) of the positions to those under the same commands in
    the training, None where there are none."""
    assert part.log.commands is not None
    judged = part.log.commands.of(joints).select(part.rows)
    for one in training:
        if one.log.commands is None or abs(one.log.recording.rate / judged.rate - 1.0) > SAME:
            continue
        earlier = one.log.commands.of(joints).select(one.rows)
        count = min(len(judged), len(earlier))
        lag = _lag(earlier.q_des, judged.q_des[:count])
        if lag is not None:
            difference = judged.q[:count] - earlier.q[lag : lag + count]
            return np.asarray(np.mean(difference**2, axis=0))
    return None


def _lag(whole: Array, part: Array) -> int | None:
    """Return the first sample of `whole` (N, k) from which on it equals `part` (n, k)."""
    spread = part.std(axis=0)
    moved = np.flatnonzero(spread > 0.0)
    if not len(moved):
        return None
    centre = part.mean(axis=0)[moved]
    x, y = ((z[:, moved] - centre) / spread[moved] for z in (whole, part))
    # Squared distance at each lag, its product by FFT.
    size = 1 << (len(x) + len(y)).bit_length()
    spectra = np.fft.rfft(x, size, axis=0) * np.conj(np.fft.rfft(y, size, axis=0))
    product = np.fft.irfft(spectra.sum(axis=1), size)[: len(x) - len(y) + 1]
    squares = np.concatenate([[0.0], np.cumsum((x**2).sum(axis=1))])
    distance = squares[len(y) :] - squares[: -len(y)] + (y**2).sum() - 2.0 * product
    best = int(np.argmin(distance))
    return best if distance[best] <= SAME * y.size else None


def rollout_fields(against: Baselines) -> Row:
    """Return the fields of a row with the baselines of positions."""
    errors = against.errors
    return {
        "rollout_error_null": errors.get(FILE),
        "rollout_error_command": errors.get(COMMAND),
        "rollout_error_floor": against.floor,
    }
