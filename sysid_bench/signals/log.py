"""From the description of a recorded log to a Recording on a uniform grid, with its findings."""

from collections.abc import Sequence
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
from sysid_bench.signals.log_description import NO_JOINT, UNITS, LogDescription, Signal, scales
from sysid_bench.signals.log_reader import read_table
from sysid_bench.signals.log_table import table_of_rows
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

    def select(self, rows: slice) -> "_Samples":
        v = None if self.v is None else self.v[rows]
        return _Samples(self.q[rows], v, self.tau[rows], self.truncated)

    def of_columns(self, columns: Sequence[int]) -> "_Samples":
        v = None if self.v is None else self.v[:, columns]
        return _Samples(self.q[:, columns], v, self.tau[:, columns], self.truncated)

    def resampled(self, grid: _Grid) -> "_Samples":
        q, tau = (_interpolated(grid, x[grid.valid]) for x in (self.q, self.tau))
        v = None if self.v is None else _interpolated(grid, self.v[grid.valid])
        return _Samples(q, v, tau)


def read_log(description: LogDescription, robot: RobotModel) -> Log:
    """Return the recording of a description in the coordinates of `robot`.

    Joints that are not in the log stand at their reference; their torque is set to zero and must
    not be used. Raises UsageError for files, columns, units or joints that do not exist.
    """
    raw = _signals(description, _kinds(description, robot))
    stamps = read_times(description, len(raw))
    findings = [_broken_off(raw.truncated)] if raw.truncated else []
    invalid = check_finite(raw.q, raw.tau, *(() if raw.v is None else (raw.v,)))
    t, rate, timing = time_base(description, stamps, invalid)
    findings += [*_not_finite(invalid), *timing]
    grid = _uniform_grid(description, t, invalid, rate)
    recorded = [i for i, joint in enumerate(description.joints) if joint != NO_JOINT]
    joints = tuple(description.joints[i] for i in recorded)
    measured = raw.of_columns(recorded)
    findings += _held(*held_rows(measured.q[grid.valid], rate))
    samples = measured.resampled(grid)
    if stamps is None:
        findings += check_samples(samples.q)
    measured_rate = None
    if samples.v is not None:
        found, measured_rate = check_rates(samples.q, samples.v, rate, joints)
        findings += found
    findings += _ranges(robot, joints, samples)
    recording = _robot_recording(robot, joints, samples, grid)
    return Log(
        description=description,
        recording=replace(recording, period=description.period),
        joints=joints,
        findings=tuple(findings),
        measured_rate=measured_rate,
        samples=len(raw),
        coordinates=None
        if description.transmission is None
        else _coordinates(description.joints, raw.resampled(grid), grid),
    )


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


def _kinds(log: LogDescription, robot: RobotModel) -> list[str]:
    """Return hinge or slide of each coordinate of the log, "" where it is not a joint."""
    known = {j.dofs[0]: j.kind for j in robot.joints if j.kind in ("hinge", "slide")}
    for joint in log.joints:
        if joint != NO_JOINT and joint not in known:
            advice = f"Write {NO_JOINT!r} for a coordinate that is not a joint of the model."
            raise UsageError(f"{log.source}: {unknown_name('joint', joint, known, advice)}")
    return [known.get(joint, "") for joint in log.joints]


def _signals(log: LogDescription, kinds: Sequence[str]) -> _Samples:
    """Return the chosen samples of all recorded coordinates, joint side, in SI."""
    raw = _common_length(log, kinds)
    q, v, tau = raw.q, raw.v, raw.tau
    if log.transmission is not None:
        G = log.transmission
        q = q @ G.T
        v = None if v is None else v @ G.T
        tau = np.linalg.solve(G.T, tau.T).T  # tau_motor = G' tau, from equal power on both sides
    # Offsets are those of the joint, so they come after the transmission.
    q = q + log.joint_values("q.offset", log.q.offset)
    tau = tau + log.joint_values("tau.offset", log.tau.offset)
    if v is not None and log.v is not None:
        v = v + log.joint_values("v.offset", log.v.offset)
    return _Samples(q, v, tau, raw.truncated).select(_selected_rows(log, len(q)))


def _common_length(log: LogDescription, kinds: Sequence[str]) -> _Samples:
    """Return q, v, tau as scaled by the description, cut to the shortest of them."""
    q, in_q = _columns(log, "q", log.q, kinds)
    tau, in_tau = _columns(log, "tau", log.tau, kinds)
    v, in_v = (None, 0) if log.v is None else _columns(log, "v", log.v, kinds)
    lengths = {"q": len(q), "tau": len(tau)} | ({} if v is None else {"v": len(v)})
    shortest = min(lengths.values())
    if max(lengths.values()) > shortest + 1:  # separate files may differ by the broken line
        listed = ", ".join(f"{name} {n}" for name, n in lengths.items())
        raise UsageError(f"{log.source}: the signals differ in length: {listed} samples.")
    return _Samples(q, v, tau, max(in_q, in_tau, in_v)).select(slice(shortest))


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


def _broken_off(truncated: int) -> Finding:
    return Finding("non-finite", truncated, "the last line is incomplete and was left out")


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
    """Return findings about positions outside of the limits, which are reported, and about values
    impossible for the joint, which are contradictions."""
    q = samples.q
    rows = [robot.rows.index(joint) for joint in joints]
    low, high = robot.limits.q_low[rows], robot.limits.q_high[rows]
    kinds = [next(j.kind for j in robot.joints if joint in j.dofs) for joint in joints]
    units = {name: [next(iter(UNITS[name][kind])) for kind in kinds] for name in UNITS}
    middle = 0.5 * (low + high)
    reach = FAR * 0.5 * (high - low)
    found = check_limits("q less its middle", q - middle, reach, joints, units["q"])
    if samples.v is not None:
        fastest = np.array([FASTEST[kind] for kind in kinds])
        found += check_limits("v", samples.v, fastest, joints, units["v"])
    strongest = FAR * robot.limits.tau[rows]
    found += check_limits("tau", samples.tau, strongest, joints, units["tau"])
    if found:
        return found
    for j, joint in enumerate(joints):
        count = int(((q[:, j] < low[j]) | (q[:, j] > high[j])).sum())
        if count:
            text = (
                f"joint {joint!r} is outside of its limits [{low[j]:.4g}, {high[j]:.4g}] in "
                f"{count} of {len(q)} samples"
            )
            found.append(Finding("limits", count, text))
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


def _coordinates(names: tuple[str, ...], samples: _Samples, grid: _Grid) -> Recording:
    """Return all recorded coordinates, without torques."""
    return Recording(
        t=grid.times - grid.times[0],
        q=samples.q,
        tau=np.zeros_like(samples.q),
        rate=grid.rate,
        rows=names,
        v=samples.v,
    )
