"""Signals of a recording by the names of its columns: what loggers usually write."""

import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Final

WORDS: Final[Mapping[str, frozenset[str]]] = {
    "q": frozenset(["q", "pos", "position", "positions", "qpos", "angle", "angles", "state"]),
    "v": frozenset(["v", "dq", "qd", "vel", "velocity", "velocities", "qvel", "speed"]),
    "tau": frozenset(
        ["tau", "torque", "torques", "effort", "efforts", "current", "currents", "curr", "trq"]
    ),
    "time": frozenset(["t", "time", "timestamp", "stamp", "times", "seconds"]),
}
"""Words in the names of columns, arrays and files by what they hold."""

_COMMANDED: Final = frozenset(
    ["ref", "des", "desired", "cmd", "command", "commands", "target", "action", "d"]
)
CURRENTS: Final = frozenset(["current", "currents", "curr", "i"])
"""Words of motor currents; "i" alone may also be an index, and counts in names of files."""

_ROLES: Final[Mapping[str, frozenset[str]]] = {
    "command": _COMMANDED,
    "temperature": frozenset(["temp", "temperature", "temperatures"]),
    "gain": frozenset(["kp", "kd", "gain", "gains", "stiffness", "damping"]),
    "current": CURRENTS,
    "torque": WORDS["tau"],
    "acceleration": frozenset(["a", "acc", "ddq", "qdd", "qacc", "acceleration", "accelerations"]),
    "velocity": WORDS["v"],
    "position": WORDS["q"],
    "time": WORDS["time"],
}
"""Words of what columns hold, the first that fits."""

_OTHER: Final = _COMMANDED | {"error", "predicted", "ext", "se"}
"""Words of columns that are not measured at the joint."""

_MEASURED: Final = frozenset({"meas", "measured", "act", "actual"})
"""Words that set measured columns apart from others of the signal."""

_ROS: Final = {"q": "position", "v": "velocity", "tau": "effort"}
"""Words in the names of ROS columns, `<joint>_position`."""

_NUMBER: Final = re.compile(r"(.*?)(\d+)\D*$")


def words_of(name: str) -> frozenset[str]:
    """Return the words of a name in lower case: "data/jointPos_deg_3" has data, joint, pos, deg."""
    return frozenset(re.sub(r"[^A-Za-z]+|(?<=[a-z])(?=[A-Z])", " ", name).lower().split())


def is_signal(name: str, signal: str) -> bool:
    """Test whether a name says that it holds a measured signal."""
    words = words_of(name)
    return bool(words & WORDS[signal]) and not words & _OTHER


def role_of(name: str) -> str:
    """Return what the words of a name say that it holds, "unexplained" where they say nothing."""
    words = words_of(name)
    return next((role for role, known in _ROLES.items() if words & known), "unexplained")


def is_command_file(stem: str) -> bool:
    """Test whether the name of a file says that it holds commands."""
    return bool(words_of(stem) & (_COMMANDED | {"control"} - {"d"}))


def command_columns(names: Mapping[str, tuple[int, ...]], joints: Sequence[str]) -> list[str]:
    """Return the columns of commanded positions: `q_des_1`, `elbow_target_position`, or an array
    such as `action`; [] without them."""
    bare: dict[str, str] = {}
    for name in names:
        if words_of(name) & _COMMANDED:
            words = re.split(r"([^A-Za-z]+)", name)
            kept = [word for word in words if word.lower() not in _COMMANDED]
            bare.setdefault("".join(kept).strip("_./ ") or "q", name)
    chosen = columns_of_signal({k: names[name] for k, name in bare.items()}, "q", joints)
    return [bare[name] for name in chosen]


def is_measured(name: str) -> bool:
    """Test whether a name says that its column was measured, as tau_meas1 does beside tau_con1."""
    return bool(words_of(name) & _MEASURED)


def time_column(names: Iterable[str]) -> str | None:
    """Return the column of time stamps: the shortest name with a word for time."""
    return min((name for name in names if is_signal(name, "time")), key=len, default=None)


def usual_columns(names: Collection[str], signal: str, joints: Sequence[str]) -> list[str]:
    """Return the columns of a signal for some joints by the usual names, [] where they are not all
    there: one for each joint, or an array."""
    for pattern in (f"{signal}_{{}}", f"{{}}_{_ROS[signal]}"):
        columns = [pattern.format(joint) for joint in joints]
        if columns and set(columns).issubset(names):
            return columns
    return next(([name] for name in (signal, _ROS[signal]) if name in names), [])


def columns_of_signal(
    names: Mapping[str, tuple[int, ...]], signal: str, joints: Sequence[str]
) -> list[str]:
    """Return the columns of a signal: by the names of joints, numbered ones, or one array; [] where
    the names hold none."""
    single = single_columns(names, signal)
    single = list(filter(is_measured, single)) or single
    arrays = [name for name in names if is_signal(name, signal) and len(names[name]) > 1]
    arrays = list(filter(is_measured, arrays)) or arrays
    by_joint: dict[str, str] = {}
    for name in single:
        by_joint.setdefault(joint_in(name, joints), name)
    return (
        usual_columns(names, signal, joints)
        or [by_joint[joint] for joint in joints if joint in by_joint]
        or _numbered(single)
        or arrays[:1]
        or single[:1]
    )


def single_columns(names: Mapping[str, tuple[int, ...]], signal: str) -> list[str]:
    """Return the names of one column that may be those of a signal; columns "q:1" of an array have
    its name."""
    return [
        name
        for name in names
        if is_signal(name, signal)
        and len(names[name]) == 1
        and name.rpartition(":")[0] not in names
    ]


def joint_in(name: str, joints: Sequence[str]) -> str:
    """Return the longest of the joints that a name contains, "" without one."""
    longest_first = sorted(joints, key=len, reverse=True)
    return next((joint for joint in longest_first if joint in name), "")


def joints_of_columns(columns: Sequence[str], joints: Sequence[str]) -> list[str] | None:
    """Return the joint that each column names, None unless each names another one."""
    found = [joint_in(name, joints) for name in columns]
    return found if all(found) and len(set(found)) == len(found) else None


def _numbered(names: Sequence[str]) -> list[str]:
    """Return the columns of the first stem with several numbers, by number: pos1, pos2, ..."""
    stems: dict[str, dict[int, str]] = defaultdict(dict)
    for name in names:
        found = _NUMBER.match(name)
        if found is not None and len(found[2]) < 9:
            stems[found[1]].setdefault(int(found[2]), name)
    longest = max(stems.values(), key=len, default={})
    return [longest[number] for number in sorted(longest)] if len(longest) > 1 else []
