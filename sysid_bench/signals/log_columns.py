"""Places of the signals of a recording: columns by their names, files of one signal each, or
columns by their numbers; and the roles of the other columns."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, product
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import first_names
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals import column_names
from sysid_bench.signals.column_names import CURRENTS, is_signal, role_of, words_of
from sysid_bench.signals.column_roles import DOUBT, Block, explain_columns
from sysid_bench.signals.log_checks import is_rate
from sysid_bench.signals.log_keys import SIGNALS
from sysid_bench.signals.log_table import LogTable, table_of_rows
from sysid_bench.signals.torque_scale import drive_gains, scale_contradiction
from sysid_bench.types import Array

_SLOWEST: Final = 0.5
"""s between samples above which stamps are not in s."""

_TIME_UNITS: Final = ("s", "ms", "us", "ns")

_SIGNAL_OF: Final = {"position": "q", "velocity": "v", "torque": "tau", "current": "tau"}

Tables = Sequence[tuple[str, LogTable]]
"""Files of one recording as written, and their tables."""


@dataclass(frozen=True, eq=False)
class Columns:
    """Place of a signal: its file (None: the common one), columns, and numbers (N, k).
    `beside`: other columns that fit; `time`: the column of its own stamps; `reason`: how it was
    recognised by its numbers; `is_current`: its numbers are no torques of joints, except times
    `gain`, which the file itself states."""

    columns: list[str] | list[int]
    values: Array
    file: str | None = None
    per_row: int | None = None
    beside: tuple[str, ...] = ()
    time: Mapping[str, Any] | None = None
    reason: str = ""
    is_current: bool = False
    gain: tuple[float, ...] = ()

    def table(self, unit: Sequence[str] = (), **more: Any) -> dict[str, Any]:
        """Return the value of the key of a signal; one unit where all joints have the same."""
        own = {"file": self.file, "per_row": self.per_row, "time": self.time}
        kept = {key: value for key, value in own.items() if value is not None}
        units = {"unit": unit[0] if len(set(unit)) == 1 else list(unit)} if unit else {}
        return {**kept, "columns": list(self.columns), **units, **more}

    def said(self, reason: str) -> str:
        """Return the reason for a key: how its numbers were recognised, and other columns that fit,
        which are a doubt unless the names of the chosen ones say that these were measured."""
        known = self.reason.removeprefix(DOUBT)
        doubt = self.reason.startswith(DOUBT) or reason.startswith(DOUBT)
        reason = "; ".join(filter(None, (known, reason.removeprefix(DOUBT))))
        others = first_names(self.beside, 6)
        if self.beside and all(column_names.is_measured(str(name)) for name in self.columns):
            reason = f"{reason}; not taken: {others}"
        elif self.beside:
            doubt, reason = True, f"{reason}; {others} fit as well: check which were measured"
        return f"{DOUBT * doubt}{reason}"


@dataclass(frozen=True, eq=False)
class Found:
    """Signals of a recording by name (q, v, tau, time, q_des), the gains of a position controller,
    columns that no signal takes, and a line on each block of columns. `files`: the common ones."""

    signals: dict[str, Columns]
    files: tuple[str, ...]
    gains: dict[str, Any] = field(default_factory=dict)
    unused: tuple[str, ...] = ()
    explained: tuple[str, ...] = ()


def find_columns(tables: Tables, robot: RobotModel, joints: Sequence[str]) -> Found:
    """Return the places of the signals in files (as written, their tables) of one recording."""
    told = [one for one in tables if column_names.is_command_file(Path(one[0]).stem)]
    told = told if len(told) < len(tables) else []
    measured = [one for one in tables if one not in told]
    measured = [one for one in measured if _holds_signals(*one)] or measured
    bare = len(measured) == 1 and not measured[0][1].names
    signals: dict[str, Columns] = {}
    for file, table in told:
        if table.names or words_of(Path(file).stem) & column_names.WORDS["q"]:
            signals["q_des"] = _commands(file, table, joints)
    files = tuple(name for name, _ in measured)
    if bare:
        of_numbers = _by_numbers(measured[0], robot, joints, signals)
        # Without positions, a file of one signal, whose name says of which.
        if "q" in of_numbers.signals or role_of(Path(measured[0][0]).stem) == "unexplained":
            return of_numbers
    if bare or _has_signal_per_file(measured):
        files = ()
        found = _by_files(measured, joints)
    else:
        found = _by_columns(measured, joints)
    found |= signals
    if "tau" in found and _is_acceleration(found):
        del found["tau"]
    said: tuple[str, ...] = ()
    if {"q", "tau"} <= found.keys():
        said = _check_scale(found, robot, joints, dict(tables))
    gains = _gains(tables) if "q_des" in found else {}
    unused = _unused(found, tables) if files else []
    if not files:
        unused = [name for name, _ in tables if all(x.file != name for x in found.values())]
    unused = [name for name in unused if [name] not in gains.values()]
    said += tuple(f"{name}: gain: by its name" for name in gains)
    return Found(found, files, gains, tuple(unused), (*said, *_explained(found, unused)))


def _holds_signals(file: str, table: LogTable) -> bool:
    """Test whether a file may hold a signal, by its name or those of its columns."""
    names = [Path(file).stem, *table.names]
    every = not table.names or table.values.shape[1] == 1
    return every or any(is_signal(name, signal) for name in names for signal in SIGNALS)


def _check_scale(
    found: dict[str, Columns],
    robot: RobotModel,
    joints: Sequence[str],
    tables: Mapping[str, LogTable],
) -> tuple[str, ...]:
    """Mark what is named as torques as currents where the model contradicts their scale; take it
    out where it has no sign, and return that as a line."""
    q, tau, time = found["q"], found["tau"], found.get("time")
    t = np.arange(float(len(q.values))) if time is None else time.values[:, 0]
    if q.time is not None and q.file is not None:  # stamps of its own
        t = tables[q.file].columns([q.time["column"]])[:, 0]
    rows = min(len(q.values), len(tau.values), len(t))
    known = column_names.joints_of_columns([str(column) for column in q.columns], joints)
    data = (q.values[:rows], tau.values[:rows], t[:rows])
    said = scale_contradiction(*data, robot, known or joints)
    if said and tau.values.min() >= 0:
        found["magnitude"] = found.pop("tau")
        return (f"{first_names(map(str, tau.columns), 8)}: magnitude: {said}",)
    if said:
        found["tau"] = replace(tau, is_current=True, reason=f"{DOUBT}{said}")
    return ()


def _explained(found: Mapping[str, Columns], unused: Sequence[str]) -> Iterator[str]:
    """Yield a line on each signal and on each kind of columns that are not used."""
    for signal, part in found.items():
        named = first_names(map(str, part.columns), 8)
        label = ": ".join(filter(None, (part.file, named)))
        role = {"q": "position", "v": "velocity", "time": "time", "q_des": "command"}.get(signal)
        if signal == "magnitude":  # its line is that of the check of its scale
            continue
        role = role or ("current" if part.is_current else "torque")
        also = ", and by its numbers the derivative of the positions"
        is_derivative = {"q"} < found.keys() and signal == "v"
        is_derivative = is_derivative and is_rate(found["q"].values, part.values)
        yield f"{label}: {role}: by its name{also * is_derivative}"
    roles: dict[str, list[str]] = defaultdict(list)
    for name in unused:
        roles[role_of(Path(name).stem)].append(name)
    for role, names in roles.items():
        yield f"{first_names(names, 8)}: {role}: by its name, in no key of this description"


def _by_numbers(
    file: tuple[str, LogTable],
    robot: RobotModel,
    joints: Sequence[str],
    told: Mapping[str, Columns],
) -> Found:
    """Return where signals stand in columns without names."""
    values = file[1].values
    blocks = explain_columns(values, robot, joints)
    found, unused = dict(told), []
    for block in sorted(blocks, key=lambda one: "not taken" in one.reason):
        signal = _SIGNAL_OF.get(block.role, block.role)
        if signal in (*SIGNALS, "time") and signal not in found:
            found[signal] = Columns(
                [column + 1 for column in block.columns],
                values[:, list(block.columns)],
                reason=block.reason,
                is_current=block.role == "current",
            )
        else:
            unused.append(block)
    if "v" in found and "tau" in found and found["tau"].is_current:
        found["tau"] = _with_gain(found["tau"], found["v"].values, values, unused)
    labels = tuple(block.label for block in sorted(unused, key=lambda one: one.columns))
    return Found(found, (file[0],), {}, labels, tuple(block.text for block in blocks))


def _with_gain(tau: Columns, v: Array, values: Array, others: Sequence[Block]) -> Columns:
    """Return currents with the gains that the blocks of a controller's own currents and computed
    torques agree on, if there are such."""
    for current, torque in product(others, others):
        if current.role == "current" and torque.is_computed:
            i, computed = (values[:, list(block.columns)] for block in (current, torque))
            if known := drive_gains(i, computed, v):
                reason = f"{tau.reason}; {known[1]} ({torque.label} over {current.label})"
                return replace(tau, gain=tuple(known[0]), reason=reason)
    return tau


def _has_signal_per_file(tables: Tables) -> bool:
    """True for files with columns of one name, or without stamps to join them by: each holds one
    signal."""
    names = Counter(chain.from_iterable(table.names for _, table in tables))
    shared = [n for n, count in names.items() if count > 1 and not is_signal(n, "time")]
    timeless = [file for file, table in tables if column_names.time_column(table.names) is None]
    return len(tables) > 1 and bool(shared or timeless)


def _by_columns(tables: Tables, joints: Sequence[str]) -> dict[str, Columns]:
    """Return where signals stand in the columns of one file, or of several joined by time."""
    names: dict[str, tuple[int, ...]] = {}
    owner: dict[str, LogTable] = {}
    for _, table in tables:
        names |= table.names
        owner |= dict.fromkeys(table.names, table)
    chosen = {s: column_names.columns_of_signal(names, s, joints) for s in SIGNALS}
    chosen["q_des"] = column_names.command_columns(names, joints) if not chosen["tau"] else []
    found = {}
    for signal, columns in chosen.items():
        if columns:
            same = [name for name in columns if owner[name] is owner[columns[0]]]
            own = {i for name in same for i in names[name]}
            fits = [n for n in names if signal in SIGNALS and is_signal(n, signal)]
            beside = [n for n in fits if own.isdisjoint(names[n])]
            # Fewer columns are not enough for the signal.
            beside = beside if sum(len(names[n]) for n in beside) >= len(own) else []
            is_current = bool(words_of(" ".join(same)) & CURRENTS) and signal == "tau"
            values = owner[same[0]].columns(same)
            found[signal] = Columns(same, values, beside=tuple(beside), is_current=is_current)
    time = column_names.time_column(name for name, indices in names.items() if len(indices) == 1)
    if time:
        found["time"] = Columns([time], owner[time].columns([time]))
    return found


def _by_files(tables: Tables, joints: Sequence[str]) -> dict[str, Columns]:
    """Return where signals stand, one file each, by the names of the files."""
    lengths = [len(x.values) for file, x in tables if is_signal(Path(file).stem, "time")]
    found: dict[str, Columns] = {}
    for signal in (*SIGNALS, "time"):
        for file, table in tables:
            stem = Path(file).stem
            fits = is_signal(stem, signal) or (signal == "tau" and role_of(stem) == "current")
            if signal == "time":  # that of the start stands in every row
                fits = fits and _rises(table.values[:, 0])
            if fits and signal not in found:
                # Numbers one a line are as many columns as there are for each stamp.
                per_stamp = {len(table.values) // n for n in lengths if len(table.values) % n == 0}
                k = min(per_stamp - {0}, default=len(joints))
                found[signal] = _whole_file(file, table, signal, k)
    return found


def _whole_file(file: str, table: LogTable, signal: str, k: int) -> Columns:
    """Return the columns of a file of one signal, with its own stamps; one column is a list of
    samples of k numbers."""
    width = table.values.shape[1]
    if signal == "time":
        return Columns(list(range(1, width + 1)), table.values, file)
    if width == 1:
        return Columns(list(range(1, k + 1)), table_of_rows(table, k).values, file, k)
    name = column_names.time_column(table.names)
    place = 0 if not table.names and _rises(table.values[:, 0]) else None
    left = table.names[name][0] if name else place
    indices = [i for i in range(width) if i != left]
    stamps = None
    if left is not None:
        stamps = {"column": name or left + 1, "unit": stamp_unit(table.values[:, left])[0]}
    is_current = bool(words_of(Path(file).stem) & CURRENTS)
    values, columns = table.values[:, indices], [i + 1 for i in indices]
    return Columns(columns, values, file, time=stamps, is_current=is_current)


def _rises(t: Array) -> bool:
    """Test whether a column (N,) may hold time stamps."""
    steps = np.diff(t)
    return len(steps) > 0 and bool((steps >= 0).mean() > 0.95 and (steps > 0).mean() > 0.5)


def stamp_unit(t: Array) -> tuple[str, float, str]:
    """Return the unit that the steps of stamps (N,) suggest, their rate in Hz, and the reason."""
    steps = np.diff(t[np.isfinite(t)])
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    fitting = (e for e in range(len(_TIME_UNITS)) if step * 10.0 ** (-3 * e) < _SLOWEST)
    exponent = next(fitting, len(_TIME_UNITS) - 1)
    rate = 1.0 / (step * 10.0 ** (-3 * exponent))
    return _TIME_UNITS[exponent], rate, f"the stamps step by {step:.4g}, so {rate:.4g} Hz"


def _commands(file: str, table: LogTable, joints: Sequence[str]) -> Columns:
    """Return the commanded positions in a file of commands."""
    names = column_names.columns_of_signal(table.names, "q", joints)
    names = names or column_names.command_columns(table.names, joints)
    whole = _whole_file(file, table, "q_des", len(joints))
    if not names:
        return whole
    return Columns(names, table.columns(names), file, time=whole.time)


def _gains(tables: Tables) -> dict[str, Any]:
    """Return kp and kd of a position controller: numbers, or the columns that hold them."""
    found: dict[str, Any] = {}
    for _, table in tables:
        for name in (*table.constants, *table.names):
            for gain in {"kp", "kd"} & words_of(name) - found.keys():
                found[gain] = list(table.constants.get(name, [name]))
    return found


def _is_acceleration(found: Mapping[str, Columns]) -> bool:
    """Test whether what is named as torques (N, k) is the derivative of the rates, recorded or from
    positions."""
    others = [found[name].values for name in ("q", "v") if name in found]
    rates = [np.gradient(x, axis=0) for x in others[:1] if len(x) > 1] + others[1:]
    return any(is_rate(v, found["tau"].values) for v in rates)


def _unused(found: Mapping[str, Columns], tables: Tables) -> list[str]:
    """Return the columns that no signal takes: names, or indices from 1."""
    used = {(part.file, column) for part in found.values() for column in part.columns}
    used |= {(part.file, part.time["column"]) for part in found.values() if part.time}
    unused: list[str] = []
    for file, table in tables:
        own = {column for place, column in used if place in (None, file)}
        taken = {i for name in own & table.names.keys() for i in table.names[str(name)]}
        names = {i: name for name, (i, *more) in table.names.items() if not more}
        left = [i for i in range(table.values.shape[1]) if i not in taken]
        unused += [names.get(i, str(i + 1)) for i in left]
    return list(dict.fromkeys(unused))
