"""Description of a recording of a real robot: the TOML file of `identify --log LOG.toml`."""

import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Annotated, Any, Final

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.input_files import parse_toml, read_text
from sysid_bench.naming import resolve_files
from sysid_bench.signals.log_reader import ReaderSpec, reader_files
from sysid_bench.types import Array
from sysid_bench.units import quantity

NO_JOINT: Final = "-"
"""Stands in `joints` for a recorded coordinate that is not a joint of the model (a gripper's)."""


def _one_or_more(value: Any) -> Any:
    return tuple(value) if isinstance(value, (list, tuple)) else (value,)


_Several = BeforeValidator(_one_or_more)
_Column = Annotated[int | str, Field(union_mode="left_to_right")]


def _is_list_of_lists(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(row, list) for row in value)


def _matrix(value: Any) -> Any:
    if not _is_list_of_lists(value):
        raise ValueError("must be a list of rows, [[1, 0], [1, 1]]")
    return tuple(tuple(row) for row in value)


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True, strict=True)


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

    @property
    def signals(self) -> dict[str, Signal]:
        """Recorded signals by name: q, v where there is one, and tau."""
        parts = {"q": self.q, "v": self.v, "tau": self.tau}
        return {name: part for name, part in parts.items() if part is not None}

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
        return resolve_files(spec, self.source.parent)

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that the signals depend on, once each: recordings, and code of plug-in readers."""
        parts: list[Signal | Time] = [*self.signals.values(), *filter(None, [self.time])]
        recorded = {self.file_of(part): self.reader_of(part) for part in parts}
        code = (file for item in recorded.items() for file in reader_files(*item))
        return tuple(dict.fromkeys([*recorded, *code]))

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
    given = dict(written)
    given.pop("name", None)
    if "use" not in given:
        return _parse_description(given, folder / "[[log]]")
    source = folder / str(given.pop("use"))
    text = _read_keys(source)
    replaced = {key: _replaced(key, text.get(key), value) for key, value in given.items()}
    return _parse_description({**text, **replaced}, source)


def _replaced(key: str, before: Any, value: Any) -> Any:
    """Return the value of a key given instead of that of a file: for a signal its keys one by
    one, so that a suite may correct a gain alone."""
    tables = isinstance(before, Mapping) and isinstance(value, Mapping)
    return {**before, **value} if tables and key in ("q", "v", "tau") else value


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
        return parse_toml(read_text(source))
    except FileNotFoundError as error:
        raise UsageError(
            f"There is no log description {str(source)!r}; write one as `file = 'run1.csv'`, "
            "`rate = '200 Hz'`, joints, q and tau."
        ) from error
    except OSError as error:
        raise UsageError(f"{source} cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        raise UsageError(f"{source} is not valid TOML: {error}.") from error


def _parse_description(text: Mapping[str, Any], source: Path) -> LogDescription:
    """Return the description of these keys, with files relative to `source`."""
    written = _validated(text, source)
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
        rate=_positive("rate", written.rate, "Hz", source),
        time=written.time,
        transmission=_transmission(written, source),
        payload=written.payload,
        rows=_rows(written.rows, source),
        locked=written.locked,
        period=_positive("period", written.period, "s", source),
        reader=written.reader,
    )
    _check_joints(description)
    return description


def _validated(text: Mapping[str, Any], source: Path) -> _Text:
    """Return the keys once their names and types fit; raises UsageError with all mistakes."""
    try:
        return _Text.model_validate(text)
    except ValidationError as error:
        lines = "; ".join(_line(problem) for problem in error.errors())
        raise UsageError(f"{source}: {lines}.") from error


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


def _positive(key: str, written: str | float | None, unit: str, source: Path) -> float | None:
    """Return a quantity in its SI unit, None where none is given."""
    if written is None:
        return None
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
    return _invertible(np.array(written.transmission), source)


def _invertible(G: Array, source: Path) -> Array:
    # A matrix that is singular up to the digits written down amplifies noise without bound.
    if not np.isfinite(G).all() or np.linalg.cond(G) > 1e8:
        raise UsageError(
            f"{source}: transmission has no inverse, so two motors move the joints alike; check "
            "its rows (q = G q_motor)."
        )
    return G


def _check_joints(log: LogDescription) -> None:
    """Raise UsageError for wrong names of joints, and for settings that do not fit them."""
    _check_names(log)
    for name, part in log.signals.items():
        _check_signal(log, name, part)


def _check_names(log: LogDescription) -> None:
    """Raise UsageError for a joint named twice, and without any."""
    twice = {joint for joint, count in Counter(log.joints).items() if count > 1} - {NO_JOINT}
    if twice:
        raise UsageError(f"{log.source}: joints names {', '.join(sorted(twice))} more than once.")
    if set(log.joints) <= {NO_JOINT}:
        raise UsageError(f"{log.source}: joints names no joint of the robot.")


def _check_signal(log: LogDescription, name: str, part: Signal) -> None:
    for setting in ("gain", "ratio", "offset"):
        _check_setting(log, f"{name}.{setting}", getattr(part, setting), setting == "offset")
    if part.unit is not None and len(part.unit) not in (1, len(log.joints)):
        raise UsageError(
            f"{log.source}: {name}.unit has {len(part.unit)} units; write one, or one for each "
            f"of the {len(log.joints)} joints."
        )


def _check_setting(log: LogDescription, key: str, numbers: Sequence[float], zero: bool) -> None:
    """Raise UsageError for a wrong count of numbers, and unless all are finite and, without
    `zero`, not zero."""
    values = log.joint_values(key, numbers)
    if not (np.isfinite(values) & ((values != 0) | zero)).all():
        raise UsageError(
            f"{log.source}: {key} must be finite{'' if zero else ' and not zero'}; got "
            f"{values.tolist()}."
        )


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
    table = {"time": Time}.get(path[0], Signal)
    return {f"{path[0]}.{key}" for key in table.model_fields}
