"""First description of a recording, guessed from names, numbers and the limits of the robot."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, first_names
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals import unit_guess
from sysid_bench.signals.column_names import (
    columns_of_signal,
    is_measured,
    is_signal,
    joints_of_columns,
    other_columns,
    time_column,
    words_of,
)
from sysid_bench.signals.log_checks import check_finite, is_rate
from sysid_bench.signals.log_description import NO_JOINT
from sysid_bench.signals.log_keys import SIGNALS
from sysid_bench.signals.log_preset import find_preset, preset_keys
from sysid_bench.signals.log_table import LogTable, table_of_rows
from sysid_bench.types import Array

_TORQUES: Final = frozenset({"tau", "torque", "torques", "effort", "efforts", "trq", "nm"})
"""Words of torques; currents have none of them."""

DOUBT: Final = "a doubt: "
"""Start of a reason that is a doubt."""

NO_TORQUE: Final = (
    "tau: the recording holds positions without torques or motor currents, and no dynamics are "
    "identified without them: add their columns or their file as tau"
)


@dataclass(frozen=True)
class _GuessedKey:
    """Key of a description with its value and the reason for it, which may be a doubt."""

    name: str
    value: Any
    reason: str = ""

    @property
    def doubt(self) -> str:
        """What the user has to settle, "" where the key is sure."""
        marked = self.reason.startswith(DOUBT)
        return f"{self.name}: {self.reason.removeprefix(DOUBT)}" if marked else ""


@dataclass(frozen=True)
class LogGuess:
    """Guessed description of a recording, and what it lacks: a sentence, "" where it is whole.
    `unused`: columns that no signal takes."""

    entries: tuple[_GuessedKey, ...]
    lacks: str = ""
    unused: tuple[str, ...] = ()

    @property
    def keys(self) -> dict[str, Any]:
        """Keys of the description with their values."""
        return {entry.name: entry.value for entry in self.entries}

    @property
    def warnings(self) -> list[str]:
        """Doubts that the user has to settle, what is missing first."""
        found = (self.lacks, *(entry.doubt for entry in self.entries))
        return [doubt for doubt in found if doubt]


@dataclass(frozen=True, eq=False)
class _Columns:
    """Where a signal stands: its file (None: the common one), columns, and numbers (N, k)."""

    columns: list[str] | list[int]
    values: Array
    file: str | None = None
    per_row: int | None = None
    beside: tuple[str, ...] = ()

    def reason(self, known: str) -> str:
        """Return what is `known` and the other columns that fit, which are a doubt unless the names
        of the chosen ones say that these were measured."""
        if not self.beside:
            return known
        if all(is_measured(str(name)) for name in self.columns):
            return f"{known}; not taken: {first_names(self.beside, 6)}"
        mark = "" if known.startswith(DOUBT) else DOUBT
        others = first_names(self.beside, 6)
        return f"{mark}{known}; {others} fit as well: check which were measured"


def guess_log(tables: Sequence[tuple[str, LogTable]], robot: RobotModel) -> LogGuess:
    """Return the guessed description of files (as written, their tables) of one recording; see its
    `lacks` where they hold no torques.

    Raises UsageError where no positions can be found.
    """
    preset = find_preset(tables[0][1].names) if len(tables) == 1 else None
    if preset is not None:
        return LogGuess(tuple(_of_preset(tables[0], robot, preset)))
    joints = scalar_joints(robot)
    apart = len(tables) > 1 and (_share_names(tables) or _no_time(tables))
    found = _by_files(tables, joints) if apart else _by_columns(tables, joints)
    found = _without_accelerations(found)
    _check_found(found, tables)
    of_files = [] if apart else [_file_key(tables)]
    of_joints = _joints(found["q"], joints)
    of_time, rate = _time(found, tables)
    signals = _signals(found, of_joints.value, robot, rate)
    lacks = "" if "tau" in found else NO_TORQUE
    entries = (*of_files, of_joints, of_time, *signals)
    return LogGuess(entries, lacks, _unused(found, tables, apart))


def scalar_joints(robot: RobotModel) -> list[str]:
    """Return the hinges and slides that move independently, in the order of the model."""
    kinds = {joint.dofs[0]: joint.kind for joint in robot.joints if len(joint.dofs) == 1}
    return [row for row in robot.torque_rows if kinds.get(row) in ("hinge", "slide")]


def _file_key(tables: Sequence[tuple[str, LogTable]]) -> _GuessedKey:
    files = [name for name, _ in tables]
    return _GuessedKey("file", files[0] if len(files) == 1 else files)


def _share_names(tables: Sequence[tuple[str, LogTable]]) -> bool:
    """Test whether columns of several files, but time, have one name."""
    names = Counter(_names(tables))
    return any(count > 1 and not is_signal(name, "time") for name, count in names.items())


def _names(tables: Sequence[tuple[str, LogTable]]) -> Iterator[str]:
    return chain.from_iterable(table.names for _, table in tables)


def _no_time(tables: Sequence[tuple[str, LogTable]]) -> bool:
    return any(time_column(table.names) is None for _, table in tables)


def _of_preset(file: tuple[str, LogTable], robot: RobotModel, name: str) -> Iterator[_GuessedKey]:
    """Yield the keys that a preset leaves open."""
    joints = scalar_joints(robot)
    yield _GuessedKey("file", file[0])
    yield _GuessedKey("preset", name, f"the columns are those of {preset_keys()[name]['title']}")
    numbers = _numbered_columns(preset_keys()[name]["q"]["match"], file[1])
    yield _GuessedKey("joints", _sized(joints, numbers), "in the order of the model: check it")
    if preset_keys()[name]["tau"].get("unit") == "A":
        reason = f"{DOUBT}currents in A need gains in N m/A (with the gear); 1 is a placeholder"
        yield _GuessedKey("tau", {"gain": [1.0] * numbers}, reason)


def _numbered_columns(pattern: str, table: LogTable) -> int:
    return sum(re.fullmatch(pattern, name) is not None for name in table.names)


def _sized(joints: Sequence[str], count: int) -> list[str]:
    """Return the first joints of a robot, "-" for columns beyond them."""
    return [*joints[:count], *[NO_JOINT] * (count - len(joints))]


def _by_columns(
    tables: Sequence[tuple[str, LogTable]], joints: Sequence[str]
) -> dict[str, _Columns]:
    """Return where signals stand in the columns of one file, or of several joined by time."""
    names, owner = _joined_names(tables)
    if not names:
        return _by_place(tables[0][1], joints)
    found = {}
    for signal in SIGNALS:
        chosen = columns_of_signal(names, signal, joints)
        if chosen:
            same = [name for name in chosen if owner[name] is owner[chosen[0]]]
            beside = tuple(other_columns(names, signal, same))
            found[signal] = _Columns(same, owner[same[0]].columns(same), beside=beside)
    time = time_column(name for name, indices in names.items() if len(indices) == 1)
    if time:
        found["time"] = _Columns([time], owner[time].columns([time]))
    return found


def _joined_names(
    tables: Sequence[tuple[str, LogTable]],
) -> tuple[dict[str, tuple[int, ...]], dict[str, LogTable]]:
    """Return the columns of all files by name, and the file that has each."""
    names: dict[str, tuple[int, ...]] = {}
    owner: dict[str, LogTable] = {}
    for _, table in tables:
        names |= table.names
        owner |= dict.fromkeys(table.names, table)
    return names, owner


def _by_place(table: LogTable, joints: Sequence[str]) -> dict[str, _Columns]:
    """Return where signals stand in columns without names: time where the first one rises, then
    groups of one column a joint."""
    values = table.values
    start = int(_rises(values[:, 0]))
    k = _group_size(values, start, len(joints))
    if not k:
        return {}
    groups = {
        first: values[:, first : first + k]
        for first in range(start, start + k * _groups(values, start, k), k)
    }
    found = {"time": _Columns([1], values[:, :1])} if start else {}
    for signal, first in _signals_of_groups(groups).items():
        found[signal] = _Columns(list(range(first + 1, first + k + 1)), groups[first])
    return found


def _signals_of_groups(groups: Mapping[int, Array]) -> dict[str, int]:
    """Return the group (by its first column) of each signal: rates by the numbers, the others by
    their order; accelerations are none of them."""
    accelerations = {first for first, x in groups.items() if _is_acceleration(x, groups.values())}
    left = [first for first in groups if first not in accelerations]
    rates = ((q, v) for q in left for v in left if q != v and is_rate(groups[q], groups[v]))
    known = next(rates, None)
    if known is None:
        order = SIGNALS if len(left) >= 3 else ("q", "tau")
        return dict(zip(order, left, strict=False))
    torques = [first for first in left if first not in known]
    return dict(zip(SIGNALS, (*known, *torques), strict=False))


def _is_acceleration(x: Array, others: Iterable[Array]) -> bool:
    """Test whether x (N, k) is the derivative of a signal that is itself the derivative of one of
    the others, or the second derivative of one."""
    others = [one for one in others if one is not x and one.shape == x.shape and len(one) > 1]
    others = [one for one in others if not check_finite(one).any()]
    rates = [one for one in others if any(is_rate(q, one) for q in others if q is not one)]
    return any(is_rate(v, x) for v in [*rates, *(np.gradient(q, axis=0) for q in others)])


def _without_accelerations(found: dict[str, _Columns]) -> dict[str, _Columns]:
    """Return the signals without a torque that is the acceleration of the joints."""
    tau = found.get("tau")
    motion = [found[name].values for name in ("q", "v") if name in found]
    if tau is None or not _is_acceleration(tau.values, [tau.values, *motion]):
        return found
    return {name: part for name, part in found.items() if name != "tau"}


def _rises(column: Array) -> bool:
    """Test whether numbers rise nearly everywhere, as time does."""
    steps = np.diff(np.where(np.isfinite(column), column, np.nan))
    return len(steps) > 0 and bool((steps >= 0).mean() > 0.95 and (steps > 0).mean() > 0.5)


def _group_size(values: Array, start: int, joints: int) -> int:
    """Return the number of columns of a group, 0 where no groups fill the columns."""
    # A single group is that of positions, and has a column for each joint.
    if joints and _groups(values, start, joints):
        return joints
    return next((k for k in range(9, 0, -1) if _groups(values, start, k) > 1), 0)


def _groups(values: Array, start: int, k: int) -> int:
    """Return the number of groups of k columns behind `start`, 0 unless they fill them."""
    groups, rest = divmod(values.shape[1] - start, k)
    return groups if rest == 0 else 0


def _by_files(tables: Sequence[tuple[str, LogTable]], joints: Sequence[str]) -> dict[str, _Columns]:
    """Return where signals stand, one file each, by the names of the files."""
    found = {}
    for signal in (*SIGNALS, "time"):
        for file, table in tables:
            if is_signal(Path(file).stem, signal) and signal not in found:
                found[signal] = _whole_file(file, table, signal, joints)
    return found


def _whole_file(file: str, table: LogTable, signal: str, joints: Sequence[str]) -> _Columns:
    """Return the columns of a file of one signal; one column is a list of samples."""
    width = table.values.shape[1]
    if signal == "time":
        return _Columns(list(range(1, width + 1)), table.values, file)
    if width == 1:
        k = len(joints)
        values = table_of_rows(table, k).values
        return _Columns(list(range(1, k + 1)), values, file, k)
    left = table.names.get(time_column(table.names) or "", ())
    indices = [i for i in range(width) if i not in left]
    return _Columns([i + 1 for i in indices], table.values[:, indices], file)


def _check_found(found: Mapping[str, _Columns], tables: Sequence[tuple[str, LogTable]]) -> None:
    """Raise UsageError where positions were not found."""
    if "q" in found:
        return
    names = list(_names(tables))
    listed = f"its columns are {first_names(names, 8)}" if names else "its columns have no names"
    absent = "positions" if "tau" in found else "positions and no torques or currents"
    raise UsageError(
        f"{', '.join(file for file, _ in tables)}: no {absent} can be found: {listed}. A log needs "
        "positions and torques (or motor currents); name all its files, or write the description "
        "by hand: joints, q = { columns = [...] }, tau."
    )


def _unused(
    found: Mapping[str, _Columns], tables: Sequence[tuple[str, LogTable]], apart: bool
) -> tuple[str, ...]:
    """Return the columns that no signal takes: names, or ranges of indices from 1; of files of one
    signal each none."""
    used = {column for part in found.values() for column in part.columns}
    unused: list[str] = []
    for _, table in () if apart else tables:
        taken = {i for name in used & table.names.keys() for i in table.names[str(name)]}
        taken |= {column - 1 for column in used if isinstance(column, int)}
        left = [i for i in range(table.values.shape[1]) if i not in taken]
        unused += _column_words(
            left, {i: name for name, (i, *more) in table.names.items() if not more}
        )
    return tuple(dict.fromkeys(unused))


def _column_words(indices: Sequence[int], names: Mapping[int, str]) -> list[str]:
    """Return the names of columns (indices from 0); indices from 1 of those without."""
    words = [names[i] for i in indices if i in names]
    bare = [i + 1 for i in indices if i not in names]
    breaks = [i for i in range(1, len(bare)) if bare[i] != bare[i - 1] + 1]
    runs = [bare[first:last] for first, last in pairwise([0, *breaks, len(bare)])] if bare else []
    return words + [f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs]


def _joints(q: _Columns, joints: Sequence[str]) -> _GuessedKey:
    count = q.values.shape[1]
    named = joints_of_columns([str(column) for column in q.columns], joints)
    if named is not None and len(named) == count:
        return _GuessedKey("joints", named, "their names are in those of the columns")
    reason = "in the order of the model: check it"
    if count != len(joints):
        reason = f"{DOUBT}{count} columns for the {len(joints)} joints of the model: check them"
    return _GuessedKey("joints", _sized(joints, count), reason)


def _time(
    found: Mapping[str, _Columns], tables: Sequence[tuple[str, LogTable]]
) -> tuple[_GuessedKey, float]:
    """Return time stamps or the rate, and the rate in Hz."""
    if "time" in found:
        return _stamps(found["time"])
    stated = next((table.rate for _, table in tables if table.rate), None)
    if stated:
        return _GuessedKey("rate", f"{stated:g} Hz", "the file states it"), stated
    if measured := _measured_rate(found):
        reason = f"{DOUBT}no time stamps; v and the differences of q agree at this rate"
        return _GuessedKey("rate", f"{measured:.4g} Hz", reason), measured
    reason = f"{DOUBT}neither stamps nor v give it: write the rate of the recorder"
    return _GuessedKey("rate", "200 Hz", reason), 200.0


def _stamps(time: _Columns) -> tuple[_GuessedKey, float]:
    """Return the column of time stamps, and their rate in Hz."""
    unit, reason = unit_guess.time_unit(time.values[:, 0])
    file = {} if time.file is None else {"file": time.file}
    key = _GuessedKey("time", {"column": time.columns[0], "unit": unit, **file}, reason)
    steps = np.diff(time.values[:, 0]) * {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[unit]
    return key, 1.0 / float(np.median(steps[steps > 0])) if (steps > 0).any() else 200.0


def _measured_rate(found: Mapping[str, _Columns]) -> float | None:
    """Return the rate (Hz) at which v is the difference of q, None where that is not clear."""
    if "v" not in found or found["q"].values.shape != found["v"].values.shape:
        return None
    return unit_guess.measured_rate(found["q"].values, found["v"].values)


def _signals(
    found: Mapping[str, _Columns], joints: Sequence[str], robot: RobotModel, rate: float
) -> Iterator[_GuessedKey]:
    """Yield q, v and tau with their units."""
    q = found["q"]
    kinds = _kinds(joints, robot)
    unit, reason = _position_unit(q, joints, robot)
    units = _units(kinds, unit, "m")
    yield _GuessedKey("q", _signal(q, units), q.reason(reason))
    scale = np.where(np.array(units) == "deg", np.pi / 180, 1.0)
    v = found.get("v")
    if v is not None and v.values.shape == q.values.shape:
        unit_v, reason = unit_guess.velocity_unit(q.values * scale, v.values, rate, unit)
        yield _GuessedKey("v", _signal(v, _units(kinds, unit_v, "m/s")), v.reason(reason))
    if "tau" in found:
        yield _torque(found["tau"], q, kinds)


def _torque(tau: _Columns, q: _Columns, kinds: Sequence[str]) -> _GuessedKey:
    k = q.values.shape[1]
    if tau.values.shape[1] != k:
        raise UsageError(
            f"{k} columns of positions, but {tau.values.shape[1]} of torques: "
            f"{first_names(map(str, tau.columns), 8)}; write the description by hand."
        )
    name = " ".join([tau.file or "", *map(str, tau.columns)])
    if is_signal(name, "tau") and "curr" in name.lower():
        reason = f"{DOUBT}currents need gains in N m/A, and ratio for a motor's; 1 is a placeholder"
        return _GuessedKey("tau", {**_signal(tau, ["A"]), "gain": [1.0] * k}, tau.reason(reason))
    reason = "torques, by their names: of motors, give ratio; of currents, unit A and gain"
    if not words_of(name) & _TORQUES:
        reason = f"{DOUBT}taken for torques of joints; for currents write unit A and gain, ratio"
    return _GuessedKey("tau", _signal(tau, _units(kinds, "N m", "N")), tau.reason(reason))


def _units(kinds: Sequence[str], of_hinges: str, of_slides: str) -> list[str]:
    return [of_hinges if kind == "hinge" else of_slides for kind in kinds]


def _signal(found: _Columns, units: Sequence[str]) -> dict[str, Any]:
    """Return the keys of a signal; one unit where all joints have the same."""
    unit = units[0] if len(set(units)) == 1 else list(units)
    own = {"file": found.file, "per_row": found.per_row}
    kept = {key: value for key, value in own.items() if value is not None}
    return {**kept, "columns": list(found.columns), "unit": unit}


def _kinds(joints: Sequence[str], robot: RobotModel) -> list[str]:
    kinds = {joint.dofs[0]: joint.kind for joint in robot.joints if len(joint.dofs) == 1}
    return [kinds.get(joint, "hinge") for joint in joints]


def _position_unit(q: _Columns, joints: Sequence[str], robot: RobotModel) -> tuple[str, str]:
    """Return the unit of the hinges, and the reason."""
    kinds = _kinds(joints, robot)
    hinges = [i for i, kind in enumerate(kinds) if kind == "hinge"]
    known = [robot.rows.index(joints[i]) for i in hinges if joints[i] != NO_JOINT]
    low, high = robot.limits.q_low[known], robot.limits.q_high[known]
    name = " ".join(map(str, q.columns))
    return unit_guess.position_unit(q.values[:, hinges], low, high, name)
