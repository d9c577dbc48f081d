"""Description of a recording of a real robot: the TOML file of `identify --log LOG.toml`."""

import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.input_files import is_file, parse_toml, read_text
from sysid_bench.models.data_sets import SCHEME, find_motion
from sysid_bench.plugin_names import resolve_files
from sysid_bench.signals import log_keys, log_reader
from sysid_bench.signals.log_keys import COMMANDED, SIGNALS, Signal, Source, Time
from sysid_bench.signals.log_reader import ReaderSpec
from sysid_bench.signals.log_table import LogTable
from sysid_bench.types import Array
from sysid_bench.units import quantity

NO_JOINT: Final = "-"
"""Stands in `joints` for a recorded coordinate that is not a joint of the model (a gripper's)."""

_UNCHANGED: Final = (
    *("joints", "q", "v", "tau", "q_ref", "v_ref", "wrench", "base", "reader", "controller"),
    *("payload", "rows", "share", "locked", "serial"),
)
"""Keys that a description has as they are written."""


@dataclass(frozen=True, eq=False)
class LogDescription:
    """Files, columns and units of a recording.

    `rate` (Hz), `time` or both are given; with both the stamps are checked against the rate. The
    motion repeats after `period` (s). `transmission` G (k, k): q = G q_motor, tau_motor = G' tau.
    `rows`: first and last sample used, from 1; `share`: the first part of these. `locked`:
    positions (rad, m) of joints that are not recorded; joints in neither stand at the model's
    reference. `reader` replaces the choice by suffix. `sources`: several files whose columns are
    joined by name and time. `data`: numbers in memory, instead of any file. `controller`: gains
    that track `q_ref` and, where it is recorded, `v_ref`, the commanded motion; without them the
    commanded motion is not read. `wrench`: columns of force/torque sensors. `base`: those of the
    motion of a floating base. `serial`: which of several robots of one type.
    """

    source: Path
    joints: tuple[str, ...]
    q: Signal
    tau: log_keys.Torque
    v: Signal | None = None
    file: str | None = None  # relative to `source`, or below the folder in a variable
    rate: float | None = None
    time: Time | None = None
    transmission: Array | None = None
    payload: str | Mapping[str, Any] | None = None
    rows: tuple[int, int] | None = None
    share: float = 1.0
    locked: Mapping[str, float] | None = None
    serial: str | None = None
    period: float | None = None
    reader: str | Mapping[str, Any] | None = None
    sources: tuple[Source, ...] = ()
    data: LogTable | None = None
    controller: log_keys.ControllerKeys | None = None
    q_ref: Signal | None = None
    v_ref: Signal | None = None
    wrench: tuple[log_keys.Wrench, ...] = ()
    base: log_keys.Base | None = None

    @property
    def has_torque(self) -> bool:
        """False where the wrench of a force/torque sensor is all that was measured."""
        return self.tau.is_recorded

    @property
    def signals(self) -> dict[str, Signal]:
        """Recorded signals by name: q, v where there is one, tau or the commands that it follows
        from, and the commanded motion where a controller tracks it."""
        names = (*SIGNALS, *COMMANDED) if self.controller is not None else SIGNALS
        parts: dict[str, Signal | None] = {name: getattr(self, name) for name in names}
        found = {name: part for name, part in parts.items() if part is not None}
        if self.tau.pd is not None or not self.has_torque:
            del found["tau"]
        return found if self.tau.pd is None else found | self.tau.pd.signals

    @property
    def columns(self) -> list[Signal]:
        """Recorded signals, those of the base among them."""
        return [*self.signals.values(), *([] if self.base is None else self.base.signals.values())]

    def file_of(self, part: Signal | Time | Source) -> Path:
        """Return the absolute path of a signal's file; raises UsageError where none is named."""
        written = self.file if part.file is None else part.file
        if written is None:
            raise UsageError(
                f"{self.source}: no file is named; write file = 'run1.csv' at the top, or with "
                "every signal."
            )
        return self.source.parent / _expanded(written, self.source)

    def reader_of(self, part: Signal | Time | Source) -> ReaderSpec | None:
        """Return the reader named for a signal's file, None for the one of its suffix."""
        written = part.reader or self.reader
        if written is None:
            return None
        spec = {"use": written} if isinstance(written, str) else written
        return resolve_files(spec, self.source.parent)

    @property
    def file_entries(self) -> list[Signal | Time | Source]:
        """Parts that name files: the sources, and signals or time with a file of their own."""
        if self.data is not None:
            return []
        parts: list[Signal | Time | Source] = [*self.columns, *self.wrench]
        clocks = [self.time, *map(own_time, (*self.columns, *self.wrench))]
        parts += [time for time in clocks if time is not None]
        own = [part for part in parts if part.file is not None]
        return [*self.sources, *own] if self.sources else parts

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that the signals depend on, once each: recordings, and code of plug-in readers."""
        recorded: list[Path] = []
        code: list[Path] = []
        for part in self.file_entries:
            path, reader = self.file_of(part), self.reader_of(part)
            try:
                recorded += log_reader.recorded_files(path, reader)
            except UsageError:  # an absent recording stands for itself
                recorded.append(path)
            code += log_reader.reader_files(path, reader)
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
    """Return the description in a TOML file, or of a motion of a data set ("dataset:ur10/train");
    raises UsageError with all its mistakes."""
    return description_of(*read_keys(str(source), Path()))


def log_description(
    written: "str | Mapping[str, Any] | LogDescription", folder: Path
) -> LogDescription:
    """Return a description as it is, or as suites write it, relative to their folder: a file, a
    motion of a data set, a table with the keys of one, or a table { use = "run1.toml", ... } whose
    keys replace those of the file or the motion.

    Raises UsageError with all its mistakes.
    """
    if isinstance(written, LogDescription):
        return written
    if isinstance(written, str):
        return description_of(*read_keys(written, folder))
    given = dict(written)
    given.pop("name", None)
    if "use" not in given:
        return description_of(given, folder / "[[log]]")
    text, source = read_keys(str(given.pop("use")), folder)
    replaced = {key: _replaced(key, text.get(key), value) for key, value in given.items()}
    return description_of({**text, **replaced}, source)


def _replaced(key: str, before: Any, value: Any) -> Any:
    """Return the value of a key given instead of that of a file: for a signal its keys one by
    one, so that a suite may correct a gain alone."""
    tables = isinstance(before, Mapping) and isinstance(value, Mapping)
    if not tables or key not in (*SIGNALS, *COMMANDED, "pd"):
        return value
    return {**before, **{k: _replaced(k, before.get(k), x) for k, x in value.items()}}


def with_controller(log: LogDescription, given: Mapping[str, Any] | None) -> LogDescription:
    """Return a description with a controller in place of its own; None: its own stays."""
    if given is None:
        return log
    return replace(log, controller=log_keys.ControllerKeys.model_validate(given))


def name_of(written: str | Mapping[str, Any]) -> str:
    """Return the name of a suite's log: its own, or that of its file."""
    if isinstance(written, str):
        return PurePath(written).stem
    if "name" in written:
        return str(written["name"])
    file = written.get("file")
    first = file[0] if isinstance(file, list) and file else file
    first = first.get("file") if isinstance(first, Mapping) else first
    return PurePath(str(first or written.get("use") or "log")).stem


