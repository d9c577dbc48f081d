"""First description of a recording, guessed from names, numbers and the limits of the robot."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from itertools import chain
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, first_names
from sysid_bench.models.mjcf import stated_actuators
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals import column_names
from sysid_bench.signals.column_names import role_of, words_of
from sysid_bench.signals.column_roles import DOUBT
from sysid_bench.signals.log_checks import check_finite, check_rates
from sysid_bench.signals.log_columns import Columns, Found, Tables, find_columns, stamp_unit
from sysid_bench.signals.log_description import NO_JOINT
from sysid_bench.signals.log_keys import GAIN_ADVICE, find_preset, preset_keys
from sysid_bench.signals.log_samples import scalar_kinds
from sysid_bench.signals.log_table import LogTable
from sysid_bench.signals.torque_scale import drive_gains
from sysid_bench.types import Array

_TORQUES: Final = frozenset({"tau", "torque", "torques", "effort", "efforts", "trq", "nm"})
"""Words of torques; currents have none of them."""

_FULL_TURN: Final = 2.0 * np.pi

NO_TORQUE: Final = (
    "tau: the recording holds positions without torques or motor currents, and no dynamics are "
    "identified without them: add their columns or their file as tau"
)

NO_GAIN: Final = f"tau: currents, or torques of motors, are not torques of joints: {GAIN_ADVICE}"

NO_CONTROLLER: Final = (
    "tau: the recording holds positions and their commands without torques: write kp and kd of the "
    "position controller (N m/rad, N m s/rad), and the task 'actuators' identifies armature and "
    "friction"
)

GAINS_OF_FILE: Final = (
    "no torque was recorded, but commands; kp and kd are those of the actuators of the model file, "
    "which are often far from those of the controller: a start for --also gain"
)


@dataclass(frozen=True)
class _GuessedKey:
    """Key of a description with its value and the reason for it, which may be a doubt."""

    name: str
    value: Any
    reason: str = ""


@dataclass(frozen=True)
class LogGuess:
    """Guessed description of a recording, and what it lacks: a sentence, "" where it is whole.
    `unused`: columns that no signal takes; `explained`: what each block of columns is, and why."""

    entries: tuple[_GuessedKey, ...]
    lacks: str = ""
    unused: tuple[str, ...] = ()
    explained: tuple[str, ...] = ()
    proposal: Any = None  # for tau, where it is not complete

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


def guess_log(tables: Tables, robot: RobotModel) -> LogGuess:
    """Return the guessed description of files (as written, their tables) of one recording; see its
    `lacks` where they hold no torques.

    Raises UsageError where no positions can be found.
    """
    preset = find_preset(tables[0][1].names) if len(tables) == 1 else None
    if preset is not None:
        entries = tuple(_of_preset(tables[0], robot, preset))
        is_current = preset_keys()[preset]["tau"].get("unit") == "A"
        has_gain = any(entry.name == "tau" for entry in entries)
        return LogGuess(entries, NO_GAIN if is_current and not has_gain else "")
    joints = scalar_joints(robot)
    where = find_columns(tables, robot, joints)
    found, files = where.signals, list(where.files)
    if "q" not in found:
        raise _incomplete(tables, where)
    of_files = [_GuessedKey("file", files[0] if len(files) == 1 else files)] if files else []
    of_joints = _joints(found["q"], joints, tables)
    of_time, rate = _time(found, tables)
    signals = list(_signals(found, of_joints.value, robot, rate))
    proposal: Any = {"columns": [], "unit": "N m"}
    if "tau" in found:
        lacks = NO_GAIN if found["tau"].is_current and not found["tau"].gain else ""
    elif "q_des" in found:
        gains = {**_gains_of_file(robot, of_joints.value), **where.gains}
        lacks = "" if gains.keys() == {"kp", "kd"} else NO_CONTROLLER
        controlled = _controlled(found, {"kp": [], "kd": [], **gains}, signals)
        if not lacks and where.gains.keys() < gains.keys():
            controlled = replace(controlled, reason=f"{DOUBT}{GAINS_OF_FILE}")
        signals += [] if lacks else [controlled]
        proposal = controlled.value
    else:
        lacks = NO_TORQUE
        # A recording in several files, of which not all are named.
        if not tables[0][1].names and _other_files(tables):
            raise _incomplete(tables, where)
    entries = (*of_files, of_joints, *of_time, *signals)
    return LogGuess(entries, lacks, where.unused, where.explained, proposal)


def _gains_of_file(robot: RobotModel, joints: Sequence[str]) -> dict[str, list[float]]:
    """Return kp and kd of the position actuators of the model file, where each joint has one."""
    stated = stated_actuators(robot.manifest) if robot.format == "mjcf" else {}
    if any(name not in stated or stated[name].kp <= 0.0 for name in joints):
        return {}
    return {key: [getattr(stated[name], key) for name in joints] for key in ("kp", "kd")}


def _controlled(
    found: Mapping[str, Columns], gains: Mapping[str, Any], signals: Sequence[_GuessedKey]
) -> _GuessedKey:
    """Return the torque of a position controller."""
    unit = next(entry.value["unit"] for entry in signals if entry.name == "q")
    told = found["q_des"]
    more = {"resample": "previous"} if told.time else {}
    check = {"magnitude": found["magnitude"].table()} if "magnitude" in found else {}
    command = told.table([unit] if isinstance(unit, str) else unit, **more)
    return _GuessedKey(
        "tau",
        {"pd": {"q_des": command, **gains, "delay": "profile", **check}},
        f"{DOUBT}no torque was recorded, but commands: the torque of their position controller, "
        "for the task 'actuators'; its gains are those of the file, in N m/rad and N m s/rad",
    )


def _incomplete(tables: Tables, where: Found) -> UsageError:
    names = list(chain.from_iterable(table.names for _, table in tables))
    listed = f"its columns are {first_names(names, 8)}" if names else "; ".join(where.explained)
    absent = {"q": "positions", "tau": "torques or currents"}
    lacking = " and no ".join(word for key, word in absent.items() if key not in where.signals)
    return UsageError(
        f"{', '.join(file for file, _ in tables)}: no {lacking} can be found"
        f"{': ' * bool(listed)}{listed}. A log needs positions and torques (or motor currents): "
        f"name all its files{_other_files(tables)}, or write the description by hand: joints, q = "
        "{ columns = [...] }, tau."
    )


def _other_files(tables: Tables) -> str:
    """Return the files beside those of `tables` that hold signals by their names, "" where none
    does."""
    known = {table.path.name for _, table in tables}
    beside = sorted(tables[0][1].path.parent.glob(f"*{tables[0][1].path.suffix}"))
    roles = {path.name: role_of(path.stem) for path in beside if path.name not in known}
    listed = [f"{name} ({role})" for name, role in roles.items() if role != "unexplained"]
    return f", of which {first_names(listed, 6)} lie beside it" if listed else ""


def scalar_joints(robot: RobotModel) -> list[str]:
    """Return the hinges and slides that move independently, in the order of the model."""
    kinds = scalar_kinds(robot)
    return [row for row in robot.torque_rows if row in kinds]


def _of_preset(file: tuple[str, LogTable], robot: RobotModel, name: str) -> Iterator[_GuessedKey]:
    """Yield the keys that a preset leaves open."""
    preset, table = preset_keys()[name], file[1]
    yield _GuessedKey("file", file[0])
    yield _GuessedKey("preset", name, f"the columns are those of {preset['title']}")
    joints = _sized(scalar_joints(robot), _matched(table, preset["q"]["match"]).shape[1])
    yield _GuessedKey("joints", joints, "in the order of the model: check it")
    if "desired" in preset:
        patterns = (preset["desired"]["current"], preset["desired"]["torque"], preset["v"]["match"])
        current, torque, v = (_matched(table, pattern) for pattern in patterns)
        same = current.shape == torque.shape == v.shape
        if known := drive_gains(current, torque, v) if same else None:
            yield _GuessedKey("tau", {"gain": known[0]}, known[1])


def _matched(table: LogTable, pattern: str) -> Array:
    """Return the columns (N, k) whose names match a pattern, in the order of its number."""
    found = [hit for name in table.names if (hit := re.fullmatch(pattern, name)) is not None]
    return table.columns([hit[0] for hit in sorted(found, key=lambda hit: int(hit[1]))])


def _sized(joints: Sequence[str], count: int) -> list[str]:
    """Return the first joints of a robot, "-" for columns beyond them."""
    return [*joints[:count], *[NO_JOINT] * (count - len(joints))]


def _joints(q: Columns, joints: Sequence[str], tables: Tables) -> _GuessedKey:
    count = q.values.shape[1]
    lists = [list(x) for _, table in tables for x in table.constants.values() if len(x) == count]
    listed = next((names for names in lists if set(names) <= set(joints)), None)
    if listed is not None and len(set(listed)) == count:
        return _GuessedKey("joints", listed, "the file lists them")
    named = column_names.joints_of_columns([str(column) for column in q.columns], joints)
    if named is not None and len(named) == count:
        reason = "their names are in those of the columns"
        return _GuessedKey("joints", named, _misspelt(q, named, joints, tables) or reason)
    reason = "in the order of the model: check it"
    if count != len(joints):
        reason = f"{DOUBT}{count} columns for the {len(joints)} joints of the model: check them"
    return _GuessedKey("joints", _sized(joints, count), reason)


ALIKE: Final = 0.85
"""Similarity (difflib) above which a column's name may be that of a joint, misspelt."""


