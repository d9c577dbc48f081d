"""A recording of a real robot: from its description to a Recording, with what is wrong with it."""

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
    bad_rows,
    check_ranges,
    check_rates,
    held_rows,
    lost_steps,
)
from sysid_bench.signals.log_description import NO_JOINT, UNITS, LogDescription, Signal, scales
from sysid_bench.signals.log_table import normalised_name, read_table
from sysid_bench.types import Array, Recording

LONGEST_GAP: Final = 0.2
"""Share of rows without numbers, or with stamps that run backwards, that is still told and
bridged; beyond it the file is not what its description says."""

FAR: Final = 4.0
"""Positions beyond so many half ranges from a joint's middle are no positions of that joint."""

WIDEST: Final = 3.0
"""So many times as long as its samples a recording may be; more is gap than recording."""

SHORTEST: Final = 20
"""Samples; below it nothing can be filtered, differentiated or identified."""


@dataclass(frozen=True, eq=False)
class Log:
    """A recording on a uniform time grid, the joints in it, and what was found. `measured_rate`
    (Hz) is that at which v and the differences of q agree, None where they cannot tell.
    `coordinates`: all that was recorded, also what is no joint of the robot, where a transmission
    mixes them."""

    description: LogDescription
    recording: Recording
    joints: tuple[str, ...]
    findings: tuple[Finding, ...]
    measured_rate: float | None
    samples: int  # as they stand in the file
    coordinates: Recording | None = None


def read_log(description: LogDescription, robot: RobotModel) -> Log:
    """The recording of a description, in the coordinates of `robot`, whose joints that are not in
    the log stand at their reference; their torque is zero and means nothing.

    Raises UsageError for files, columns, units or joints that are not there.
    """
    kinds = _kinds(description, robot)
    q, v, tau, truncated = _signals(description, kinds)
    samples = len(q)
    stamps = _stamps(description, samples)
    findings = [_broken_off(truncated)] if truncated else []
    bad = bad_rows(q, tau, *(() if v is None else (v,)))
    t, rate, timed = _time_base(description, stamps, bad)
    findings += [*_not_finite(bad), *timed]
    own = [i for i, joint in enumerate(description.joints) if joint != NO_JOINT]
    joints = tuple(description.joints[i] for i in own)
    every = q, v
    q, tau = q[:, own], tau[:, own]
    v = None if v is None else v[:, own]
    good = np.flatnonzero(~bad & np.isfinite(t))
    if len(good) < SHORTEST:
        raise UsageError(
            f"{description.source}: {len(good)} of {samples} samples are usable; {SHORTEST} are "
            "needed."
        )
    held, standing = held_rows(q[good], rate)
    findings += _held(held, standing)
    grid = np.arange(t[good[0]], t[good[-1]] + 0.5 / rate, 1.0 / rate)
    q = interpolate_gaps(grid, t[good], q[good])
    if stamps is None:
        lost = int(lost_steps(q).sum())
        findings += [Finding("lost", lost, f"{lost} samples seem to be lost")] if lost else []
    tau = interpolate_gaps(grid, t[good], tau[good])
    measured = None
    if v is not None:
        v = interpolate_gaps(grid, t[good], v[good])
        told, measured = check_rates(q, v, rate, joints)
        findings += told
    findings += _ranges(robot, joints, q, v, tau)
    recording = _of_robot(robot, joints, grid - grid[0], rate, q, v, tau)
    recording = replace(recording, period=description.period)
    coordinates = None
    if description.transmission is not None:
        whole, rates = (
            None if x is None else interpolate_gaps(grid, t[good], x[good]) for x in every
        )
        assert whole is not None
        coordinates = Recording(
            recording.t, whole, np.zeros_like(whole), rate, description.joints, rates
        )
    return Log(description, recording, joints, tuple(findings), measured, samples, coordinates)


def interpolate_gaps(grid: Array, t: Array, x: Array) -> Array:
    """x (N, k) at the times `grid`, linear between its samples; held rows are no samples."""
    kept = ~held_rows(x, 1.0 / np.median(np.diff(t)))[0]
    return np.stack([np.interp(grid, t[kept], column[kept]) for column in x.T], axis=1)


