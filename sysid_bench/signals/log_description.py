"""Description of a recording of a real robot: the TOML file of `identify --log LOG.toml`."""

import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Annotated, Any, Final

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.naming import resolve_paths
from sysid_bench.signals.log_reader import ReaderSpec, plugin_file
from sysid_bench.types import Array
from sysid_bench.units import quantity

NO_JOINT: Final = "-"
"""Stands in `joints` for a recorded coordinate that is not a joint of the model (a gripper's)."""

_ANGLE: Final = {"rad": 1.0, "deg": np.pi / 180.0, "mrad": 1e-3}
_LENGTH: Final = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_CURRENT: Final = {"A": 1.0, "mA": 1e-3}
_TORQUE: Final = {"N m": 1.0, "Nm": 1.0, "N·m": 1.0, "mN m": 1e-3, "mNm": 1e-3}
_FORCE: Final = {"N": 1.0, "kN": 1e3}
_SPEED: Final = {f"{unit}/s": scale for unit, scale in _LENGTH.items()}
_RATE: Final = {f"{unit}/s": scale for unit, scale in _ANGLE.items()} | {"rpm": np.pi / 30.0}
UNITS: Final[Mapping[str, Mapping[str, Mapping[str, float]]]] = {
    "q": {"hinge": _ANGLE, "slide": _LENGTH},
    "v": {"hinge": _RATE, "slide": _SPEED},
    "tau": {"hinge": _TORQUE | _CURRENT, "slide": _FORCE | _CURRENT},
}
"""Units of a signal by kind of joint, each with its value in SI; a current needs a gain."""


def _one_or_more(value: Any) -> Any:
    return tuple(value) if isinstance(value, (list, tuple)) else (value,)


_Several = BeforeValidator(_one_or_more)
_Column = Annotated[int | str, Field(union_mode="left_to_right")]


def _matrix(value: Any) -> Any:
    if not isinstance(value, list) or not all(isinstance(row, list) for row in value):
        raise ValueError("must be a list of rows, [[1, 0], [1, 1]]")
    return tuple(tuple(row) for row in value)


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Signal(_Table):
    """Columns of one signal, in the order of `joints`; one number of a setting serves all joints.

    q, v = raw unit gain / ratio + offset; tau = raw unit gain ratio + offset, with `offset` in SI
    and in the joint's coordinate.
    """

    columns: Annotated[tuple[_Column, ...], _Several]
    unit: Annotated[tuple[str, ...], _Several] | None = None
    gain: Annotated[tuple[float, ...], _Several] = (1.0,)
    ratio: Annotated[tuple[float, ...], _Several] = (1.0,)
    offset: Annotated[tuple[float, ...], _Several] = (0.0,)
    file: str | None = None  # where this signal has a file of its own
    reader: str | dict[str, Any] | None = None  # of that file
    per_row: Annotated[int, Field(gt=0)] | None = None  # of a file with one number a line


class Time(_Table):
    """Column of time stamps."""

    column: _Column
    unit: str = "s"
    file: str | None = None
    reader: str | dict[str, Any] | None = None


def _time(value: Any) -> Any:
    return {"column": value} if isinstance(value, (int, str)) else value