def _misspelt(q: Columns, named: Sequence[str], joints: Sequence[str], tables: Tables) -> str:
    """Return the doubt about a column that names no joint, but nearly one without positions; ""
    where there is none."""
    others = [
        name
        for _, table in tables
        for name in table.names
        if not column_names.joint_in(name, joints)
    ]
    for joint in (joint for joint in joints if joint not in named):
        expected = str(q.columns[0]).replace(named[0], joint)
        for name in get_close_matches(expected, others, 1, ALIKE):
            return f"{DOUBT}{joint!r} has no column and counts as still; is {name!r} its position?"
    return ""


def _time(found: Mapping[str, Columns], tables: Tables) -> tuple[list[_GuessedKey], float]:
    """Return time stamps or the rate, none where positions have their own, and the rate in Hz."""
    if "time" in found:
        time = found["time"]
        unit, rate, reason = stamp_unit(time.values[:, 0])
        file = {} if time.file is None else {"file": time.file}
        value = {"column": time.columns[0], "unit": unit, **file}
        return [_GuessedKey("time", value, reason)], rate
    if found["q"].time is not None:
        own = found["q"].time["column"]
        table = dict(tables)[found["q"].file or tables[0][0]]
        return [], stamp_unit(table.columns([own])[:, 0])[1]
    stated = next((table.rate for _, table in tables if table.rate), None)
    if stated:
        return [_GuessedKey("rate", f"{stated:g} Hz", "the file states it")], stated
    q, v = found["q"].values, found["v"].values if "v" in found else None
    measured = None if v is None or v.shape != q.shape else _agreeing_rate(q, v, 100.0)
    if measured:
        reason = f"{DOUBT}no time stamps; v and the differences of q agree at this rate"
        return [_GuessedKey("rate", f"{measured:.4g} Hz", reason)], measured
    reason = f"{DOUBT}neither stamps nor v give it: write the rate of the recorder"
    return [_GuessedKey("rate", "200 Hz", reason)], 200.0


