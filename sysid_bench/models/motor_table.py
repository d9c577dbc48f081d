"""Tables of motors: files `motors/*.toml`, those of ./motors before the installed ones."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from sysid_bench import package_folders
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.input_files import read_toml
from sysid_bench.models.manifest import NotNegative, Positive
from sysid_bench.units import quantity

SPREAD: Final = 0.2
"""Relative deviation of an armature from a table: hubs, gears and shafts are often left out."""


def _several(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else (value,)


def _speed(value: Any) -> Any:
    try:
        return quantity(value, "rad/s")
    except UsageError as error:
        raise ValueError(str(error).rstrip(".")) from error


_Speed = Annotated[Positive, BeforeValidator(_speed)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class MotorKeys(_Table):
    """A motor with its gear; torques and speeds are those behind the gear."""

    title: str = ""  # one line about the motor
    ratio: Annotated[tuple[Positive, ...], BeforeValidator(_several)] = (1.0,)
    """Of the gear, or of each of its stages from the motor on."""
    rotor_inertia: Annotated[tuple[NotNegative, ...], BeforeValidator(_several)] | None = None
    """kg m^2, before the gear; with stages, of the rotor and behind each stage."""
    spread: Positive = SPREAD  # relative deviation of the armature from these
    peak_torque: Positive  # N m
    rated_torque: Positive | None = None  # N m
    no_load_speed: _Speed | None = None  # rad/s, or "200 rpm"
    rated_speed: _Speed | None = None  # rad/s, at the rated torque
    peak_current: Positive | None = None  # A
    torque_constant: Positive | None = None  # N m/A


class MotorFile(_Table):
    """A file of motors."""

    source: str = ""  # where the numbers come from
    motor: dict[str, MotorKeys] = Field(min_length=1)


@dataclass(frozen=True)
class Motor:
    """A motor of a table: `armature` (kg m^2), inertias times squared ratios, NaN where they are
    not listed, with its relative `spread`; `peak_torque` (N m); the line of torque over speed
    falls from `stall_torque` (N m) to zero at `no_load_speed` (rad/s), both infinite where no
    rated point and no speed are listed."""

    name: str
    file: Path
    keys: MotorKeys

    @property
    def armature(self) -> float:
        """Inertia that a joint feels (kg m^2)."""
        inertias = self.keys.rotor_inertia
        if inertias is None:
            return float("nan")
        behind = np.append(np.cumprod(self.keys.ratio[::-1])[::-1], 1.0)
        return float(np.sum(np.array(inertias) * behind[: len(inertias)] ** 2))

    @property
    def no_load_speed(self) -> float:
        """Speed without load (rad/s)."""
        return float("inf") if self.keys.no_load_speed is None else self.keys.no_load_speed

    @property
    def stall_torque(self) -> float:
        """Torque (N m) at rest of the lowest line to the speed without load below which both the
        rated point and the peak torque lie: a rated point may be one of heat, not of voltage."""
        keys = self.keys
        if keys.no_load_speed is None or keys.rated_speed is None or keys.rated_torque is None:
            return float("inf")
        rated = keys.rated_torque / (1.0 - keys.rated_speed / keys.no_load_speed)
        return max(rated, keys.peak_torque)


def read_motors(file: Path) -> dict[str, Motor]:
    """Return the motors of a file by name; raises UsageError with all its mistakes."""
    try:
        found = MotorFile.model_validate(read_toml(file, UsageError))
    except ValidationError as error:
        mistakes = "; ".join(
            f"{'.'.join(map(str, one['loc']))}: {one['msg'].removeprefix('Value error, ')}"
            for one in error.errors()
        )
        raise UsageError(f"{file}: {mistakes}.") from error
    for name, keys in found.motor.items():
        stages = len(keys.rotor_inertia or (0.0,))
        if stages not in (1, len(keys.ratio) + 1):
            raise UsageError(
                f"{file}: motor.{name}.rotor_inertia has {stages} numbers for {len(keys.ratio)} "
                "ratios; write that of the rotor, or one more than there are ratios."
            )
        fast, rated = keys.no_load_speed, keys.rated_speed
        if fast is not None and rated is not None and not rated < fast:
            raise UsageError(
                f"{file}: motor.{name}.rated_speed must be below no_load_speed; got {rated:.4g} "
                f"and {fast:.4g} rad/s."
            )
    return {name: Motor(name, file, keys) for name, keys in found.motor.items()}


def motor_names() -> Mapping[str, Motor]:
    """Return all motors by name; raises UsageError for a file that cannot be read."""
    found: dict[str, Motor] = {}
    for file in package_folders.motor_files().values():
        found = {**read_motors(file), **found}
    return found


def motor(name: str) -> Motor:
    """Return the motor of a name; raises UsageError where there is none."""
    known = motor_names()
    if name not in known:
        raise unknown_name("motor", name, known, "Or describe it in a file ./motors/NAME.toml.")
    return known[name]
