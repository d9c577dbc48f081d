"""From the description of a recorded log to a Recording on a uniform grid, with its findings."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log_checks import (
    FASTEST,
    MANY,
    Finding,
    check_finite,
    check_limits,
    check_rates,
    check_samples,
    held_rows,
)
from sysid_bench.signals.log_description import NO_JOINT, LogDescription, Signal
from sysid_bench.signals.log_reader import read_table
from sysid_bench.signals.log_table import table_of_rows
from sysid_bench.signals.log_units import UNITS, scales
from sysid_bench.signals.time_base import LONGEST_GAP, SHORTEST, read_times, time_base
from sysid_bench.types import Array, Recording

FAR: Final = 4.0
"""Half ranges from a joint's middle beyond which a number cannot be its position."""


@dataclass(frozen=True, eq=False)
class Log:
    """Recording on a uniform time grid, the joints in it, and its findings.

    `measured_rate` (Hz): the rate at which v and the differences of q agree, None where they do
    not. `coordinates`: all recorded coordinates, where a transmission mixes joints with others.
    """

    description: LogDescription
    recording: Recording
    joints: tuple[str, ...]
    findings: tuple[Finding, ...]
    measured_rate: float | None
    samples: int  # of the file, before resampling
    coordinates: Recording | None = None


@dataclass(frozen=True, eq=False)
class _Grid:
    """Uniform `times` (M,) at `rate` (Hz), and times t (n,) of the `valid` samples (n,), all in the
    log's own time (s)."""

    times: Array
    t: Array
    valid: Array
    rate: float


@dataclass(frozen=True, eq=False)
class _Samples:
    """q, v, tau (N, k) of the recorded coordinates in SI; `truncated`: lines that broke off."""

    q: Array
    v: Array | None
    tau: Array
    truncated: int = 0

    def __len__(self) -> int:
        return len(self.q)

    @property
    def signals(self) -> dict[str, Array]:
        """Recorded signals by name."""
        parts = {"q": self.q, "tau": self.tau}
        return parts if self.v is None else {**parts, "v": self.v}

    def mapped(self, change: Callable[[Array], Array]) -> "_Samples":
        """Return the samples with each signal changed alike."""
        v = None if self.v is None else change(self.v)
        return replace(self, q=change(self.q), v=v, tau=change(self.tau))

    def select(self, rows: slice) -> "_Samples":
        return self.mapped(lambda x: x[rows])

    def of_columns(self, columns: Sequence[int]) -> "_Samples":
        return self.mapped(lambda x: x[:, columns])

    def resampled(self, grid: _Grid) -> "_Samples":
        return self.mapped(lambda x: _interpolated(grid, x[grid.valid]))


def read_log(description: LogDescription, robot: RobotModel) -> Log:
    """Return the recording of a description in the coordinates of `robot`.

    Joints that are not in the log stand at their reference; their torque is set to zero and must
    not be used. Raises UsageError for files, columns, units or joints that do not exist.
    """
    raw = _signals(description, _kinds(description, robot))
    stamps = read_times(description, len(raw))
    invalid = check_finite(*raw.signals.values())
    t, rate, timing = time_base(description, stamps, invalid)
    grid = _uniform_grid(description, t, invalid, rate)
    columns = _joint_columns(description)
    joints = tuple(columns)
    measured = raw.of_columns(list(columns.values()))
    samples = measured.resampled(grid)
    rates, measured_rate = _rates(samples, rate, joints)
    findings = [
        *_broken_off(raw.truncated),
        *_not_finite(invalid),
        *timing,
        *_held(*held_rows(measured.q[grid.valid], rate)),
        *_lost(samples, stamps),
        *rates,
        *_ranges(robot, joints, samples),
    ]
    recording = _robot_recording(robot, joints, samples, grid)
    return Log(
        description=description,
        recording=replace(recording, period=description.period),
        joints=joints,
        findings=tuple(findings),
        measured_rate=measured_rate,
        samples=len(raw),
        coordinates=_coordinates(description, raw, grid),
    )


def _joint_columns(log: LogDescription) -> dict[str, int]:
    """Return the column of each recorded coordinate that is a joint of the robot, by its name."""
    return {joint: i for i, joint in enumerate(log.joints) if joint != NO_JOINT}


def _uniform_grid(log: LogDescription, t: Array, invalid: Array, rate: float) -> _Grid:
    """Return the grid from the first to the last valid sample; raises UsageError for too few."""
    valid = np.flatnonzero(~invalid & np.isfinite(t))
    if len(valid) < SHORTEST:
        raise UsageError(
            f"{log.source}: {len(valid)} of {len(t)} samples are usable; {SHORTEST} are needed."
        )
    times = np.arange(t[valid[0]], t[valid[-1]] + 0.5 / rate, 1.0 / rate)
    return _Grid(times, t[valid], valid, rate)


