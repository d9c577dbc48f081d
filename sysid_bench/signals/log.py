"""From the description of a recorded log to a Recording on a uniform grid, with its findings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, first_names
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import COMPONENTS
from sysid_bench.signals import log_checks
from sysid_bench.signals.log_checks import Finding
from sysid_bench.signals.log_controller import with_controller
from sysid_bench.signals.log_description import NO_JOINT, LogDescription
from sysid_bench.signals.log_samples import (
    UNITS,
    Grid,
    RecordedBase,
    Samples,
    read_samples,
    scalar_kinds,
)
from sysid_bench.signals.log_source import clocks_finding, read_time
from sysid_bench.signals.position_control import (
    Commands,
    commands_of,
    unknown_delay,
    with_commanded_torque,
)
from sysid_bench.signals.time_base import LONGEST_GAP, SHORTEST, time_base
from sysid_bench.types import Array, Recording

FAR: Final = 4.0
"""Half ranges from a joint's middle beyond which a number cannot be its position."""


@dataclass(frozen=True, eq=False)
class Log:
    """Recording on a uniform time grid, the joints in it, and its findings.

    `measured_rate` (Hz): the rate at which v and the differences of q agree, None where they do
    not. `coordinates`: all recorded coordinates, where a transmission mixes joints with others.
    `raw`: samples of the file in SI, joint side, in the order of the description. `commands`: state
    and commands of a position controller whose torque replaces the measured one. `base`: recorded
    motion of a floating base, on the grid.
    """

    description: LogDescription
    recording: Recording
    joints: tuple[str, ...]
    findings: tuple[Finding, ...]
    measured_rate: float | None
    samples: int  # of the file, before resampling
    coordinates: Recording | None = None
    raw: Samples | None = None
    commands: Commands | None = None
    base: RecordedBase | None = None


def read_log(description: LogDescription, robot: RobotModel) -> Log:
    """Return the recording of a description in the coordinates of `robot`.

    Joints that are not in the log stand at their reference; their torque is set to zero and must
    not be used. Raises UsageError for files, columns, units or joints that do not exist.
    """
    raw, velocity = _without_constant_velocity(read_samples(description, robot))
    stamps = read_time(description, len(raw))
    invalid = log_checks.check_finite(*raw.measured)
    if (~invalid).sum() < SHORTEST <= len(raw):
        _check_columns(description, raw)
    t, rate, timing = time_base(description, stamps, invalid)
    grid = _uniform_grid(description, t, invalid, rate)
    raw = with_commanded_torque(description, raw, grid)
    column = {joint: i for i, joint in enumerate(description.joints) if joint != NO_JOINT}
    joints = tuple(column)
    measured = raw.columns(list(column.values()))
    samples = measured.at(grid)
    rates: tuple[list[Finding], float | None] = ([], None)
    if samples.v is not None:
        rates = log_checks.check_rates(samples.q, samples.v, rate, joints)
    findings = [
        *clocks_finding(description),
        *_damaged(raw.truncated, invalid),
        *timing,
        *_held(*log_checks.held_rows(measured.q[grid.valid], rate)),
        # Time stamps would show lost samples directly.
        *(log_checks.check_samples(samples.q) if stamps is None else []),
        *velocity,
        *rates[0],
        # Values that are impossible for the joint are contradictions; without them positions
        # outside of the limits are reported.
        *(_impossible(robot, joints, samples) or _outside(robot, joints, samples.q)),
        *unknown_delay(description, len(raw)),
    ]
    recording = _robot_recording(description, robot, joints, samples, grid)
    return Log(
        description=description,
        recording=with_controller(recording, description, robot, joints, samples),
        joints=joints,
        findings=tuple(findings),
        measured_rate=rates[1],
        samples=len(raw),
        coordinates=_coordinates(description, raw, grid),
        raw=raw,
        commands=commands_of(description, raw, grid),
        base=samples.base,
    )


def _check_columns(log: LogDescription, raw: Samples) -> None:
    """Raise UsageError for columns with hardly any number: they leave no sample to use."""
    empty = [
        f"{signal} of {joint!r}"
        for signal, x in raw.signals.items()
        for joint, column in zip(log.joints, x.T, strict=True)
        if joint != NO_JOINT and (~log_checks.check_finite(column[:, None])).sum() < SHORTEST
    ]
    if empty:
        raise UsageError(
            f"{log.source}: {first_names(empty)} has no numbers in {len(raw)} samples (nan, inf or "
            "beyond any measurement): correct the column, or leave the joint out of joints."
        )


