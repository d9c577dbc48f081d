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
from sysid_bench.signals import column_names
from sysid_bench.signals.column_names import is_signal, words_of
from sysid_bench.signals.log_checks import check_finite, check_rates, is_rate
from sysid_bench.signals.log_description import NO_JOINT
from sysid_bench.signals.log_keys import SIGNALS, find_preset, preset_keys
from sysid_bench.signals.log_samples import scalar_kinds
from sysid_bench.signals.log_table import LogTable, table_of_rows
from sysid_bench.types import Array

_TORQUES: Final = frozenset({"tau", "torque", "torques", "effort", "efforts", "trq", "nm"})
"""Words of torques; currents have none of them."""

_FULL_TURN: Final = 2.0 * np.pi
_SLOWEST: Final = 0.5
"""s between samples above which stamps are not in s."""
_TIME_UNITS: Final = ("s", "ms", "us", "ns")

DOUBT: Final = "a doubt: "
"""Start of a reason that is a doubt."""

NO_TORQUE: Final = (
    "tau: the recording holds positions without torques or motor currents, and no dynamics are "
    "identified without them: add their columns or their file as tau"
)

_Tables = Sequence[tuple[str, LogTable]]
"""Files of one recording as written, and their tables."""


@dataclass(frozen=True)
class _GuessedKey:
    """Key of a description with its value and the reason for it, which may be a doubt."""

    name: str
    value: Any
    reason: str = ""


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
        doubts = [
            f"{entry.name}: {entry.reason.removeprefix(DOUBT)}"
            for entry in self.entries
            if entry.reason.startswith(DOUBT)
        ]
        return [self.lacks, *doubts] if self.lacks else doubts


@dataclass(frozen=True, eq=False)
class _Columns:
    """Where a signal stands: its file (None: the common one), columns, and numbers (N, k).
    `beside`: other columns that fit."""

    columns: list[str] | list[int]
    values: Array
    file: str | None = None
    per_row: int | None = None
    beside: tuple[str, ...] = ()

    def key(self, name: str, units: Sequence[str], reason: str, **more: Any) -> _GuessedKey:
        """Return the key of a signal; one unit where all joints have the same. Other columns that
        fit are a doubt unless the names of the chosen ones say that these were measured."""
        unit = units[0] if len(set(units)) == 1 else list(units)
        own = {"file": self.file, "per_row": self.per_row}
        kept = {key: value for key, value in own.items() if value is not None}
        value = {**kept, "columns": list(self.columns), "unit": unit, **more}
        others = first_names(self.beside, 6)
        if self.beside and all(column_names.is_measured(str(name)) for name in self.columns):
            reason = f"{reason}; not taken: {others}"
        elif self.beside:
            mark = "" if reason.startswith(DOUBT) else DOUBT
            reason = f"{mark}{reason}; {others} fit as well: check which were measured"
        return _GuessedKey(name, value, reason)


def guess_log(tables: _Tables, robot: RobotModel) -> LogGuess:
    """Return the guessed description of files (as written, their tables) of one recording; see its
    `lacks` where they hold no torques.

    Raises UsageError where no positions can be found.
    """
    preset = find_preset(tables[0][1].names) if len(tables) == 1 else None
    if preset is not None:
        return LogGuess(tuple(_of_preset(tables[0], robot, preset)))
    joints = scalar_joints(robot)
    apart = _has_signal_per_file(tables)
    found = _by_files(tables, joints) if apart else _by_columns(tables, joints)
    if "tau" in found and _has_acceleration_as_torque(found):
        del found["tau"]
    if "q" not in found:
        raise _no_positions(tables, "tau" in found)
    files = [name for name, _ in tables]
    of_files = [] if apart else [_GuessedKey("file", files[0] if len(files) == 1 else files)]
    of_joints = _joints(found["q"], joints)
    of_time, rate = _time(found, tables)
    signals = _signals(found, of_joints.value, robot, rate)
    lacks = "" if "tau" in found else NO_TORQUE
    unused = () if apart else _unused(found, tables)
    return LogGuess((*of_files, of_joints, of_time, *signals), lacks, unused)


