"""Units of a recording's signals, and the factors from the numbers of a file to SI."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.signals.log_keys import Signal
from sysid_bench.types import Array

_ANGLE: Final = {"rad": 1.0, "deg": np.pi / 180.0, "mrad": 1e-3}
_LENGTH: Final = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_CURRENT: Final = {"A": 1.0, "mA": 1e-3}
TORQUE: Final = {"N m": 1.0, "Nm": 1.0, "N·m": 1.0, "mN m": 1e-3, "mNm": 1e-3}
FORCE: Final = {"N": 1.0, "kN": 1e3}
_SPEED: Final = {f"{unit}/s": scale for unit, scale in _LENGTH.items()}
_RATE: Final = {f"{unit}/s": scale for unit, scale in _ANGLE.items()} | {"rpm": np.pi / 30.0}
UNITS: Final[Mapping[str, Mapping[str, Mapping[str, float]]]] = {
    "q": {"hinge": _ANGLE, "slide": _LENGTH},
    "v": {"hinge": _RATE, "slide": _SPEED},
    "tau": {"hinge": TORQUE | _CURRENT, "slide": FORCE | _CURRENT},
}
"""Units of a signal by kind of joint, each with its value in SI; a current needs a gain."""


_GAINS: Final = ("kp", "kd")
_KIND_OF: Final = {"q_ref": "q", "v_ref": "v", "q_des": "q", "v_des": "v", "feedforward": "tau"}
"""Signals that have the units of another one."""


def unit_scale(log: LogDescription, name: str, part: Signal, kinds: Sequence[str]) -> Array:
    """Return the factors (k,) from a file's numbers to SI: unit, gain and ratio together.

    `kinds`: hinge or slide of each coordinate, "" where it is not a joint. Raises UsageError for a
    unit that does not fit the joint, or a current without a gain.
    """
    gain = log.joint_values(f"{name}.gain", part.gain)
    ratio = log.joint_values(f"{name}.ratio", part.ratio)
    is_torque = _KIND_OF.get(name, name) == "tau"
    # Power is conserved through a gear: it divides speed and multiplies torque.
    factors = np.asarray(gain * ratio if is_torque else gain / ratio)
    if part.unit is None:
        return factors
    if name in _GAINS:
        raise UsageError(
            f"{log.source}: tau.pd.{name} is in N m/rad or N m s/rad (N/m, N s/m) and has no unit; "
            "write gain = the value of one in these."
        )
    # Gain and ratio alone describe counts of an encoder or a converter, which have no unit.
    units = part.unit * len(kinds) if len(part.unit) == 1 else part.unit
    joints = zip(log.joints, units, kinds, strict=True)
    return factors * [_unit_size(log, name, part, *joint) for joint in joints]


def _unit_size(
    log: LogDescription, name: str, part: Signal, joint: str, unit: str, kind: str
) -> float:
    """Return the value in SI of the unit of one coordinate."""
    units = UNITS[_KIND_OF.get(name, name)]
    all_units = {**units["hinge"], **units["slide"]}
    fitting = units.get(kind, all_units)
    if unit not in fitting:
        where = f"{log.source}: {name}.unit of joint {joint!r}"
        raise _unit_error(where, unit, fitting, kind, unit in all_units)
    if unit in _CURRENT and part.gain == (1.0,):
        raise UsageError(
            f"{log.source}: {name} is a current in {unit}; write gain = [...] in N m/A (or N/A)"
            ", and ratio = [...] where it is the motor's."
        )
    return fitting[unit]


def _unit_error(
    where: str, unit: str, fitting: Mapping[str, float], kind: str, known: bool
) -> UsageError:
    """Return the error of a unit that is not known, or is that of another kind of joint."""
    if not known:
        return UsageError(f"{where}: {unknown_name('unit', unit, fitting)}")
    movement = "turns" if kind == "hinge" else "slides"
    return UsageError(
        f"{where}: {unit!r} does not fit, since it {movement}; write one unit for each joint, "
        f"here one of {', '.join(fitting)}."
    )