def _without_constant_velocity(samples: Samples) -> tuple[Samples, list[Finding]]:
    """Return the samples without velocities that are constant where all joints move: a column that
    was never filled; and the finding that says so."""
    if samples.v is None or len(samples) == 0:
        return samples, []
    moves = np.nan_to_num(np.ptp(samples.q, axis=0)) > 0.0
    if not moves.any() or np.ptp(samples.v[:, moves], axis=0).any():
        return samples, []
    text = "v is constant while the joints move: not used, differences of q stand in its place"
    return replace(samples, v=None), [Finding("velocity", len(samples), text)]


def _uniform_grid(log: LogDescription, t: Array, invalid: Array, rate: float) -> Grid:
    """Return the grid from the first to the last valid sample; raises UsageError for too few."""
    valid = np.flatnonzero(~invalid & np.isfinite(t))
    if len(valid) < SHORTEST:
        raise UsageError(
            f"{log.source}: {len(valid)} of {len(t)} samples are usable; {SHORTEST} are needed."
        )
    times = np.arange(t[valid[0]], t[valid[-1]] + 0.5 / rate, 1.0 / rate)
    return Grid(times, t[valid], valid, rate)


def _damaged(truncated: int, invalid: Array) -> list[Finding]:
    """Return the findings of a file that broke off, or with values that are not finite."""
    found, count = [], int(invalid.sum())
    if truncated:
        text = "the last line is incomplete and was left out"
        found.append(Finding("non-finite", truncated, text))
    if count:
        first = np.argmax(invalid) + 1
        text = f"samples without numbers: {count} of {len(invalid)}, the first is sample {first}"
        found.append(Finding("non-finite", count, text, count > LONGEST_GAP * len(invalid)))
    return found


def _held(held: Array, standing: int) -> list[Finding]:
    found, count, moving = [], int(held.sum()), len(held) - standing
    if count:
        text = f"samples that repeat the positions before: {count} of {moving} of the motion"
        found.append(Finding("held", count, text, count > log_checks.MANY * moving))
    if standing:
        found.append(Finding("held", standing, f"samples at standstill: {standing}"))
    return found


def _impossible(robot: RobotModel, joints: Sequence[str], samples: Samples) -> list[Finding]:
    """Return contradictions of values that the joints cannot reach in any case."""
    rows = list(map(robot.rows.index, joints))
    low, high = robot.limits.q_low[rows], robot.limits.q_high[rows]
    kind_of = scalar_kinds(robot)
    kinds = [kind_of[joint] for joint in joints]
    fastest = np.array([log_checks.FASTEST[kind] for kind in kinds])
    parts = {
        "q": ("q less its middle", samples.q - 0.5 * (low + high), FAR * 0.5 * (high - low)),
        "v": ("v", samples.v, fastest),
        "tau": ("tau", samples.tau, FAR * robot.limits.tau[rows]),
    }
    found = []
    for signal, (name, x, largest) in parts.items():
        if x is not None:
            # The first unit of its kind is the one of SI.
            units = [next(iter(UNITS[signal][kind])) for kind in kinds]
            found += log_checks.check_limits(name, x, largest, joints, units)
    return found


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
    log: LogDescription, robot: RobotModel, joints: Sequence[str], samples: Samples, grid: Grid
) -> Recording:
    """Return q, v, tau (N, k) of the log's joints in the coordinates of the whole robot, and the
    wrenches of its force/torque sensors."""
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
        period=log.period,
        wrench=samples.wrench,
        wrench_rows=tuple(f"{part.sensor}.{row}" for part in log.wrench for row in COMPONENTS),
    )


def _coordinates(log: LogDescription, raw: Samples, grid: Grid) -> Recording | None:
    """Return all recorded coordinates, without torques; None unless a transmission mixes them."""
    if log.transmission is None:
        return None
    samples, t = raw.at(grid), grid.times - grid.times[0]
    no_torque = np.zeros_like(samples.q)
    return Recording(t=t, q=samples.q, tau=no_torque, rate=grid.rate, rows=log.joints, v=samples.v)