def _interpolated(grid: _Grid, x: Array) -> Array:
    """Return x (n, k) of the valid samples at the times of the grid, linear between samples.

    Held rows are left out: a drive that repeats its last value has not measured one.
    """
    t = grid.t
    kept = ~held_rows(x, 1.0 / np.median(np.diff(t)))[0]
    return np.stack([np.interp(grid.times, t[kept], column[kept]) for column in x.T], axis=1)


def _scalar_kinds(robot: RobotModel) -> dict[str, str]:
    """Return hinge or slide of each joint of the robot that is one of them, by name."""
    return {j.dofs[0]: j.kind for j in robot.joints if j.kind in ("hinge", "slide")}


def _kinds(log: LogDescription, robot: RobotModel) -> list[str]:
    """Return hinge or slide of each coordinate of the log, "" where it is not a joint."""
    known = _scalar_kinds(robot)
    for joint in log.joints:
        if joint not in (NO_JOINT, *known):
            advice = f"Write {NO_JOINT!r} for a coordinate that is not a joint of the model."
            raise UsageError(f"{log.source}: {unknown_name('joint', joint, known, advice)}")
    return [known.get(joint, "") for joint in log.joints]


def _signals(log: LogDescription, kinds: Sequence[str]) -> _Samples:
    """Return the chosen samples of all recorded coordinates, joint side, in SI."""
    motor_side = _cut_to_shortest(log, _read_signals(log, kinds))
    # Offsets are those of the joint, so they come after the transmission.
    samples = _with_offsets(log, _joint_side(log.transmission, motor_side))
    return samples.select(_selected_rows(log, len(samples)))


def _joint_side(G: Array | None, motor: _Samples) -> _Samples:
    """Return the signals behind a transmission q = G q_motor; without one they are those given."""
    if G is None:
        return motor
    joint = motor.mapped(lambda x: x @ G.T)
    # tau_motor = G' tau, from equal power on both sides.
    return replace(joint, tau=np.linalg.solve(G.T, motor.tau.T).T)


def _with_offsets(log: LogDescription, samples: _Samples) -> _Samples:
    offset = {
        name: log.joint_values(f"{name}.offset", part.offset) for name, part in log.signals.items()
    }
    return replace(samples, **{name: x + offset[name] for name, x in samples.signals.items()})


def _read_signals(log: LogDescription, kinds: Sequence[str]) -> _Samples:
    """Return q, v, tau as scaled by the description, each of the length of its own file."""
    q, in_q = _columns(log, "q", log.q, kinds)
    tau, in_tau = _columns(log, "tau", log.tau, kinds)
    v, in_v = (None, 0) if log.v is None else _columns(log, "v", log.v, kinds)
    return _Samples(q, v, tau, max(in_q, in_tau, in_v))


def _cut_to_shortest(log: LogDescription, samples: _Samples) -> _Samples:
    """Return the samples that all signals have; separate files may differ by the broken line."""
    lengths = {name: len(x) for name, x in samples.signals.items()}
    shortest = min(lengths.values())
    if max(lengths.values()) > shortest + 1:
        listed = ", ".join(f"{name} {n}" for name, n in lengths.items())
        raise UsageError(f"{log.source}: the signals differ in length: {listed} samples.")
    return samples.select(slice(shortest))


def _columns(
    log: LogDescription, name: str, part: Signal, kinds: Sequence[str]
) -> tuple[Array, int]:
    table = read_table(log.file_of(part), log.reader_of(part))
    if part.per_row is not None:
        table = table_of_rows(table, part.per_row)
    values = table.columns(part.columns)
    if values.shape[1] != len(log.joints):
        raise UsageError(
            f"{log.source}: {name} has {values.shape[1]} columns for {len(log.joints)} joints; "
            f"write one column for each of {', '.join(log.joints)}."
        )
    return values * scales(log, name, part, kinds), table.truncated


def _selected_rows(log: LogDescription, samples: int) -> slice:
    if log.rows is None:
        return slice(0, samples)
    first, last = log.rows
    if last > samples:
        raise UsageError(
            f"{log.source}: rows = [{first}, {last}], but there are {samples} samples."
        )
    return slice(first - 1, last)


def _broken_off(truncated: int) -> list[Finding]:
    found = Finding("non-finite", truncated, "the last line is incomplete and was left out")
    return [found] if truncated else []