def _has_signal_per_file(tables: _Tables) -> bool:
    """True for files with columns of one name, or without stamps to join them by: each holds one
    signal."""
    names = Counter(chain.from_iterable(table.names for _, table in tables))
    shared = [n for n, count in names.items() if count > 1 and not is_signal(n, "time")]
    timeless = [file for file, table in tables if column_names.time_column(table.names) is None]
    return len(tables) > 1 and bool(shared or timeless)


def _has_acceleration_as_torque(found: Mapping[str, _Columns]) -> bool:
    tau, motion = found["tau"], [found[name].values for name in ("q", "v") if name in found]
    return _is_acceleration(tau.values, [tau.values, *motion])


def _no_positions(tables: _Tables, has_torques: bool) -> UsageError:
    names = list(chain.from_iterable(table.names for _, table in tables))
    listed = f"are {first_names(names, 8)}" if names else "have no names"
    absent = "positions" if has_torques else "positions and no torques or currents"
    return UsageError(
        f"{', '.join(file for file, _ in tables)}: no {absent} can be found: its columns "
        f"{listed}. A log needs positions and torques (or motor currents); name all its files, "
        "or write the description by hand: joints, q = { columns = [...] }, tau."
    )


def scalar_joints(robot: RobotModel) -> list[str]:
    """Return the hinges and slides that move independently, in the order of the model."""
    kinds = scalar_kinds(robot)
    return [row for row in robot.torque_rows if row in kinds]


def _of_preset(file: tuple[str, LogTable], robot: RobotModel, name: str) -> Iterator[_GuessedKey]:
    """Yield the keys that a preset leaves open."""
    preset = preset_keys()[name]
    yield _GuessedKey("file", file[0])
    yield _GuessedKey("preset", name, f"the columns are those of {preset['title']}")
    count = sum(re.fullmatch(preset["q"]["match"], column) is not None for column in file[1].names)
    joints = _sized(scalar_joints(robot), count)
    yield _GuessedKey("joints", joints, "in the order of the model: check it")
    if preset["tau"].get("unit") == "A":
        reason = f"{DOUBT}currents in A need gains in N m/A (with the gear); 1 is a placeholder"
        yield _GuessedKey("tau", {"gain": [1.0] * count}, reason)


def _sized(joints: Sequence[str], count: int) -> list[str]:
    """Return the first joints of a robot, "-" for columns beyond them."""
    return [*joints[:count], *[NO_JOINT] * (count - len(joints))]


def _by_columns(tables: _Tables, joints: Sequence[str]) -> dict[str, _Columns]:
    """Return where signals stand in the columns of one file, or of several joined by time."""
    names: dict[str, tuple[int, ...]] = {}
    owner: dict[str, LogTable] = {}
    for _, table in tables:
        names |= table.names
        owner |= dict.fromkeys(table.names, table)
    if not names:
        return _by_place(tables[0][1], joints)
    found = {}
    for signal in SIGNALS:
        chosen = column_names.columns_of_signal(names, signal, joints)
        if chosen:
            same = [name for name in chosen if owner[name] is owner[chosen[0]]]
            beside = [n for n in column_names.single_columns(names, signal) if n not in same]
            # Fewer columns are not enough for the signal.
            beside = beside if len(beside) >= len(same) else []
            found[signal] = _Columns(same, owner[same[0]].columns(same), beside=tuple(beside))
    time = column_names.time_column(name for name, indices in names.items() if len(indices) == 1)
    if time:
        found["time"] = _Columns([time], owner[time].columns([time]))
    return found


def _by_place(table: LogTable, joints: Sequence[str]) -> dict[str, _Columns]:
    """Return where signals stand in columns without names: time where the first one rises, then
    groups of one column a joint."""
    values = table.values
    steps = np.diff(np.where(np.isfinite(values[:, 0]), values[:, 0], np.nan))
    rises = len(steps) > 0 and bool((steps >= 0).mean() > 0.95 and (steps > 0).mean() > 0.5)
    start, count = int(rises), values.shape[1] - int(rises)
    # A single group is that of positions, and has a column for each joint.
    k = len(joints)
    if not k or count < k or count % k:
        k = next((k for k in range(9, 0, -1) if count % k == 0 and count > k), 0)
    if not k:
        return {}
    groups = {i: values[:, i : i + k] for i in range(start, values.shape[1], k)}
    found = {"time": _Columns([1], values[:, :1])} if start else {}
    for signal, first in _signals_of_groups(groups).items():
        found[signal] = _Columns(list(range(first + 1, first + k + 1)), groups[first])
    return found


