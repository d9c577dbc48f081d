"""Limits of position controllers that data keep or drop: torque, speed and dead band.

A fit of torques cannot judge them: a limit that flattens the torque leaves less to explain, whether
it is there or not. Each is therefore judged by the simulated positions, as a cross-check: its value
is chosen on one half of the recordings, and has to lower the error of the other half, both ways."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.apps.actuators.drive_estimate import DriveEstimate, identify_drives
from sysid_bench.apps.actuators.drive_part import DrivePart
from sysid_bench.apps.actuators.drive_rows import SERVO
from sysid_bench.apps.actuators.rollout import rollout_error
from sysid_bench.errors import SimulationError
from sysid_bench.signals.position_control import Commands
from sysid_bench.types import Array

LONGEST: Final = 20.0
"""s of each half of a recording that is simulated: errors of longer ones hardly differ."""

SHARES: Final[Mapping[str, tuple[float, ...]]] = {
    "torque-limit": (0.8, 0.5, 0.3),
    "speed-limit": (1.0, 0.7, 0.5),
    "dead-band": (0.1, 0.2, 0.4),
}
"""Values that are tried: shares of the largest torque that is asked for, of the fastest recorded
rate (a joint at its limit has reached it), and of the RMS of command less position."""

FINER: Final = (0.8, 1.25)
"""Factors of the best of them that are tried as well: about half way to the next ones."""

NEEDED: Final = 0.9
"""Largest error over that without a limit. Below 1, since halves of one motion share the errors of
the model, and three limits of every joint are tried."""

ABSENT: Final = {"torque-limit": np.inf, "speed-limit": np.inf, "dead-band": 0.0}


@dataclass(frozen=True, eq=False)
class LimitTest:
    """A limit in each joint: `value` (k,) that fits best, in units of the stated gains; `ratio`
    (2, k): errors of each half at the value that the other one chose, over those without a limit;
    `kept` (k,)."""

    term: str
    value: Array
    ratio: Array
    kept: Array


def tested_limits(
    parts: Sequence[DrivePart], found: DriveEstimate, shared: Sequence[str]
) -> tuple[LimitTest, ...]:
    """Return the tests of all limits beside a fit without them; joints with a stated torque limit
    keep it."""
    judge = _Judge(parts, found, shared)
    without = judge.errors({})
    tests = [_tested(term, judge, without) for term in SERVO]
    # Several limits shape one error: each joint has the one that lowers it most.
    best = np.argmin([x.ratio.max(axis=0) for x in tests], axis=0)
    tests = [replace(x, kept=x.kept & (best == i)) for i, x in enumerate(tests)]
    if kept := servo_values(tests):
        # Joints move each other: what helps one by itself has to help beside the others too.
        lower = (judge.errors(kept) < without).all(axis=0)
        tests = [replace(x, kept=x.kept & lower) for x in tests]
    return tuple(tests)


def servo_values(tests: Sequence[LimitTest]) -> dict[str, Array]:
    """Return the kept limits (k,) by name, as `drive_rows` takes them."""
    return {x.term: np.where(x.kept, x.value, ABSENT[x.term]) for x in tests if x.kept.any()}


@dataclass(frozen=True, eq=False)
class _Judge:
    parts: Sequence[DrivePart]
    found: DriveEstimate
    shared: Sequence[str]

    @property
    def commands(self) -> list[Commands]:
        """Commands of the parts."""
        joints, logs = self.found.rows.joints, [part.log for part in self.parts]
        return [x.commands.of(joints) for x in logs if x.commands is not None]

    def errors(self, servo: Mapping[str, Array]) -> Array:
        """RMS errors (2, k) of the positions in both halves, with the drives that fit under these
        limits; infinite where their simulation diverges."""
        rows = replace(self.found.rows, servo=servo)
        drives = identify_drives(rows, self.shared, self.found.delay).drives
        squares = []
        for part, commands in zip(self.parts, self.commands, strict=True):
            first, last, _ = part.rows.indices(len(commands))
            middle, most = (first + last) // 2, int(LONGEST * commands.rate)
            halves = [slice(k, min(k + most, end)) for k, end in ((first, middle), (middle, last))]
            try:
                own = [rollout_error(part.robot, drives, commands, rows) ** 2 for rows in halves]
            except SimulationError:
                return np.full((2, len(rows.joints)), np.inf)
            squares.append(own)
        return np.asarray(np.sqrt(np.mean(squares, axis=0)))

    def scale(self, term: str) -> Array:
        """Sizes (k,) of SHARES."""
        each = []
        for part, whole in zip(self.parts, self.commands, strict=True):
            commands = whole.select(part.rows)
            if term == "torque-limit":
                # A percentile: commands that jump ask for any torque for a moment.
                asked = np.percentile(np.abs(commands.torque(self.found.delay)), 99.0, axis=0)
                each.append(np.where(np.isinf(commands.limit), asked, np.inf))
            elif term == "speed-limit":
                # Over a tenth of a second: a joint at its limit keeps its rate, ringing does not.
                span = max(1, round(0.1 * whole.rate))
                rates = (commands.q[span:] - commands.q[:-span]) * whole.rate / span
                each.append(np.percentile(np.abs(rates), 99.0, axis=0))
            else:
                each.append(np.sqrt(np.mean((commands.q_des - commands.q) ** 2, axis=0)))
        return np.asarray(np.max(each, axis=0))


def _tested(term: str, judge: _Judge, without: Array) -> LimitTest:
    """Return the test of one limit in all joints at once: that of a joint hardly moves others."""
    values = [share * judge.scale(term) for share in SHARES[term]]
    ratios = [_ratio(judge.errors({term: value}), without) for value in values]
    joints = np.arange(len(values[0]))
    first = np.argmin([(x**2).sum(axis=0) for x in ratios], axis=0)
    values += [factor * np.array(values)[first, joints] for factor in FINER]
    more = values[len(SHARES[term]) :]
    ratios += [_ratio(judge.errors({term: value}), without) for value in more]
    each, errors = np.array(values), np.array(ratios)
    # Each half at the value that the other one chose.
    chosen = [errors[np.argmin(errors[:, 1 - half], axis=0), half, joints] for half in (0, 1)]
    value = each[np.argmin((errors**2).sum(axis=1), axis=0), joints]
    ratio = np.array(chosen)
    return LimitTest(term, value, ratio, (ratio < NEEDED).all(axis=0) & np.isfinite(value))


def _ratio(errors: Array, without: Array) -> Array:
    """Return errors over those without a limit; infinite where these are zero or diverge."""
    known = np.isfinite(without) & (without > 0)
    return np.where(known, errors / np.where(known, without, 1.0), np.inf)