def _kinds(log: LogDescription, robot: RobotModel) -> list[str]:
    """hinge or slide of each coordinate of the log, "" where it is no joint of the robot."""
    known = {j.dofs[0]: j.kind for j in robot.joints if j.kind in ("hinge", "slide")}
    for joint in log.joints:
        if joint != NO_JOINT and joint not in known:
            advice = f"Write {NO_JOINT!r} for a coordinate that is no joint of the model."
            raise UsageError(f"{log.source}: {unknown_name('joint', joint, known, advice)}")
    return [known.get(joint, "") for joint in log.joints]


def _signals(log: LogDescription, kinds: Sequence[str]) -> tuple[Array, Array | None, Array, int]:
    """q, v, tau (N, k) of the joints in SI, and how many files break off in their last line."""
    q, cut = _columns(log, "q", log.q, kinds)
    tau, more = _columns(log, "tau", log.tau, kinds)
    v, last = (None, 0) if log.v is None else _columns(log, "v", log.v, kinds)
    lengths = {"q": len(q), "tau": len(tau)} | ({} if v is None else {"v": len(v)})
    shortest = min(lengths.values())
    if max(lengths.values()) > shortest + 1:  # files of their own may differ by the broken line
        told = ", ".join(f"{name} {n}" for name, n in lengths.items())
        raise UsageError(f"{log.source}: the signals differ in length: {told} samples.")
    q, tau = q[:shortest], tau[:shortest]
    v = None if v is None else v[:shortest]
    if log.transmission is not None:
        G = log.transmission
        q = q @ G.T
        v = None if v is None else v @ G.T
        tau = np.linalg.solve(G.T, tau.T).T  # tau_motor = G' tau
    q = q + log.column_count("q.offset", log.q.offset)
    tau = tau + log.column_count("tau.offset", log.tau.offset)
    if v is not None and log.v is not None:
        v = v + log.column_count("v.offset", log.v.offset)
    chosen = _chosen(log, shortest)
    q, tau = q[chosen], tau[chosen]
    return q, (None if v is None else v[chosen]), tau, max(cut, more, last)


def _columns(
    log: LogDescription, name: str, part: Signal, kinds: Sequence[str]
) -> tuple[Array, int]:
    table = read_table(log.file_of(part))
    if part.per_row is not None:
        table = normalised_name(table, part.per_row)
    values = table.columns(part.columns)
    if values.shape[1] != len(log.joints):
        raise UsageError(
            f"{log.source}: {name} has {values.shape[1]} columns for {len(log.joints)} joints; "
            f"write one column for each of {', '.join(log.joints)}."
        )
    return values * scales(log, name, part, kinds), table.truncated


def _chosen(log: LogDescription, samples: int) -> slice:
    if log.rows is None:
        return slice(0, samples)
    first, last = log.rows
    if last > samples:
        raise UsageError(
            f"{log.source}: rows = [{first}, {last}], but there are {samples} samples."
        )
    return slice(first - 1, last)


def _stamps(log: LogDescription, samples: int) -> Array | None:
    """Time stamps (N,) in seconds, as they stand in the file."""
    if log.time is None:
        return None
    sizes = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
    if log.time.unit not in sizes:
        raise UsageError(f"{log.source}: time: {unknown_name('unit', log.time.unit, sizes)}")
    values = read_table(log.file_of(log.time)).columns([log.time.column])
    if values.shape[1] != 1:
        raise UsageError(f"{log.source}: time must be one column; got {values.shape[1]}.")
    stamps = values[:, 0] * sizes[log.time.unit]
    first = 0 if log.rows is None else log.rows[0] - 1
    if not samples <= len(stamps) - first <= samples + (1 if log.rows is None else len(stamps)):
        raise UsageError(
            f"{log.source}: there are {len(stamps)} time stamps for {samples} samples."
        )
    return stamps[first : first + samples]


