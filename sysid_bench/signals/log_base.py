"""Recorded motion of a floating base: columns of a log, read in SI and brought to a grid."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.signals.log_keys import BASE, Base, Signal
from sysid_bench.signals.log_source import select_columns, table_of
from sysid_bench.signals.log_units import UNITS
from sysid_bench.types import Array

_ACCELERATION: Final = {"m/s^2": 1.0, "g": 9.80665}
_UNITS: Final = {
    "orientation": {"1": 1.0},
    "position": UNITS["q"]["slide"],
    "velocity": UNITS["v"]["slide"],
    "angular_velocity": UNITS["v"]["hinge"],
    "acceleration": _ACCELERATION,
    "accelerometer": _ACCELERATION,
}
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


def read_base(log: LogDescription) -> RecordedBase | None:
    """Return the recorded motion of the base; None without one.

    Raises UsageError for files, columns or units that do not exist, another number of columns, and
    for quaternions that are not of unit length.
    """
    if log.base is None:
        return None
    read = {name: _columns(log, name, part) for name, part in log.base.signals.items()}
    lengths = sorted({len(x) for x in read.values()})
    if len(lengths) > 1:
        raise UsageError(f"{log.source}: the signals of base differ in length: {lengths} samples.")
    read["orientation"] = _continuous(log, log.base, read["orientation"])
    return RecordedBase(**read)


def _columns(log: LogDescription, name: str, part: Signal) -> Array:
    """Columns of a signal in SI."""
    table = table_of(log, part)
    values = table.columns(select_columns(log, part, table))
    width = 4 if name == "orientation" else 3
    if values.shape[1] != width:
        raise UsageError(f"{log.source}: base.{name} has {values.shape[1]} columns; write {width}.")
    scale, offset = (_numbers(log, f"base.{name}.{key}", getattr(part, key), width)
                     for key in ("gain", "offset"))  # fmt: skip
    return np.asarray(values * scale * _unit(log, name, part) + offset)


def _numbers(log: LogDescription, key: str, numbers: tuple[float, ...], width: int) -> Array:
    if len(numbers) not in (1, width):
        raise UsageError(f"{log.source}: {key} has {len(numbers)} numbers; write one, or {width}.")
    return np.broadcast_to(np.array(numbers, dtype=float), (width,)).copy()


def _unit(log: LogDescription, name: str, part: Signal) -> float:
    """Value in SI of the unit of all columns."""
    if part.unit is None:
        return 1.0
    if len(set(part.unit)) > 1 or part.unit[0] not in _UNITS[name]:
        wrong = next((unit for unit in part.unit if unit not in _UNITS[name]), ", ".join(part.unit))
        text = unknown_name("unit", wrong, _UNITS[name], "One serves all columns.")
        raise UsageError(f"{log.source}: base.{name}.unit: {text}")
    return _UNITS[name][part.unit[0]]


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
