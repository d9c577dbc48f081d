"""Columns of force/torque sensors in a recording."""

from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.signals.log_keys import Wrench
from sysid_bench.signals.log_source import select_columns, table_of
from sysid_bench.signals.log_units import FORCE, TORQUE
from sysid_bench.types import Array

_UNITS: Final = {"force": FORCE, "moment": TORQUE}


def read_wrench(log: LogDescription) -> Array | None:
    """Return the wrenches [n; f] (N, 6 sensors) of all sensors, in N m and N; None without one.

    Raises UsageError for files, columns or units that do not exist, and for another number of
    columns than six.
    """
    if not log.wrench:
        return None
    parts = [_sensor_wrench(log, part) for part in log.wrench]
    lengths = sorted({len(part) for part in parts})
    if len(lengths) > 1:
        raise UsageError(f"{log.source}: the wrenches differ in length: {lengths} samples.")
    return np.hstack(parts)


def _sensor_wrench(log: LogDescription, part: Wrench) -> Array:
    """The wrench (N, 6) of one sensor, moments first."""
    table = table_of(log, part)
    values = table.columns(select_columns(log, part, table))
    if values.shape[1] != 6:
        raise UsageError(
            f"{log.source}: the wrench of {part.sensor!r} has {values.shape[1]} columns; write "
            "six: fx, fy, fz, mx, my, mz, or with first = 'moment' the moments before the forces."
        )
    last = "moment" if part.first == "force" else "force"
    kinds = [str(kind) for kind in (part.first, last) for _ in range(3)]
    scale = _six(log, part, "gain", part.gain) * _unit_sizes(log, part, kinds)
    values = values * scale + _six(log, part, "offset", part.offset)
    return values if part.first == "moment" else np.roll(values, 3, axis=1)


def _six(log: LogDescription, part: Wrench, name: str, numbers: tuple[float, ...]) -> Array:
    """One number for each column."""
    if len(numbers) not in (1, 6):
        raise UsageError(
            f"{log.source}: {name} of the wrench of {part.sensor!r} has {len(numbers)} numbers; "
            "write one, or six."
        )
    return np.broadcast_to(np.array(numbers, dtype=float), (6,)).copy()


def _unit_sizes(log: LogDescription, part: Wrench, kinds: list[str]) -> Array:
    """Values in SI of the units of the columns: SI where none is written; two or six of them."""
    if part.unit is None:
        return np.ones(6)
    units = tuple(part.unit)
    if len(units) == 2:
        units = (*units[:1] * 3, *units[1:] * 3)
    if len(units) != 6:
        raise UsageError(
            f"{log.source}: unit of the wrench of {part.sensor!r} has {len(part.unit)} words; "
            "write two, of the first and of the last three columns, or six."
        )
    sizes = []
    for kind, unit in zip(kinds, units, strict=True):
        if unit not in _UNITS[kind]:
            where = f"{log.source}: unit of the wrench of {part.sensor!r}, a {kind}"
            raise UsageError(f"{where}: {unknown_name('unit', unit, _UNITS[kind])}")
        sizes.append(_UNITS[kind][unit])
    return np.array(sizes)
