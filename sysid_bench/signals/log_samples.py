"""Samples of a recording: read from its files, on the joint side and in SI, and resampled."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log_checks import held_rows
from sysid_bench.signals.log_description import NO_JOINT, LogDescription
from sysid_bench.signals.log_keys import (
    BASE,
    COMMANDED,
    GAIN_ADVICE,
    SIGNALS,
    TOLD,
    Base,
    Signal,
    Wrench,
)
from sysid_bench.signals.log_source import read_columns
from sysid_bench.types import Array

_ANGLE: Final = {"rad": 1.0, "deg": np.pi / 180.0, "mrad": 1e-3}
_LENGTH: Final = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_CURRENT: Final = {"A": 1.0, "mA": 1e-3}
_TORQUE: Final = {"N m": 1.0, "Nm": 1.0, "N·m": 1.0, "mN m": 1e-3, "mNm": 1e-3}
_FORCE: Final = {"N": 1.0, "kN": 1e3}
_SPEED: Final = {f"{unit}/s": scale for unit, scale in _LENGTH.items()}
_RATE: Final = {f"{unit}/s": scale for unit, scale in _ANGLE.items()} | {"rpm": np.pi / 30.0}
_ACCELERATION: Final = {"m/s^2": 1.0, "g": 9.80665}
UNITS: Final[Mapping[str, Mapping[str, Mapping[str, float]]]] = {
    "q": {"hinge": _ANGLE, "slide": _LENGTH},
    "v": {"hinge": _RATE, "slide": _SPEED},
    "tau": {"hinge": _TORQUE | _CURRENT, "slide": _FORCE | _CURRENT},
}
"""Units of a signal by kind of joint, each with its value in SI; a current needs a gain."""

_WRENCH_UNITS: Final = {"force": _FORCE, "moment": _TORQUE}
_BASE_UNITS: Final = {
    "orientation": {"1": 1.0},
    "position": _LENGTH,
    "velocity": _SPEED,
    "angular_velocity": _RATE,
    "acceleration": _ACCELERATION,
    "accelerometer": _ACCELERATION,
}
_KIND_OF: Final = {"q_ref": "q", "v_ref": "v", "q_des": "q", "v_des": "v", "feedforward": "tau"}
"""Signals that have the units of another one."""

_LENGTH_ERROR: Final = 0.01
"""Of a quaternion, whose length is 1: rounding to two digits is let pass."""


@dataclass(frozen=True, eq=False)
class RecordedBase:
    """Motion of a base in the world: `orientation` (N, 4), quaternions [w, x, y, z] that do not
    change their sign; as far as recorded (N, 3): `position` (m), `velocity` of its origin (m/s),
    `angular_velocity` in its own axes (rad/s), `acceleration` of its origin (m/s^2), and
    `accelerometer`, that less gravity in its own axes."""

    orientation: Array
    position: Array | None = None
    velocity: Array | None = None
    angular_velocity: Array | None = None
    acceleration: Array | None = None
    accelerometer: Array | None = None

    @property
    def signals(self) -> dict[str, Array]:
        """Recorded signals by name."""
        parts: dict[str, Array | None] = {name: getattr(self, name) for name in BASE}
        return {name: x for name, x in parts.items() if x is not None}

    def apply(self, change: Callable[[Array], Array]) -> "RecordedBase":
        """Return the motion with each signal changed alike."""
        return RecordedBase(**{name: change(x) for name, x in self.signals.items()})


@dataclass(frozen=True, eq=False)
class Grid:
    """Uniform `times` (M,) at `rate` (Hz), and times t (n,) of the `valid` samples (n,), all in the
    log's own time (s)."""

    times: Array
    t: Array
    valid: Array
    rate: float

    def interpolated(self, x: Array) -> Array:
        """Return samples x (N, k) at the times of the grid (M, k), linear between valid ones."""
        columns = x[self.valid].T
        return np.stack([np.interp(self.times, self.t, column) for column in columns], axis=1)


