"""What a recording of a real robot is: the text of `identify --log LOG.toml`."""

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
from sysid_bench.types import Array
from sysid_bench.units import quantity

NO_JOINT: Final = "-"
"""Stands in `joints` for a recorded coordinate that is no joint of the model, as a gripper's."""

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
"""Units of a signal by the joint's kind, each with its size in SI; a current needs a gain."""


def _one_or_more(value: Any) -> Any:
    return tuple(value) if isinstance(value, (list, tuple)) else (value,)


Several = BeforeValidator(_one_or_more)
Column = Annotated[int | str, Field(union_mode="left_to_right")]


def _matrix(value: Any) -> Any:
    if not isinstance(value, list) or not all(isinstance(row, list) for row in value):
        raise ValueError("must be a list of rows, [[1, 0], [1, 1]]")
    return tuple(tuple(row) for row in value)


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Signal(_Table):
    """Columns of one signal, in the order of `joints`. Numbers in the file are multiplied by the
    unit, then by `gain`; positions and rates are divided by `ratio`, torques multiplied by it;
    `offset` (SI, in the joint's own coordinate) is added last. One number serves all joints."""

    columns: Annotated[tuple[Column, ...], Several]
    unit: Annotated[tuple[str, ...], Several] | None = None
    gain: Annotated[tuple[float, ...], Several] = (1.0,)
    ratio: Annotated[tuple[float, ...], Several] = (1.0,)
    offset: Annotated[tuple[float, ...], Several] = (0.0,)
    file: str | None = None  # where this signal has a file of its own
    per_row: Annotated[int, Field(gt=0)] | None = None  # of a file with one number a line


class Time(_Table):
    """The column of time stamps."""

    column: Column
    unit: str = "s"
    file: str | None = None


def _time(value: Any) -> Any:
    return {"column": value} if isinstance(value, (int, str)) else value


class _Text(_Table):
    """The file as written."""

    file: str | None = None
    rate: str | float | None = None
    time: Annotated[Time | None, BeforeValidator(_time)] = None
    period: str | float | None = None
    joints: Annotated[tuple[str, ...], Several]
    q: Signal
    v: Signal | None = None
    tau: Signal
    transmission: Annotated[tuple[tuple[float, ...], ...], BeforeValidator(_matrix)] | None = None
    payload: str | dict[str, Any] | None = None
    rows: tuple[int, int] | None = Field(default=None, strict=False)
    locked: dict[str, float] = Field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class LogDescription:
    """A log's description; paths are absolute. `rate` (Hz) or `time` is there, or both: then the
    stamps are checked against the rate. The motion repeats after `period` (s). `transmission` G
    (k, k): q = G q_motor, tau_motor = G' tau. `rows`: the first and last sample used, from 1.
    `locked`: where joints that are not recorded stand (rad, m); the others stand at the model's
    reference."""

    source: Path
    joints: tuple[str, ...]
    q: Signal
    tau: Signal
    v: Signal | None = None
    file: str | None = None  # beside `source`, or below a folder that a variable names
    rate: float | None = None
    time: Time | None = None
    transmission: Array | None = None
    payload: str | Mapping[str, Any] | None = None
    rows: tuple[int, int] | None = None
    locked: Mapping[str, float] | None = None
    period: float | None = None

    def file_of(self, part: Signal | Time) -> Path:
        """The file that a signal is read from."""
        written = self.file if part.file is None else part.file
        if written is None:
            raise UsageError(
                f"{self.source}: no file is named; write file = 'run1.csv' at the top, or with "
                "every signal."
            )
        return self.source.parent / _expanded(written, self.source)

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that is read, once each."""
        parts = [part for part in (self.q, self.v, self.tau, self.time) if part is not None]
        return tuple(dict.fromkeys(self.file_of(part) for part in parts))

    def column_count(self, name: str, numbers: Sequence[float]) -> Array:
        """One number per joint (k,) of a setting that may hold one for all."""
        k = len(self.joints)
        if len(numbers) not in (1, k):
            raise UsageError(
                f"{self.source}: {name} has {len(numbers)} numbers; write one, or one for each of "
                f"the {k} joints."
            )
        return np.broadcast_to(np.array(numbers, dtype=float), (k,)).copy()


def read_description(source: Path) -> LogDescription:
    """The description in a TOML file; UsageError with all its mistakes."""
    return parse_description(read_text(source), source)


def log_description(written: str | Mapping[str, Any], folder: Path) -> LogDescription:
    """A description as suites write it, relative to their folder: a file, a table with the keys of
    one, or a table { use = "run1.toml", ... } whose keys replace those of a file.

    Raises UsageError with all its mistakes.
    """
    if isinstance(written, str):
        return read_description(folder / written)
    own = {key: value for key, value in written.items() if key not in ("use", "name")}
    if "use" not in written:
        return parse_description(own, folder / "[[log]]")
    source = folder / str(written["use"])
    text = dict(read_text(source))
    for key, value in own.items():
        both = isinstance(value, Mapping) and isinstance(text.get(key), Mapping)
        text[key] = {**text[key], **value} if both and key in ("q", "v", "tau") else value
    return parse_description(text, source)


def name_of(written: str | Mapping[str, Any]) -> str:
    """What a suite's log goes by: its name, or that of its file."""
    if isinstance(written, str):
        return PurePath(written).stem
    told = written.get("name") or written.get("file") or written.get("use") or "log"
    return str(written["name"]) if "name" in written else PurePath(str(told)).stem