def read_keys(written: str, folder: Path) -> tuple[dict[str, Any], Path]:
    """Return the keys of a description as written, and its file; raises UsageError for a missing
    one."""
    if written.startswith(SCHEME):
        found, motion = find_motion(written, folder)
        return found.motion(motion), found.file
    source = folder / written
    try:
        return parse_toml(read_text(source)), source
    except FileNotFoundError as error:
        raise UsageError(
            f"The log description {str(source)!r} does not exist; write one as `file = "
            "'run1.csv'`, `rate = '200 Hz'`, joints, q and tau."
        ) from error
    except OSError as error:
        raise UsageError(f"{source} cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        raise UsageError(f"{source} is not valid TOML: {error}.") from error


def description_of(
    text: Mapping[str, Any], source: Path, data: LogTable | None = None
) -> LogDescription:
    """Return the description of these keys, with files relative to `source`, or of `data`.

    Raises UsageError with all mistakes.
    """
    keys = log_keys.with_preset(text, source)
    written = log_keys.check_keys(keys, source, _advice(keys, source))
    time = written.time or own_time(written.q)
    if written.rate is None and time is None and isinstance(written.file, str | None):
        raise UsageError(
            f"{source}: neither rate nor time is given; write rate = '200 Hz', or time = the "
            "column of time stamps."
        )
    rows = written.rows
    if rows is not None and not 1 <= rows[0] < rows[1]:
        raise UsageError(f"{source}: rows must be [first, last], counted from 1; got {list(rows)}.")
    unchanged = {name: getattr(written, name) for name in _UNCHANGED}
    description = LogDescription(
        **unchanged,
        source=source,
        file=written.file if isinstance(written.file, str) else None,
        sources=written.file if isinstance(written.file, tuple) else (),
        time=time,
        rate=_positive("rate", written.rate, "Hz", source),
        period=_positive("period", written.period, "s", source),
        transmission=_transmission(written, source),
        data=data,
    )
    _check_joints(description)
    return description


def own_time(part: Signal) -> Time | None:
    """Return the stamps of the file of a signal, None where it has no clock of its own."""
    if part.time is None or part.time.file is not None:
        return part.time
    return part.time.model_copy(update={"file": part.file, "reader": part.reader})


def _advice(keys: Mapping[str, Any], source: Path) -> str:
    """Return the preset that fits the file where signals are missing, "" without one."""
    if {"q", "tau"} <= keys.keys() or "reader" in keys or not isinstance(keys.get("file"), str):
        return ""
    try:
        path = source.parent / _expanded(keys["file"], source)
        # A reader that is not ours is foreign code, which a description alone must not run.
        if log_reader.package_reader(path):
            return log_keys.preset_note(log_reader.read_table(path).names)
    except UsageError:
        pass
    return ""


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


def _transmission(written: log_keys.LogKeys, source: Path) -> Array | None:
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
    # A matrix that is singular up to the digits written down amplifies noise without bound.
    if not np.isfinite(G).all() or np.linalg.cond(G) > 1e8:
        raise UsageError(
            f"{source}: transmission has no inverse, so two motors move the joints alike; check "
            "its rows (q = G q_motor)."
        )
    return G


def _check_joints(log: LogDescription) -> None:
    """Raise UsageError for a joint named twice, without any, and for settings of signals that do
    not fit them: a wrong count, numbers that are not finite, a gain or a ratio of zero."""
    twice = {joint for joint, count in Counter(log.joints).items() if count > 1} - {NO_JOINT}
    if twice:
        raise UsageError(f"{log.source}: joints names {', '.join(sorted(twice))} more than once.")
    if set(log.joints) <= {NO_JOINT}:
        raise UsageError(f"{log.source}: joints names no joint of the robot.")
    for name, part in log.signals.items():
        for setting in ("gain", "ratio", "offset"):
            values = log.joint_values(f"{name}.{setting}", getattr(part, setting))
            zero = setting == "offset"
            if not (np.isfinite(values) & ((values != 0) | zero)).all():
                raise UsageError(
                    f"{log.source}: {name}.{setting} must be finite"
                    f"{'' if zero else ' and not zero'}; got {values.tolist()}."
                )
        if part.unit is not None and len(part.unit) not in (1, len(log.joints)):
            raise UsageError(
                f"{log.source}: {name}.unit has {len(part.unit)} units; write one, or one for each "
                f"of the {len(log.joints)} joints."
            )


def find_description(file: Path | LogDescription) -> LogDescription:
    """Return the description of a recording; raises UsageError, with an example for a file that is
    not TOML."""
    if isinstance(file, LogDescription):
        return file
    try:
        return read_description(file)
    except UsageError as error:
        if file.suffix.lower() == ".toml" or not is_file(file):
            raise
        raise UsageError(
            f"{str(file)!r} is not the description of a recording. Let sysid-bench init log "
            f"{file.name} --model MODEL write one, or write a TOML file that names its data and "
            f"its columns, and give that: file = '{file.name}', rate = '200 Hz', joints = ['j1'], "
            "q = { columns = [1], unit = 'rad' }, tau = { columns = [2], unit = 'N m' }, one key a "
            "line."
        ) from error