@dataclass(frozen=True, eq=False)
class Samples:
    """q, v, tau (N, k) of the recorded coordinates in SI, and the commanded q_ref and v_ref where a
    controller tracks them; `truncated`: lines that broke off. Of a position controller whose torque
    replaces the measured one: q_des, v_des, feedforward, kp, kd as far as they are recorded, and
    the `magnitude` of currents or torques without sign.
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
    magnitude: Array | None = None
    wrench: Array | None = None
    base: RecordedBase | None = None

    def __len__(self) -> int:
        return len(self.q)

    @property
    def signals(self) -> dict[str, Array]:
        """Recorded signals by name."""
        names = (*SIGNALS, *COMMANDED, *TOLD)
        parts: dict[str, Array | None] = {name: getattr(self, name) for name in names}
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
            name: _held(grid, x) if name in TOLD else _without_held(grid, x[grid.valid])
            for name, x in self.signals.items()
        }
        if self.wrench is not None:
            at["wrench"] = _without_held(grid, self.wrench[grid.valid])
        if self.base is not None:
            at["base"] = self.base.apply(grid.interpolated)
        return replace(self, **at)


def _without_held(grid: Grid, x: Array) -> Array:
    """Return x (n, k) of the valid samples at the times of the grid, linear between samples.

    Held rows are left out: a drive that repeats its last value has not measured one.
    """
    kept = ~held_rows(x, 1.0 / np.median(np.diff(grid.t)))[0]
    columns = [np.interp(grid.times, grid.t[kept], column[kept]) for column in x.T]
    return np.stack(columns, axis=1)


def _held(grid: Grid, x: Array) -> Array:
    """Return commands x (n, k) at the times of the grid: each until the next one."""
    # Stamps of a grid are computed, and differ from those of the log by rounding.
    late = np.searchsorted(grid.t, grid.times + 1e-6 / grid.rate, side="right") - 1
    return np.asarray(x[grid.valid][np.maximum(late, 0)])


def scalar_kinds(robot: RobotModel) -> dict[str, str]:
    """Return hinge or slide of each joint of the robot that is one of them, by name."""
    return {j.dofs[0]: j.kind for j in robot.joints if j.kind in ("hinge", "slide")}


def read_samples(log: LogDescription, robot: RobotModel) -> Samples:
    """Return the chosen samples of all recorded coordinates, joint side, in SI.

    Raises UsageError for files, columns, units or joints that do not exist.
    """
    known = scalar_kinds(robot)
    for joint in log.joints:
        if joint not in (NO_JOINT, *known):
            advice = f"Write {NO_JOINT!r} for a coordinate that is not a joint of the model."
            raise UsageError(f"{log.source}: {unknown_name('joint', joint, known, advice)}")
    samples = _read_signals(log, [known.get(joint, "") for joint in log.joints])
    if log.transmission is not None:
        samples = _joint_side(log.transmission, samples)
    # Offsets are those of the joint, so they come after the transmission.
    signals = samples.signals
    moved: dict[str, Any] = {
        name: signals[name] + log.joint_values(f"{name}.offset", part.offset)
        for name, part in log.signals.items()
    }
    first, last = (1, len(samples)) if log.rows is None else log.rows
    if last > len(samples):
        raise UsageError(
            f"{log.source}: rows = [{first}, {last}], but there are {len(samples)} samples."
        )
    end = first - 1 + max(1, round(log.share * (last - first + 1)))
    return replace(samples, **moved).select(slice(first - 1, end))


def _joint_side(G: Array, motor: Samples) -> Samples:
    """Return the signals behind a transmission q = G q_motor."""
    if motor.q_des is not None:
        raise UsageError(
            "tau.pd is the torque of the joints, and does not pass a transmission; write q, q_des "
            "and the gains of the joints, and leave transmission out."
        )
    # Samples are rows, so that q = G q_motor becomes a product with G' from the right.
    joint = motor.apply(lambda x: x @ G.T)
    # tau_motor = G' tau, from equal power on both sides.
    return replace(joint, tau=np.linalg.solve(G.T, motor.tau.T).T)


def _read_signals(log: LogDescription, kinds: Sequence[str]) -> Samples:
    """Return q, v, tau as scaled by the description, cut to the samples that all signals have:
    separate files may differ by the line that broke off. `kinds`: hinge or slide of each
    coordinate, "" where it is not a joint."""
    values: dict[str, Any] = {"v": None}
    truncated = 0
    for name, part in log.signals.items():
        table, x = read_columns(log, part)
        if name == "q" and table.unit_doubt and part.unit is None and part.gain == (1.0,):
            raise UsageError(f"{log.source}: unit of q: {table.unit_doubt}.")
        if x.shape[1] != len(log.joints):
            raise UsageError(
                f"{log.source}: {name} has {x.shape[1]} columns for {len(log.joints)} joints; "
                f"write one column for each of {', '.join(log.joints)}."
            )
        values[name] = x * _unit_scale(log, name, part, kinds)
        if part.unwrap:
            ratio = log.joint_values(f"{name}.ratio", part.ratio)
            values[name] = _unwrapped(values[name], ratio, kinds)
        truncated = max(truncated, table.truncated)
    lengths = {name: len(values[name]) for name in log.signals}
    # The torque of a position controller follows once the signals are on the joint side.
    values.setdefault("tau", np.zeros_like(values["q"]))
    samples = Samples(**values, truncated=truncated, wrench=_read_wrench(log), base=_read_base(log))
    if samples.wrench is not None:
        lengths["wrench"] = len(samples.wrench)
    if samples.base is not None:
        lengths["base"] = len(samples.base.orientation)
    shortest = min(lengths.values())
    if max(lengths.values()) > shortest + 1:
        listed = ", ".join(f"{name} {n}" for name, n in lengths.items())
        raise UsageError(f"{log.source}: the signals differ in length: {listed} samples.")
    return samples.select(slice(shortest))


def _unwrapped(x: Array, ratio: Array, kinds: Sequence[str]) -> Array:
    """Return x (N, k), of hinges without jumps by a turn of their encoders, which is
    2 pi / ratio."""
    valid = np.isfinite(x)
    for j in (j for j, kind in enumerate(kinds) if kind != "slide"):
        angles = x[valid[:, j], j]
        x[valid[:, j], j] = np.unwrap(angles, period=2 * np.pi / abs(ratio[j]))
    return x


def _unit_scale(log: LogDescription, name: str, part: Signal, kinds: Sequence[str]) -> Array:
    """Return the factors (k,) from a file's numbers to SI: unit, gain and ratio together.

    Raises UsageError for a unit that does not fit the joint, or a current without a gain.
    """
    gain = log.joint_values(f"{name}.gain", part.gain)
    ratio = log.joint_values(f"{name}.ratio", part.ratio)
    quantity = _KIND_OF.get(name, name)
    # Power is conserved through a gear: it divides speed and multiplies torque.
    factors = np.asarray(gain * ratio if quantity == "tau" else gain / ratio)
    # Gain and ratio alone describe counts of an encoder or a converter, which have no unit.
    if part.unit is None:
        return factors
    if name == "magnitude":  # its factor to a torque is an answer
        return factors
    if quantity not in UNITS:
        raise UsageError(
            f"{log.source}: tau.pd.{name} is in N m/rad or N m s/rad (N/m, N s/m) and has no unit; "
            "write gain = the value of one in these."
        )
    units = part.unit * len(kinds) if len(part.unit) == 1 else part.unit
    every = {**UNITS[quantity]["hinge"], **UNITS[quantity]["slide"]}
    sizes = []
    for joint, unit, kind in zip(log.joints, units, kinds, strict=True):
        fitting = UNITS[quantity].get(kind, every)
        where = f"{log.source}: {name}.unit of joint {joint!r}"
        if unit not in every:
            raise UsageError(f"{where}: {unknown_name('unit', unit, fitting)}")
        if unit not in fitting:
            movement = "turns" if kind == "hinge" else "slides"
            raise UsageError(
                f"{where}: {unit!r} does not fit, since it {movement}; write one unit for each "
                f"joint, here one of {', '.join(fitting)}."
            )
        if unit in _CURRENT and "gain" not in part.model_fields_set:
            raise UsageError(f"{log.source}: {name} is a current in {unit}: {GAIN_ADVICE}.")
        sizes.append(fitting[unit])
    return factors * sizes


def _sensor_columns(
    log: LogDescription, part: Signal, where: str, width: int, advice: str
) -> tuple[Array, Array, Array]:
    """Return columns (N, width) of a sensor, and the gain and the offset (width,) of each."""
    _, values = read_columns(log, part)
    if values.shape[1] != width:
        raise UsageError(
            f"{log.source}: {where} has {values.shape[1]} columns; write {width}{advice}."
        )
    for key in ("gain", "offset"):
        if len(getattr(part, key)) not in (1, width):
            raise UsageError(
                f"{log.source}: {key} of {where} has {len(getattr(part, key))} numbers; write one, "
                f"or {width}."
            )
    gain, offset = (np.broadcast_to(numbers, (width,)) for numbers in (part.gain, part.offset))
    return values, gain, offset


def _read_wrench(log: LogDescription) -> Array | None:
    """Return the wrenches [n; f] (N, 6 sensors) of all sensors, in N m and N; None without one."""
    if not log.wrench:
        return None
    parts = [_sensor_wrench(log, part) for part in log.wrench]
    lengths = sorted({len(part) for part in parts})
    if len(lengths) > 1:
        raise UsageError(f"{log.source}: the wrenches differ in length: {lengths} samples.")
    return np.hstack(parts)


def _sensor_wrench(log: LogDescription, part: Wrench) -> Array:
    """The wrench (N, 6) of one sensor, moments first."""
    where = f"the wrench of {part.sensor!r}"
    advice = ": fx, fy, fz, mx, my, mz, or with first = 'moment' the moments before the forces"
    values, gain, offset = _sensor_columns(log, part, where, 6, advice)
    # Two units are those of the first and of the last three columns.
    units = part.unit or ()
    units = (*units[:1] * 3, *units[1:] * 3) if len(units) == 2 else units
    if len(units) not in (0, 6):
        raise UsageError(
            f"{log.source}: unit of {where} has {len(units)} words; write two, of the first and of "
            "the last three columns, or six."
        )
    kinds = [part.first] * 3 + ["moment" if part.first == "force" else "force"] * 3
    sizes = np.ones(6)
    for i, unit in enumerate(units):
        known = _WRENCH_UNITS[kinds[i]]
        if unit not in known:
            text = unknown_name("unit", unit, known)
            raise UsageError(f"{log.source}: unit of {where}, a {kinds[i]}: {text}")
        sizes[i] = known[unit]
    values = values * (gain * sizes) + offset
    return values if part.first == "moment" else np.roll(values, 3, axis=1)


def _read_base(log: LogDescription) -> RecordedBase | None:
    """Return the recorded motion of the base; None without one.

    Raises UsageError for another number of columns, and for quaternions that are not of unit
    length.
    """
    if log.base is None:
        return None
    read = {}
    for name, part in log.base.signals.items():
        width, known = 4 if name == "orientation" else 3, _BASE_UNITS[name]
        values, gain, offset = _sensor_columns(log, part, f"base.{name}", width, "")
        units = part.unit or tuple(known)[:1]
        wrong = [unit for unit in units if unit not in known]
        if wrong or len(set(units)) > 1:
            named = wrong[0] if wrong else ", ".join(units)
            text = unknown_name("unit", named, known, "One serves all columns.")
            raise UsageError(f"{log.source}: base.{name}.unit: {text}")
        read[name] = np.asarray(values * gain * known[units[0]] + offset)
    lengths = sorted({len(x) for x in read.values()})
    if len(lengths) > 1:
        raise UsageError(f"{log.source}: the signals of base differ in length: {lengths} samples.")
    read["orientation"] = _continuous(log, log.base, read["orientation"])
    return RecordedBase(**read)


def _continuous(log: LogDescription, base: Base, quaternions: Array) -> Array:
    """Quaternions [w, x, y, z] of unit length without changes of sign; NaN where they are."""
    q = np.roll(quaternions, 1, axis=1) if base.order == "xyzw" else quaternions
    length = np.linalg.norm(q, axis=1, keepdims=True)
    wrong = np.flatnonzero(np.abs(length[:, 0] - 1.0) > _LENGTH_ERROR)
    if len(wrong):
        raise UsageError(
            f"{log.source}: base.orientation is a quaternion of length 1; in sample {wrong[0] + 1} "
            f"its length is {length[wrong[0], 0]:.4g}. Check its columns."
        )
    q = q / length
    flips = np.sum(q[1:] * q[:-1], axis=1) < 0.0
    # q and -q are one rotation; interpolation across a change of sign would pass through zero.
    q[1:] *= np.where(np.cumsum(flips) % 2 == 1, -1.0, 1.0)[:, None]
    return np.asarray(q)