def read_text(source: Path) -> dict[str, Any]:
    """The keys of a description as they are written; UsageError where there are none."""
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
        raise UsageError(f"{source} is no TOML: {error}.") from error


def parse_description(text: Mapping[str, Any], source: Path) -> LogDescription:
    """The description of these keys, files relative to `source`; UsageError with all mistakes."""
    try:
        written = _Text.model_validate(text)
    except ValidationError as error:
        lines = "; ".join(_line(problem) for problem in error.errors())
        raise UsageError(f"{source}: {lines}.") from error
    if written.rate is None and written.time is None:
        raise UsageError(
            f"{source}: neither rate nor time; write rate = '200 Hz', or time = the column of time "
            "stamps."
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
    )
    _check_joints(description)
    return description


def _expanded(written: str, source: Path) -> str:
    """A path whose beginning `$NAME` is the folder that the variable of this name holds."""
    found = re.match(r"\$(\w+)|\$\{(\w+)\}", written)
    if found is None:
        return written
    name = found[1] or found[2]
    folder = os.environ.get(name)
    if not folder:
        raise UsageError(
            f"{source}: file = {written!r} lies below the folder that the variable {name} names, "
            "and it is not set; set it to where the recordings are."
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
            f"{source}: transmission has no inverse: some motor moves no joint of its own. Check "
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
            values = log.column_count(f"{name}.{setting}", getattr(part, setting))
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
    """What the file's numbers are multiplied with (k,), units, gain and ratio together; `kinds`:
    hinge or slide of each coordinate, "" where it is no joint.

    Raises UsageError for a unit that the joint cannot have, or a current without a gain.
    """
    gain, ratio = (log.column_count(f"{name}.{s}", getattr(part, s)) for s in ("gain", "ratio"))
    own = gain * ratio if name == "tau" else gain / ratio
    if part.unit is None:
        return own
    units = part.unit * len(kinds) if len(part.unit) == 1 else part.unit
    both = {**UNITS[name]["hinge"], **UNITS[name]["slide"]}
    for i, (unit, kind) in enumerate(zip(units, kinds, strict=True)):
        known = UNITS[name].get(kind, both)
        if unit not in known:
            where = f"{log.source}: {name}.unit of joint {log.joints[i]!r}"
            if unit in both:
                verb = "turns" if kind == "hinge" else "slides"
                raise UsageError(
                    f"{where}: {unit!r} does not fit, since it {verb}; write one unit for each "
                    f"joint, here one of {', '.join(known)}."
                )
            raise UsageError(f"{where}: {unknown_name('unit', unit, known)}")
        if unit in _CURRENT and part.gain == (1.0,):
            raise UsageError(
                f"{log.source}: {name} is a current in {unit}; write gain = [...] in N m/A (or N/A)"
                ", and ratio = [...] where it is the motor's."
            )
        own[i] *= known[unit]
    return own


def _line(problem: Any) -> str:
    place = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        return (
            unknown_name("key of a log description", place, _keys(problem["loc"]))
            .args[0]
            .rstrip(".")
        )
    if problem["type"] == "missing":
        return f"{place} is missing"
    return f"{place}: {problem['msg'].removeprefix('Value error, ')}"


def _keys(place: tuple[Any, ...]) -> set[str]:
    if len(place) == 1:
        return set(_Text.model_fields)
    table = Time if place[0] == "time" else Signal
    return {f"{place[0]}.{key}" for key in table.model_fields}