def _agreeing_rate(q: Array, v: Array, rate: float) -> float | None:
    """Return the rate (Hz) at which v (N, k) and the differences of q agree, None without one."""
    valid = ~check_finite(q, v)
    joints = [str(j) for j in range(q.shape[1])]
    return check_rates(q[valid], v[valid], rate, joints)[1]


def _signals(
    found: Mapping[str, Columns], joints: Sequence[str], robot: RobotModel, rate: float
) -> Iterator[_GuessedKey]:
    """Yield q, v and tau with their units."""
    q, v, tau = found["q"], found.get("v"), found.get("tau")
    kinds = [scalar_kinds(robot).get(joint, "hinge") for joint in joints]

    def units(of_hinges: str, of_slides: str) -> list[str]:
        return [of_hinges if kind == "hinge" else of_slides for kind in kinds]

    unit, reason = _position_unit(q, joints, kinds, robot)
    yield _GuessedKey("q", q.table(units(unit, "m")), q.said(reason))
    if v is not None and v.values.shape[1] == q.values.shape[1]:
        rows = min(len(v.values), len(q.values))  # files of one signal each may end apart
        scale = np.where(np.array(units(unit, "m")) == "deg", np.pi / 180, 1.0)
        unit_v = f"{unit}/s"
        reason = f"{DOUBT}v and the differences of q do not agree; the unit of q is taken"
        for tried, size in (("rad/s", 1.0), ("deg/s", np.pi / 180.0)):
            measured = _agreeing_rate(q.values[:rows] * scale, v.values[:rows] * size, rate)
            # Lost samples halve the mean rate; deg/s and rad/s are 57 apart.
            if measured is not None and 1 / 3 < measured / rate < 3:
                unit_v, reason = tried, "v and the differences of q agree in it"
                break
        yield _GuessedKey("v", v.table(units(unit_v, "m/s")), v.said(reason))
    if tau is None:
        return
    k, name = len(kinds), " ".join([tau.file or "", *map(str, tau.columns)])
    if tau.values.shape[1] != k:
        raise UsageError(
            f"{k} columns of positions, but {tau.values.shape[1]} of torques: "
            f"{first_names(map(str, tau.columns), 8)}; write the description by hand."
        )
    if tau.is_current:
        known = {"gain": list(tau.gain)} if tau.gain else {}
        reason = tau.said("" if known else "no gain is known")
        yield _GuessedKey("tau", tau.table(["A"], **known), reason)
        return
    reason = "torques, by their names: of motors, give ratio; of currents, unit A and gain"
    if tau.reason:
        reason = ""
    elif not words_of(name) & _TORQUES:
        reason = f"{DOUBT}taken for torques of joints; for currents write unit A and gain, ratio"
    yield _GuessedKey("tau", tau.table(units("N m", "N")), tau.said(reason))


def _position_unit(
    q: Columns, joints: Sequence[str], kinds: Sequence[str], robot: RobotModel
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