class _Text(_Table):
    """Keys of the file as written."""

    file: str | None = None
    reader: str | dict[str, Any] | None = None
    rate: str | float | None = None
    time: Annotated[Time | None, BeforeValidator(_time)] = None
    period: str | float | None = None
    joints: Annotated[tuple[str, ...], _Several]
    q: Signal
    v: Signal | None = None
    tau: Signal
    transmission: Annotated[tuple[tuple[float, ...], ...], BeforeValidator(_matrix)] | None = None
    payload: str | dict[str, Any] | None = None
    rows: tuple[int, int] | None = Field(default=None, strict=False)
    locked: dict[str, float] = Field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class LogDescription:
    """Files, columns and units of a recording.

    `rate` (Hz), `time` or both are given; with both the stamps are checked against the rate. The
    motion repeats after `period` (s). `transmission` G (k, k): q = G q_motor, tau_motor = G' tau.
    `rows`: first and last sample used, from 1. `locked`: positions (rad, m) of joints that are not
    recorded; joints in neither stand at the model's reference. `reader` replaces the choice by
    suffix.
    """

    source: Path
    joints: tuple[str, ...]
    q: Signal
    tau: Signal
    v: Signal | None = None
    file: str | None = None  # relative to `source`, or below the folder in a variable
    rate: float | None = None
    time: Time | None = None
    transmission: Array | None = None
    payload: str | Mapping[str, Any] | None = None
    rows: tuple[int, int] | None = None
    locked: Mapping[str, float] | None = None
    period: float | None = None
    reader: str | Mapping[str, Any] | None = None

    def file_of(self, part: Signal | Time) -> Path:
        """Return the absolute path of a signal's file; raises UsageError where none is named."""
        written = self.file if part.file is None else part.file
        if written is None:
            raise UsageError(
                f"{self.source}: no file is named; write file = 'run1.csv' at the top, or with "
                "every signal."
            )
        return self.source.parent / _expanded(written, self.source)

    def reader_of(self, part: Signal | Time) -> ReaderSpec | None:
        """Return the reader named for a signal's file, None for the one of its suffix."""
        written = part.reader or self.reader
        if written is None:
            return None
        spec = {"use": written} if isinstance(written, str) else written
        return resolve_paths(spec, self.source.parent)

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that the signals depend on, once each: recordings, and code of plug-in readers."""
        parts = [part for part in (self.q, self.v, self.tau, self.time) if part is not None]
        recorded = {self.file_of(part): self.reader_of(part) for part in parts}
        code = [plugin_file(path, reader) for path, reader in recorded.items()]
        return tuple(dict.fromkeys([*recorded, *(path for path in code if path is not None)]))

    def joint_values(self, name: str, numbers: Sequence[float]) -> Array:
        """Return one number per joint (k,) of a setting `name` that may hold one for all.

        Raises UsageError for any other count.
        """
        k = len(self.joints)
        if len(numbers) not in (1, k):
            raise UsageError(
                f"{self.source}: {name} has {len(numbers)} numbers; write one, or one for each of "
                f"the {k} joints."
            )
        return np.broadcast_to(np.array(numbers, dtype=float), (k,)).copy()


def read_description(source: Path) -> LogDescription:
    """Return the description in a TOML file; raises UsageError with all its mistakes."""
    return _parse_description(_read_keys(source), source)


def log_description(written: str | Mapping[str, Any], folder: Path) -> LogDescription:
    """Return a description as suites write it, relative to their folder: a file, a table with the
    keys of one, or a table { use = "run1.toml", ... } whose keys replace those of a file.

    Raises UsageError with all its mistakes.
    """
    if isinstance(written, str):
        return read_description(folder / written)
    given = {key: value for key, value in written.items() if key not in ("use", "name")}
    if "use" not in written:
        return _parse_description(given, folder / "[[log]]")
    source = folder / str(written["use"])
    text = dict(_read_keys(source))
    for key, value in given.items():
        both = isinstance(value, Mapping) and isinstance(text.get(key), Mapping)
        text[key] = {**text[key], **value} if both and key in ("q", "v", "tau") else value
    return _parse_description(text, source)


def name_of(written: str | Mapping[str, Any]) -> str:
    """Return the name of a suite's log: its own, or that of its file."""
    if isinstance(written, str):
        return PurePath(written).stem
    if "name" in written:
        return str(written["name"])
    return PurePath(str(written.get("file") or written.get("use") or "log")).stem