def _lost(samples: _Samples, stamps: Array | None) -> list[Finding]:
    """Return findings of lost samples, which time stamps would show directly."""
    return check_samples(samples.q) if stamps is None else []


def _rates(
    samples: _Samples, rate: float, joints: Sequence[str]
) -> tuple[list[Finding], float | None]:
    """Return findings of v against q, and the rate at which they agree; none without v."""
    if samples.v is None:
        return [], None
    return check_rates(samples.q, samples.v, rate, joints)


def _not_finite(invalid: Array) -> list[Finding]:
    count = int(invalid.sum())
    if count == 0:
        return []
    first = np.argmax(invalid) + 1
    text = f"{count} of {len(invalid)} samples hold no numbers, the first in line {first}"
    return [Finding("non-finite", count, text, count > LONGEST_GAP * len(invalid))]


def _held(held: Array, standing: int) -> list[Finding]:
    found, count, moving = [], int(held.sum()), len(held) - standing
    if count:
        text = f"{count} of {moving} samples of the motion repeat the positions before"
        found.append(Finding("held", count, text, count > MANY * moving))
    if standing:
        found.append(Finding("held", standing, f"{standing} samples stand still"))
    return found


def _ranges(robot: RobotModel, joints: Sequence[str], samples: _Samples) -> list[Finding]:
    """Return findings about values impossible for the joint, which are contradictions; without
    them, about positions outside of the limits, which are reported."""
    return _impossible(robot, joints, samples) or _outside(robot, joints, samples.q)


def _impossible(robot: RobotModel, joints: Sequence[str], samples: _Samples) -> list[Finding]:
    rows = list(map(robot.rows.index, joints))
    low, high = robot.limits.q_low[rows], robot.limits.q_high[rows]
    kind_of = _scalar_kinds(robot)
    kinds = [kind_of[joint] for joint in joints]
    units = {name: [next(iter(UNITS[name][kind])) for kind in kinds] for name in UNITS}
    middle = 0.5 * (low + high)
    reach = FAR * 0.5 * (high - low)
    found = check_limits("q less its middle", samples.q - middle, reach, joints, units["q"])
    if samples.v is not None:
        fastest = np.array([FASTEST[kind] for kind in kinds])
        found += check_limits("v", samples.v, fastest, joints, units["v"])
    strongest = FAR * robot.limits.tau[rows]
    return found + check_limits("tau", samples.tau, strongest, joints, units["tau"])


def _outside(robot: RobotModel, joints: Sequence[str], q: Array) -> list[Finding]:
    rows = list(map(robot.rows.index, joints))
    low, high = robot.limits.q_low[rows], robot.limits.q_high[rows]
    counts = ((q < low) | (q > high)).sum(axis=0)
    found = []
    for j in np.flatnonzero(counts).tolist():
        text = (
            f"joint {joints[j]!r} is outside of its limits [{low[j]:.4g}, {high[j]:.4g}] in "
            f"{counts[j]} of {len(q)} samples"
        )
        found.append(Finding("limits", int(counts[j]), text))
    return found


def _robot_recording(
    robot: RobotModel, joints: Sequence[str], samples: _Samples, grid: _Grid
) -> Recording:
    """Return q, v, tau (N, k) of the log's joints in the coordinates of the whole robot."""
    N = len(grid.times)
    joint_of = {dof: joint for joint in robot.joints for dof in joint.dofs}
    q = np.tile(robot.mj.qpos0, (N, 1))
    v, tau = np.zeros((N, robot.nv)), np.zeros((N, len(robot.torque_rows)))
    for i, name in enumerate(joints):
        joint = joint_of[name]
        q[:, joint.qadr] = samples.q[:, i]
        tau[:, robot.torque_rows.index(name)] = samples.tau[:, i]
        if samples.v is not None:
            v[:, joint.vadr] = samples.v[:, i]
    return Recording(
        t=grid.times - grid.times[0],
        q=q,
        tau=tau,
        rate=grid.rate,
        rows=robot.torque_rows,
        v=None if samples.v is None else v,
    )


def _coordinates(log: LogDescription, raw: _Samples, grid: _Grid) -> Recording | None:
    """Return all recorded coordinates, without torques; None unless a transmission mixes them."""
    if log.transmission is None:
        return None
    samples = raw.resampled(grid)
    return Recording(
        t=grid.times - grid.times[0],
        q=samples.q,
        tau=np.zeros_like(samples.q),
        rate=grid.rate,
        rows=log.joints,
        v=samples.v,
    )
