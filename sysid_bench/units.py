"""Quantities with units: "5 s", "1 kHz", "20 %", "1e-4 rad", "0.05 N m"."""

import math
import re

from sysid_bench.errors import UsageError

# One table per dimension, with the factor to its first name, the SI unit.
_DIMENSIONS: tuple[dict[str, float], ...] = (
    {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0},
    {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6},
    {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0},
    {"rad/s": 1.0, "deg/s": math.pi / 180.0, "rpm": math.pi / 30.0},
    {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6},
    {"kg": 1.0, "g": 1e-3},
    {"N m": 1.0, "Nm": 1.0, "N·m": 1.0, "mN m": 1e-3},
    {"N": 1.0, "kN": 1e3},
    {"B": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9, "MiB": 2.0**20, "GiB": 2.0**30},
    {"1": 1.0, "%": 1e-2},
)
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(\S.*?)?\s*")


def parse_quantity(text: str) -> tuple[float, str]:
    """Return a text as (number, unit as written). Raises UsageError unless finite."""
    match = _QUANTITY.fullmatch(text)
    if match is None or not math.isfinite(float(match[1])):
        raise UsageError(
            f"{text!r} is not a quantity; write a number and a unit, as '5 s' or '20 %'."
        )
    return float(match[1]), match[2] or ""


def quantity(value: object, unit: str) -> float:
    """Return `value` in the SI unit of the dimension of `unit`; a bare number is in `unit`.

    Of alternatives ("rad|m") the first with the dimension of `value` applies. Raises UsageError for
    another unit, or a value that is not finite.
    """
    # True is an int, and no quantity.
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise UsageError(f"{value!r} is not a quantity; write a number with a unit ({unit}).")
    if not isinstance(value, str):
        first = unit.split("|")[0]
        return _finite(value, _dimension(first)[first], value)
    number, written = parse_quantity(value)
    units = unit.split("|")
    # A text without a unit is in the first one.
    name, tables = written or units[0], list(map(_dimension, units))
    factor = next((table[name] for table in tables if name in table), None)
    if factor is None:
        expected = ", ".join(sorted(set().union(*tables)))
        raise UsageError(f"{value!r} has the unit {written!r}; expected one of {expected}.")
    return _finite(number, factor, value)


def check_unit(what: str, text: str, unit: str, is_share: bool = False) -> None:
    """Raise UsageError for a text without a unit where it has a dimension: 5 may be N m or %.
    `is_share`: a percentage may stand for it as well."""
    number, written = parse_quantity(text)
    if written or unit == "1" or number == 0.0:
        return
    names = [name for one in unit.split("|") for name in _dimension(one)] + ["%"] * is_share
    raise UsageError(f"{what}: {text!r} has no unit; write one of {', '.join(names)}.")


def interval(text: object) -> tuple[float, float]:
    """Return (start, end) in seconds of "10 s to 25 s"; raises UsageError for anything else."""
    start, to, end = text.partition(" to ") if isinstance(text, str) else ("", "", "")
    if not to:
        raise UsageError(f"A period is a text like '10 s to 25 s'; got {text!r}.")
    first, last = quantity(start.strip(), "s"), quantity(end.strip(), "s")
    if not first < last:
        raise UsageError(f"The period {text!r} ends before it begins.")
    return first, last


def _dimension(unit: str) -> dict[str, float]:
    table = next((table for table in _DIMENSIONS if unit in table), None)
    if table is None:
        raise UsageError(f"{unit!r} is not a known unit.")
    return table


def _finite(number: float, scale: float, written: float | str) -> float:
    try:
        scaled = float(number) * scale
    except OverflowError:  # an integer beyond the range of floats
        scaled = math.inf
    if not math.isfinite(scaled):
        raise UsageError(f"{written!r} is not finite in SI units; write a number with its unit.")
    return scaled