def _signals_of_groups(groups: Mapping[int, Array]) -> dict[str, int]:
    """Return the group (by its first column) of each signal: rates by the numbers, the others by
    their order; accelerations are none of them."""
    left = [first for first, x in groups.items() if not _is_acceleration(x, groups.values())]
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


def _by_files(tables: _Tables, joints: Sequence[str]) -> dict[str, _Columns]:
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
        return _Columns(list(range(1, k + 1)), table_of_rows(table, k).values, file, k)
    left = table.names.get(column_names.time_column(table.names) or "", ())
    indices = [i for i in range(width) if i not in left]
    return _Columns([i + 1 for i in indices], table.values[:, indices], file)


def _unused(found: Mapping[str, _Columns], tables: _Tables) -> tuple[str, ...]:
    """Return the columns that no signal takes: names, or ranges of indices from 1."""
    used = {column for part in found.values() for column in part.columns}
    unused: list[str] = []
    for _, table in tables:
        taken = {i for name in used & table.names.keys() for i in table.names[str(name)]}
        taken |= {column - 1 for column in used if isinstance(column, int)}
        left = [i for i in range(table.values.shape[1]) if i not in taken]
        unused += _labels(table, left)
    return tuple(dict.fromkeys(unused))


def _labels(table: LogTable, columns: Sequence[int]) -> Iterator[str]:
    """Yield the names of columns, then ranges from 1 of those without a name of their own."""
    names = {i: name for name, (i, *more) in table.names.items() if not more}
    yield from (names[i] for i in columns if i in names)
    bare = [i + 1 for i in columns if i not in names]
    breaks = [i for i in range(1, len(bare)) if bare[i] != bare[i - 1] + 1]
    for start, end in pairwise([0, *breaks, len(bare)] if bare else []):
        first, last = bare[start], bare[end - 1]
        yield f"{first}" if first == last else f"{first} to {last}"


def _joints(q: _Columns, joints: Sequence[str]) -> _GuessedKey:
    count = q.values.shape[1]
    named = column_names.joints_of_columns([str(column) for column in q.columns], joints)
    if named is not None and len(named) == count:
        return _GuessedKey("joints", named, "their names are in those of the columns")
    reason = "in the order of the model: check it"
    if count != len(joints):
        reason = f"{DOUBT}{count} columns for the {len(joints)} joints of the model: check them"
    return _GuessedKey("joints", _sized(joints, count), reason)


def _time(found: Mapping[str, _Columns], tables: _Tables) -> tuple[_GuessedKey, float]:
    """Return time stamps or the rate, and the rate in Hz."""
    if "time" in found:
        return _stamps(found["time"])
    stated = next((table.rate for _, table in tables if table.rate), None)
    if stated:
        return _GuessedKey("rate", f"{stated:g} Hz", "the file states it"), stated
    q, v = found["q"].values, found["v"].values if "v" in found else None
    measured = None if v is None or v.shape != q.shape else _agreeing_rate(q, v, 100.0)
    if measured:
        reason = f"{DOUBT}no time stamps; v and the differences of q agree at this rate"
        return _GuessedKey("rate", f"{measured:.4g} Hz", reason), measured
    reason = f"{DOUBT}neither stamps nor v give it: write the rate of the recorder"
    return _GuessedKey("rate", "200 Hz", reason), 200.0


def _stamps(time: _Columns) -> tuple[_GuessedKey, float]:
    """Return the column of time stamps with the unit that their steps suggest, and their rate in
    Hz."""
    t = time.values[:, 0]
    steps = np.diff(t[np.isfinite(t)])
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    fitting = (e for e in range(len(_TIME_UNITS)) if step * 10.0 ** (-3 * e) < _SLOWEST)
    exponent = next(fitting, len(_TIME_UNITS) - 1)
    reason = f"the stamps step by {step:.4g}, so {1 / (step * 10.0 ** (-3 * exponent)):.4g} Hz"
    value = {"column": time.columns[0], "unit": _TIME_UNITS[exponent]}
    file = {} if time.file is None else {"file": time.file}
    steps = np.diff(t) * (1.0, 1e-3, 1e-6, 1e-9)[exponent]
    rate = 1.0 / float(np.median(steps[steps > 0])) if (steps > 0).any() else 200.0
    return _GuessedKey("time", {**value, **file}, reason), rate


