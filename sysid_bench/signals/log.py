"""From the description of a recorded log to a Recording on a uniform grid, with its findings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import COMPONENTS
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
from sysid_bench.signals.log_source import merge_sources
from sysid_bench.signals.position_control import (
    Commands,
    commands_of,
    unknown_delay,
    with_commanded_torque,
)
from sysid_bench.signals.time_base import LONGEST_GAP, SHORTEST, read_time, time_base
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
    raw = read_samples(description, robot)
    stamps = read_time(description, len(raw))
    invalid = check_finite(*raw.measured)
    t, rate, timing = time_base(description, stamps, invalid)
    grid = _uniform_grid(description, t, invalid, rate)
    raw = with_commanded_torque(description, raw, grid)
    columns = _joint_columns(description)
    joints = tuple(columns)
    measured = raw.columns(list(columns.values()))
    samples = measured.at(grid)
    rates, measured_rate = _rates(samples, rate, joints)
    findings = [
        *_of_files(description, raw, invalid),
        *timing,
        *_held(*held_rows(measured.q[grid.valid], rate)),
        *_lost(samples, stamps),
        *rates,
        *_ranges(robot, joints, samples),
        *unknown_delay(description, len(raw)),
    ]
    recording = _robot_recording(robot, joints, samples, grid)
    recording = replace(recording, period=description.period, **_wrench(description, samples))
    return Log(
        description=description,
        recording=with_controller(recording, description, robot, joints, samples),
        joints=joints,
        findings=tuple(findings),
        measured_rate=measured_rate,
        samples=len(raw),
        coordinates=_coordinates(description, raw, grid),
        raw=raw,
        commands=commands_of(description, raw, grid),
        base=samples.base,
    )


def _wrench(description: LogDescription, samples: Samples) -> dict[str, Any]:
    """Return the fields of a recording for its force/torque sensors."""
    sensors = [part.sensor for part in description.wrench]
    rows = tuple(f"{sensor}.{component}" for sensor in sensors for component in COMPONENTS)
    return {"wrench": samples.wrench, "wrench_rows": rows}


def _of_files(description: LogDescription, raw: Samples, invalid: Array) -> list[Finding]:
    """Return the findings of files: joined, broken off, with values that are not finite."""
    joined = [merge_sources(description).finding] if description.sources else []
    return [*joined, *_broken_off(raw.truncated), *_not_finite(invalid)]


def _joint_columns(log: LogDescription) -> dict[str, int]:
    """Return the column of each recorded coordinate that is a joint of the robot, by its name."""
    return {joint: i for i, joint in enumerate(log.joints) if joint != NO_JOINT}


def _uniform_grid(log: LogDescription, t: Array, invalid: Array, rate: float) -> Grid:
    """Return the grid from the first to the last valid sample; raises UsageError for too few."""
    valid = np.flatnonzero(~invalid & np.isfinite(t))
    if len(valid) < SHORTEST:
        raise UsageError(
            f"{log.source}: {len(valid)} of {len(t)} samples are usable; {SHORTEST} are needed."
        )
    times = np.arange(t[valid[0]], t[valid[-1]] + 0.5 / rate, 1.0 / rate)
    return Grid(times, t[valid], valid, rate)


def _broken_off(truncated: int) -> list[Finding]:
    found = Finding("non-finite", truncated, "the last line is incomplete and was left out")
    return [found] if truncated else []


def _lost(samples: Samples, stamps: Array | None) -> list[Finding]:
    """Return findings of lost samples, which time stamps would show directly."""
    return check_samples(samples.q) if stamps is None else []


def _rates(
    samples: Samples, rate: float, joints: Sequence[str]
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
    text = f"samples without numbers: {count} of {len(invalid)}, the first is sample {first}"
    return [Finding("non-finite", count, text, count > LONGEST_GAP * len(invalid))]


def _held(held: Array, standing: int) -> list[Finding]:
    found, count, moving = [], int(held.sum()), len(held) - standing
    if count:
        text = f"samples that repeat the positions before: {count} of {moving} of the motion"
        found.append(Finding("held", count, text, count > MANY * moving))
    if standing:
        found.append(Finding("held", standing, f"samples at standstill: {standing}"))
    return found


def _ranges(robot: RobotModel, joints: Sequence[str], samples: Samples) -> list[Finding]:
    """Return findings about values impossible for the joint, which are contradictions; without
    them, about positions outside of the limits, which are reported."""
    return _impossible(robot, joints, samples) or _outside(robot, joints, samples.q)


def _impossible(robot: RobotModel, joints: Sequence[str], samples: Samples) -> list[Finding]:
    rows = list(map(robot.rows.index, joints))
    low, high = robot.limits.q_low[rows], robot.limits.q_high[rows]
    kind_of = scalar_kinds(robot)
    kinds = [kind_of[joint] for joint in joints]
    units = {name: _si_units(name, kinds) for name in UNITS}
    middle = 0.5 * (low + high)
    reach = FAR * 0.5 * (high - low)
    found = check_limits("q less its middle", samples.q - middle, reach, joints, units["q"])
    if samples.v is not None:
        fastest = np.array([FASTEST[kind] for kind in kinds])
        found += check_limits("v", samples.v, fastest, joints, units["v"])
    strongest = FAR * robot.limits.tau[rows]
    return found + check_limits("tau", samples.tau, strongest, joints, units["tau"])


def _si_units(name: str, kinds: Sequence[str]) -> list[str]:
    """Return the SI unit of a signal for each joint: the first one of its kind."""
    return [next(iter(UNITS[name][kind])) for kind in kinds]


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
    robot: RobotModel, joints: Sequence[str], samples: Samples, grid: Grid
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


def _coordinates(log: LogDescription, raw: Samples, grid: Grid) -> Recording | None:
    """Return all recorded coordinates, without torques; None unless a transmission mixes them."""
    if log.transmission is None:
        return None
    samples = raw.at(grid)
    return Recording(
        t=grid.times - grid.times[0],
        q=samples.q,
        tau=np.zeros_like(samples.q),
        rate=grid.rate,
        rows=log.joints,
        v=samples.v,
    )
