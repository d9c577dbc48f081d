"""Samples of a recording: read from its files, on the joint side and in SI, and resampled."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log_base import RecordedBase, read_base
from sysid_bench.signals.log_checks import held_rows
from sysid_bench.signals.log_description import NO_JOINT, LogDescription
from sysid_bench.signals.log_keys import COMMANDED, SIGNALS, TOLD, Signal
from sysid_bench.signals.log_source import select_columns, table_of
from sysid_bench.signals.log_units import unit_scale
from sysid_bench.signals.log_wrench import read_wrench
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class Grid:
    """Uniform `times` (M,) at `rate` (Hz), and times t (n,) of the `valid` samples (n,), all in the
    log's own time (s)."""

    times: Array
    t: Array
    valid: Array
    rate: float


@dataclass(frozen=True, eq=False)
class Samples:
    """q, v, tau (N, k) of the recorded coordinates in SI, and the commanded q_ref and v_ref where a
    controller tracks them; `truncated`: lines that broke off. Of a position controller whose torque
    replaces the measured one: q_des, v_des, feedforward, kp, kd as far as they are recorded.
    `wrench` (N, 6 sensors): [n; f] of each force/torque sensor, N m and N. `base`: recorded motion
    of a floating base."""

    q: Array
    v: Array | None
    tau: Array
    truncated: int = 0
    q_ref: Array | None = None
    v_ref: Array | None = None
    q_des: Array | None = None
    v_des: Array | None = None
    feedforward: Array | None = None
    kp: Array | None = None
    kd: Array | None = None
    wrench: Array | None = None
    base: RecordedBase | None = None

    def __len__(self) -> int:
        return len(self.q)

    @property
    def signals(self) -> dict[str, Array]:
        """Recorded signals by name."""
        parts: dict[str, Array | None] = {
            name: getattr(self, name) for name in (*SIGNALS, *COMMANDED, *TOLD)
        }
        return {name: x for name, x in parts.items() if x is not None}

    @property
    def measured(self) -> list[Array]:
        """Recorded signals, those of force/torque sensors and of the base among them."""
        of_base = [] if self.base is None else self.base.signals.values()
        return [*self.signals.values(), *([] if self.wrench is None else [self.wrench]), *of_base]

    def apply(self, change: Callable[[Array], Array]) -> "Samples":
        """Return the samples with each signal changed alike."""
        changed: dict[str, Any] = {name: change(x) for name, x in self.signals.items()}
        return replace(self, **changed)

    def select(self, rows: slice) -> "Samples":
        """Return some of the samples."""
        wrench = None if self.wrench is None else self.wrench[rows]
        base = None if self.base is None else self.base.apply(lambda x: x[rows])
        return replace(self.apply(lambda x: x[rows]), wrench=wrench, base=base)

    def columns(self, columns: Sequence[int]) -> "Samples":
        """Return some of the coordinates."""
        return self.apply(lambda x: x[:, columns])

    def at(self, grid: Grid) -> "Samples":
        """Return the signals at the times of a grid: commands held, others by linear
        interpolation."""
        at: dict[str, Any] = {
            name: _held(grid, x) if name in TOLD else _interpolated(grid, x[grid.valid])
            for name, x in self.signals.items()
        }
        if self.wrench is not None:
            at["wrench"] = _interpolated(grid, self.wrench[grid.valid])
        if self.base is not None:
            at["base"] = self.base.apply(lambda x: _linear(grid, x[grid.valid]))
        return replace(self, **at)


def _interpolated(grid: Grid, x: Array) -> Array:
    """Return x (n, k) of the valid samples at the times of the grid, linear between samples.

    Held rows are left out: a drive that repeats its last value has not measured one.
    """
    t = grid.t
    kept = ~held_rows(x, 1.0 / np.median(np.diff(t)))[0]
    return np.stack([np.interp(grid.times, t[kept], column[kept]) for column in x.T], axis=1)


def _linear(grid: Grid, x: Array) -> Array:
    """Return x (n, k) of the valid samples at the times of the grid, linear between samples."""
    return np.stack([np.interp(grid.times, grid.t, column) for column in x.T], axis=1)


def _held(grid: Grid, x: Array) -> Array:
    """Return commands x (n, k) at the times of the grid: each until the next one."""
    # Stamps of a grid are computed, and differ from those of the log by rounding.
    late = np.searchsorted(grid.t, grid.times + 1e-6 / grid.rate, side="right") - 1
    return np.asarray(x[grid.valid][np.maximum(late, 0)])