def _agreeing_rate(q: Array, v: Array, rate: float) -> float | None:
    """Return the rate (Hz) at which v (N, k) and the differences of q agree, None without one."""
    valid = ~check_finite(q, v)
    joints = [str(j) for j in range(q.shape[1])]
    return check_rates(q[valid], v[valid], rate, joints)[1]


def _signals(
    found: Mapping[str, _Columns], joints: Sequence[str], robot: RobotModel, rate: float
) -> Iterator[_GuessedKey]:
    """Yield q, v and tau with their units."""
    q, v, tau = found["q"], found.get("v"), found.get("tau")
    kinds = [scalar_kinds(robot).get(joint, "hinge") for joint in joints]

    def units(of_hinges: str, of_slides: str) -> list[str]:
        return [of_hinges if kind == "hinge" else of_slides for kind in kinds]

    unit, reason = _position_unit(q, joints, kinds, robot)
    yield q.key("q", units(unit, "m"), reason)
    if v is not None and v.values.shape == q.values.shape:
        scale = np.where(np.array(units(unit, "m")) == "deg", np.pi / 180, 1.0)
        unit_v = f"{unit}/s"
        reason = f"{DOUBT}v and the differences of q do not agree; the unit of q is taken"
        for tried, size in (("rad/s", 1.0), ("deg/s", np.pi / 180.0)):
            measured = _agreeing_rate(q.values * scale, v.values * size, rate)
            if measured is not None and abs(measured / rate - 1) < 0.2:
                unit_v, reason = tried, "v and the differences of q agree in it"
                break
        yield v.key("v", units(unit_v, "m/s"), reason)
    if tau is None:
        return
    k, name = len(kinds), " ".join([tau.file or "", *map(str, tau.columns)])
    if tau.values.shape[1] != k:
        raise UsageError(
            f"{k} columns of positions, but {tau.values.shape[1]} of torques: "
            f"{first_names(map(str, tau.columns), 8)}; write the description by hand."
        )
    if is_signal(name, "tau") and "curr" in name.lower():
        reason = f"{DOUBT}currents need gains in N m/A, and ratio for a motor's; 1 is a placeholder"
        yield tau.key("tau", ["A"], reason, gain=[1.0] * k)
        return
    reason = "torques, by their names: of motors, give ratio; of currents, unit A and gain"
    if not words_of(name) & _TORQUES:
        reason = f"{DOUBT}taken for torques of joints; for currents write unit A and gain, ratio"
    yield tau.key("tau", units("N m", "N"), reason)


def _position_unit(
    q: _Columns, joints: Sequence[str], kinds: Sequence[str], robot: RobotModel
) -> tuple[str, str]:
    """Return rad or deg for the hinges, by their name, or by their limits; and the reason."""
    hinges = [i for i, kind in enumerate(kinds) if kind == "hinge"]
    words = words_of(" ".join(map(str, q.columns)))
    for unit, written in (("deg", {"deg", "degrees", "degree"}), ("rad", {"rad", "radians"})):
        if words & written:
            return unit, "the name says so"
    known = [robot.rows.index(joints[i]) for i in hinges if joints[i] != NO_JOINT]
    bound = np.maximum(np.abs(robot.limits.q_low[known]), np.abs(robot.limits.q_high[known]))
    widest = float(np.max(bound[np.isfinite(bound)], initial=_FULL_TURN))
    reach = np.nanmax(np.abs(q.values[:, hinges]), initial=0.0)
    if reach <= 2 * widest:
        return "rad", f"the numbers reach {reach:.3g}, the limits of the joints {widest:.3g} rad"
    if np.deg2rad(reach) <= 2 * widest:
        return "deg", (
            f"{DOUBT}the numbers reach {reach:.4g}, the limits {widest:.3g} rad: degrees, or rad "
            "of motors, then give ratio"
        )
    return "rad", f"{DOUBT}the numbers reach {reach:.4g}; perhaps of motors, then give ratio"