def _time_base(
    log: LogDescription, stamps: Array | None, bad: Array
) -> tuple[Array, float, list[Finding]]:
    """Times (N,), NaN where a sample has none of its own; the rate of the grid; what was found."""
    if stamps is None:
        assert log.rate is not None
        return np.arange(len(bad)) / log.rate, log.rate, []
    t = np.where(bad, np.nan, stamps)
    latest = np.fmax.accumulate(np.concatenate([[-np.inf], t[:-1]]))
    stale = ~(t > latest) & np.isfinite(t)
    twice = int((stale & (t == latest)).sum())
    backwards = int(stale.sum()) - twice
    t = np.where(stale, np.nan, t)
    steps = np.diff(t[np.isfinite(t)])
    if len(steps) < SHORTEST:
        raise UsageError(
            f"{log.source}: only {len(steps) + 1} time stamps rise; is it the column of the time?"
        )
    step = float(np.median(steps))
    rate = log.rate or 1.0 / step
    found = []
    if twice:
        found.append(Finding("time", twice, f"{twice} time stamps come twice"))
    if backwards:
        text = f"{backwards} time stamps run backwards"
        found.append(Finding("time", backwards, text, backwards > LONGEST_GAP * len(t)))
    lost = int(np.maximum(np.round(steps / step) - 1, 0).sum())
    if lost:
        longest = f"the longest gap is {steps.max():.4g} s"
        found.append(Finding("lost", lost, f"{lost} samples are lost by their stamps; {longest}"))
    if abs(rate * step - 1) > 0.05:
        text = (
            f"a rate of {rate:.6g} Hz is declared, but the time stamps are {step:.4g} s apart "
            f"({1 / step:.4g} Hz): its unit, or the rate"
        )
        found.append(Finding("rate", len(t), text, contradiction=True))
        rate = 1.0 / step
    if np.nansum(steps) * rate > WIDEST * len(t):
        raise UsageError(
            f"{log.source}: the time stamps leave a gap of {steps.max():.4g} s in {len(t)} samples "
            f"{step:.4g} s apart; choose the part that was recorded in one go (rows = [first, "
            "last])."
        )
    return t, rate, found


def _broken_off(truncated: int) -> Finding:
    return Finding("non-finite", truncated, "the last line is broken off and left out")


def _not_finite(bad: Array) -> list[Finding]:
    count = int(bad.sum())
    if count == 0:
        return []
    text = f"{count} of {len(bad)} samples hold no numbers, the first in line {np.argmax(bad) + 1}"
    return [Finding("non-finite", count, text, count > LONGEST_GAP * len(bad))]


def _held(held: Array, standing: int) -> list[Finding]:
    found, count, moving = [], int(held.sum()), len(held) - standing
    if count:
        text = f"{count} of {moving} samples of the motion repeat the positions before"
        found.append(Finding("held", count, text, count > MANY * moving))
    if standing:
        found.append(Finding("held", standing, f"{standing} samples stand still"))
    return found


def _ranges(
    robot: RobotModel, joints: Sequence[str], q: Array, v: Array | None, tau: Array
) -> list[Finding]:
    """Positions outside of the limits are told; what no such joint can do contradicts."""
    at = [robot.rows.index(joint) for joint in joints]
    low, high = robot.limits.q_low[at], robot.limits.q_high[at]
    kinds = [next(j.kind for j in robot.joints if joint in j.dofs) for joint in joints]
    units = {name: [next(iter(UNITS[name][kind])) for kind in kinds] for name in UNITS}
    middle = 0.5 * (low + high)
    found = check_ranges(
        "q less its middle", q - middle, FAR * 0.5 * (high - low), joints, units["q"]
    )
    if v is not None:
        found += check_ranges(
            "v", v, np.array([FASTEST[kind] for kind in kinds]), joints, units["v"]
        )
    found += check_ranges("tau", tau, FAR * robot.limits.tau[at], joints, units["tau"])
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


def _of_robot(
    robot: RobotModel,
    joints: Sequence[str],
    t: Array,
    rate: float,
    q: Array,
    v: Array | None,
    tau: Array,
) -> Recording:
    """The log's joints at their places in q, v and torque of the whole robot."""
    N = len(t)
    places = {dof: joint for joint in robot.joints for dof in joint.dofs}
    whole_q = np.tile(robot.mj.qpos0, (N, 1))
    whole_v, whole_tau = np.zeros((N, robot.nv)), np.zeros((N, len(robot.torque_rows)))
    for i, name in enumerate(joints):
        joint = places[name]
        whole_q[:, joint.qadr] = q[:, i]
        whole_tau[:, robot.torque_rows.index(name)] = tau[:, i]
        if v is not None:
            whole_v[:, joint.vadr] = v[:, i]
    whole = None if v is None else whole_v
    return Recording(t, whole_q, whole_tau, rate, robot.torque_rows, whole)