def read_samples(log: LogDescription, robot: RobotModel) -> Samples:
    """Return the chosen samples of all recorded coordinates, joint side, in SI.

    Raises UsageError for files, columns, units or joints that do not exist.
    """
    motor_side = _cut_to_shortest(log, _read_signals(log, _kinds(log, robot)))
    # Offsets are those of the joint, so they come after the transmission.
    samples = _with_offsets(log, _joint_side(log.transmission, motor_side))
    return samples.select(_selected_rows(log, len(samples)))


def _joint_side(G: Array | None, motor: Samples) -> Samples:
    """Return the signals behind a transmission q = G q_motor; without one they are those given."""
    if G is None:
        return motor
    if motor.q_des is not None:
        raise UsageError(
            "tau.pd is the torque of the joints, and does not pass a transmission; write q, q_des "
            "and the gains of the joints, and leave transmission out."
        )
    # Samples are rows, so that q = G q_motor becomes a product with G' from the right.
    joint = motor.apply(lambda x: x @ G.T)
    # tau_motor = G' tau, from equal power on both sides.
    return replace(joint, tau=np.linalg.solve(G.T, motor.tau.T).T)


def _with_offsets(log: LogDescription, samples: Samples) -> Samples:
    offset = {
        name: log.joint_values(f"{name}.offset", part.offset) for name, part in log.signals.items()
    }
    signals = samples.signals
    return replace(samples, **{name: signals[name] + x for name, x in offset.items()})


def _read_signals(log: LogDescription, kinds: Sequence[str]) -> Samples:
    """Return q, v, tau as scaled by the description, each of the length of its own file."""
    read = {name: _columns(log, name, part, kinds) for name, part in log.signals.items()}
    values: dict[str, Any] = {"v": None, **{name: x for name, (x, _) in read.items()}}
    # The torque of a position controller follows once the signals are on the joint side.
    values.setdefault("tau", np.zeros_like(values["q"]))
    wrench, base = read_wrench(log), read_base(log)
    truncated = max(count for _, count in read.values())
    return Samples(**values, truncated=truncated, wrench=wrench, base=base)


def _lengths(log: LogDescription, samples: Samples) -> dict[str, int]:
    lengths = {name: len(x) for name, x in samples.signals.items() if name in log.signals}
    if samples.wrench is not None:
        lengths["wrench"] = len(samples.wrench)
    if samples.base is not None:
        lengths["base"] = len(samples.base.orientation)
    return lengths


def _cut_to_shortest(log: LogDescription, samples: Samples) -> Samples:
    """Return the samples that all signals have; separate files may differ by the broken line."""
    lengths = _lengths(log, samples)
    shortest = min(lengths.values())
    if max(lengths.values()) > shortest + 1:
        listed = ", ".join(f"{name} {n}" for name, n in lengths.items())
        raise UsageError(f"{log.source}: the signals differ in length: {listed} samples.")
    return samples.select(slice(shortest))


def _columns(
    log: LogDescription, name: str, part: Signal, kinds: Sequence[str]
) -> tuple[Array, int]:
    table = table_of(log, part)
    if name == "q" and table.unit_doubt and part.unit is None and part.gain == (1.0,):
        raise UsageError(f"{log.source}: unit of q: {table.unit_doubt}.")
    values = table.columns(select_columns(log, part, table))
    if values.shape[1] != len(log.joints):
        raise UsageError(
            f"{log.source}: {name} has {values.shape[1]} columns for {len(log.joints)} joints; "
            f"write one column for each of {', '.join(log.joints)}."
        )
    return values * unit_scale(log, name, part, kinds), table.truncated


def _selected_rows(log: LogDescription, samples: int) -> slice:
    first, last = (1, samples) if log.rows is None else log.rows
    if last > samples:
        raise UsageError(
            f"{log.source}: rows = [{first}, {last}], but there are {samples} samples."
        )
    return slice(first - 1, first - 1 + max(1, round(log.share * (last - first + 1))))


def scalar_kinds(robot: RobotModel) -> dict[str, str]:
    """Return hinge or slide of each joint of the robot that is one of them, by name."""
    return {j.dofs[0]: j.kind for j in robot.joints if j.kind in ("hinge", "slide")}


def _kinds(log: LogDescription, robot: RobotModel) -> list[str]:
    """Return hinge or slide of each coordinate of the log, "" where it is not a joint."""
    known = scalar_kinds(robot)
    for joint in log.joints:
        if joint not in (NO_JOINT, *known):
            advice = f"Write {NO_JOINT!r} for a coordinate that is not a joint of the model."
            raise UsageError(f"{log.source}: {unknown_name('joint', joint, known, advice)}")
    return [known.get(joint, "") for joint in log.joints]