def _read_keys(source: Path) -> dict[str, Any]:
    """Return the keys of a description as written; raises UsageError for a missing file."""
    try:
        return tomllib.loads(source.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise UsageError(
            f"There is no log description {str(source)!r}; write one as `file = 'run1.csv'`, "
            "`rate = '200 Hz'`, joints, q and tau."
        ) from error
    except (IsADirectoryError, PermissionError) as error:
        raise UsageError(f"{source} cannot be read: {error.strerror}.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{source} is not valid TOML: {error}.") from error


def _parse_description(text: Mapping[str, Any], source: Path) -> LogDescription:
    """Return the description of these keys, with files relative to `source`."""
    try:
        written = _Text.model_validate(text)
    except ValidationError as error:
        lines = "; ".join(_line(problem) for problem in error.errors())
        raise UsageError(f"{source}: {lines}.") from error
    if written.rate is None and written.time is None:
        raise UsageError(
            f"{source}: neither rate nor time is given; write rate = '200 Hz', or time = the "
            "column of time stamps."
        )
    description = LogDescription(
        source=source,
        joints=written.joints,
        q=written.q,
        v=written.v,
        tau=written.tau,
        file=written.file,
        rate=None if written.rate is None else _positive("rate", written.rate, "Hz", source),
        time=written.time,
        transmission=_transmission(written, source),
        payload=written.payload,
        rows=_rows(written.rows, source),
        locked=written.locked,
        period=None if written.period is None else _positive("period", written.period, "s", source),
        reader=written.reader,
    )
    _check_joints(description)
    return description


def _expanded(written: str, source: Path) -> str:
    """Return a path with a leading `$NAME` replaced by the folder in that variable."""
    found = re.match(r"\$(\w+)|\$\{(\w+)\}", written)
    if found is None:
        return written
    name = found[1] or found[2]
    folder = os.environ.get(name)
    if not folder:
        raise UsageError(
            f"{source}: file = {written!r}, but the variable {name} is not set; set it to the "
            "folder of the recordings."
        )
    return folder + written[found.end() :]


def _positive(key: str, written: str | float, unit: str, source: Path) -> float:
    try:
        value = quantity(written, unit)
    except UsageError as error:
        raise UsageError(f"{source}: {key}: {error}") from error
    if value <= 0:
        raise UsageError(f"{source}: {key} must be positive; got {written!r}.")
    return value


def _rows(rows: tuple[int, int] | None, source: Path) -> tuple[int, int] | None:
    if rows is not None and not 1 <= rows[0] < rows[1]:
        raise UsageError(f"{source}: rows must be [first, last], counted from 1; got {list(rows)}.")
    return rows


def _transmission(written: _Text, source: Path) -> Array | None:
    if written.transmission is None:
        return None
    k = len(written.joints)
    lengths = [len(row) for row in written.transmission]
    if lengths != [k] * k:
        raise UsageError(
            f"{source}: transmission must be {k} rows of {k} numbers, one for each joint; got "
            f"{len(lengths)} rows of {', '.join(map(str, lengths))}."
        )
    G = np.array(written.transmission)
    if not np.isfinite(G).all() or np.linalg.cond(G) > 1e8:
        raise UsageError(
            f"{source}: transmission has no inverse, so two motors move the joints alike; check "
            "its rows (q = G q_motor)."
        )
    return G


def _check_joints(log: LogDescription) -> None:
    named = [joint for joint in log.joints if joint != NO_JOINT]
    twice = {joint for joint in named if named.count(joint) > 1}
    if twice:
        raise UsageError(f"{log.source}: joints names {', '.join(sorted(twice))} more than once.")
    if not named:
        raise UsageError(f"{log.source}: joints names no joint of the robot.")
    for name, part in (("q", log.q), ("v", log.v), ("tau", log.tau)):
        if part is None:
            continue
        for setting in ("gain", "ratio", "offset"):
            values = log.joint_values(f"{name}.{setting}", getattr(part, setting))
            if not np.isfinite(values).all() or (setting != "offset" and (values == 0).any()):
                raise UsageError(
                    f"{log.source}: {name}.{setting} must be finite"
                    f"{'' if setting == 'offset' else ' and not zero'}; got {values.tolist()}."
                )
        if part.unit is not None and len(part.unit) not in (1, len(log.joints)):
            raise UsageError(
                f"{log.source}: {name}.unit has {len(part.unit)} units; write one, or one for each "
                f"of the {len(log.joints)} joints."
            )


def scales(log: LogDescription, name: str, part: Signal, kinds: Sequence[str]) -> Array:
    """Return the factors (k,) from a file's numbers to SI: unit, gain and ratio together.

    `kinds`: hinge or slide of each coordinate, "" where it is not a joint. Raises UsageError for a
    unit that does not fit the joint, or a current without a gain.
    """
    gain, ratio = (log.joint_values(f"{name}.{s}", getattr(part, s)) for s in ("gain", "ratio"))
    # Power is conserved through a gear: it divides speed and multiplies torque.
    factors = np.asarray(gain * ratio if name == "tau" else gain / ratio)
    if part.unit is None:
        return factors
    units = part.unit * len(kinds) if len(part.unit) == 1 else part.unit
    for i, (unit, kind) in enumerate(zip(units, kinds, strict=True)):
        size = _unit_size(log, name, unit, i, kind)
        if unit in _CURRENT and part.gain == (1.0,):
            raise UsageError(
                f"{log.source}: {name} is a current in {unit}; write gain = [...] in N m/A (or N/A)"
                ", and ratio = [...] where it is the motor's."
            )
        factors[i] *= size
    return factors


def _unit_size(log: LogDescription, name: str, unit: str, i: int, kind: str) -> float:
    """Return the value in SI of the unit of coordinate i."""
    all_units = {**UNITS[name]["hinge"], **UNITS[name]["slide"]}
    fitting = UNITS[name].get(kind, all_units)
    if unit in fitting:
        return fitting[unit]
    where = f"{log.source}: {name}.unit of joint {log.joints[i]!r}"
    if unit in all_units:
        movement = "turns" if kind == "hinge" else "slides"
        raise UsageError(
            f"{where}: {unit!r} does not fit, since it {movement}; write one unit for each joint, "
            f"here one of {', '.join(fitting)}."
        )
    raise UsageError(f"{where}: {unknown_name('unit', unit, fitting)}")


def _line(problem: Any) -> str:
    """Return one sentence for one error of pydantic."""
    key = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        error = unknown_name("key of a log description", key, _keys(problem["loc"]))
        return str(error).rstrip(".")
    if problem["type"] == "missing":
        return f"{key} is missing"
    return f"{key}: {problem['msg'].removeprefix('Value error, ')}"


def _keys(path: tuple[Any, ...]) -> set[str]:
    if len(path) == 1:
        return set(_Text.model_fields)
    table = Time if path[0] == "time" else Signal
    return {f"{path[0]}.{key}" for key in table.model_fields}
