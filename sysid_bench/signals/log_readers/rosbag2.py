"""ROS 2 bags, sqlite3 and MCAP, read without ROS: messages of one topic as rows."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np

from sysid_bench.errors import UsageError, first_names
from sysid_bench.input_files import check_file, is_file
from sysid_bench.signals.library_errors import library_errors
from sysid_bench.signals.log_library import log_library
from sysid_bench.signals.log_table import LARGEST_LOG, LogTable
from sysid_bench.signals.read_progress import report
from sysid_bench.signals.ros_types import RosTypes, joint_columns, scalar_columns
from sysid_bench.types import Array

JOINT_STATE: Final = "sensor_msgs/msg/JointState"


_LARGEST: Final = 2**40
"""Bytes of a file; a bag holds images beside the messages that are read."""


@dataclass(frozen=True)
class Rosbag2:
    """Messages of a topic, by default the only one of joint states: `t` (s) is the stamp of the bag
    from its start, `t_header` that of the message from the same instant.

    Joint states give `<joint>_position`, `<joint>_velocity` and `<joint>_effort` in the order of
    the names, whatever the order in each message; where messages differ in their joints, those
    with `joint` are read. Other messages give their numbers by field ("wrench.force.x").
    """

    topic: str = ""
    joint: str = ""
    suffixes: ClassVar[tuple[str, ...]] = (".db3", ".mcap")
    folder_files: ClassVar[tuple[str, ...]] = ("metadata.yaml", "*.db3", "*.mcap", "*.zstd")

    def read(self, path: Path) -> LogTable:
        """Return the messages as rows; raises UsageError for a damaged bag, or where the topic or
        the joints are not clear."""
        for file in [path] if is_file(path) else self._files(path):
            check_file(file, _LARGEST)
        library = log_library("rosbags.rosbag2", path)
        with library_errors(path, "a ROS 2 bag"), library.Reader(path) as bag:
            return self._table(path, bag)

    def _files(self, folder: Path) -> list[Path]:
        return [file for pattern in self.folder_files for file in folder.glob(pattern)]

    def _table(self, path: Path, bag: Any) -> LogTable:
        connections = self._chosen(path, bag.connections)
        count = sum(connection.msgcount for connection in connections)
        if count * 8 > LARGEST_LOG:
            raise UsageError(f"{path} states {count} messages, more than a log may have.")
        messages = _messages(path, bag, connections)
        is_state = connections[0].msgtype == JOINT_STATE
        rows = joint_columns(path, messages, self.joint) if is_state else scalar_columns(messages)
        stamps, headers, columns = rows
        if not len(stamps):
            raise UsageError(f"{path} holds no message of {connections[0].topic!r}.")
        start = min(stamps[0], bag.start_time)
        times = {"t": _seconds(stamps, start)}
        if headers.any():
            times["t_header"] = _seconds(headers, start)
        return _named_table(path, {**times, **columns})

    def _chosen(self, path: Path, connections: Sequence[Any]) -> list[Any]:
        """Return the connections of the topic; raises UsageError with all topics where it is not
        clear."""
        wanted = self.topic or _only_joint_states(connections)
        found = [c for c in connections if c.topic == wanted]
        if len({c.msgtype for c in found}) == 1:
            return found
        listed = [f"{c.topic} ({c.msgtype}, {c.msgcount} messages)" for c in connections]
        raise UsageError(
            f"{path}: which topic? Name one of {first_names(listed)} with reader = {{ use = "
            "'rosbag2', topic = '...' }."
        )


def _messages(path: Path, bag: Any, connections: Sequence[Any]) -> Iterator[tuple[int, Any]]:
    """Yield bag stamp (ns) and content of each message."""
    types = RosTypes(path)
    total = sum(connection.msgcount for connection in connections)
    for number, (connection, stamp, raw) in enumerate(bag.messages(connections)):
        if number % 1000 == 0:
            report(path, number, total)
        yield stamp, types.read(connection, raw)


def _seconds(stamps: Iterable[int], start: int) -> Array:
    # Differences of whole nanoseconds: s since 1970 would be rounded to 0.2 us.
    return np.array([int(stamp) - start for stamp in stamps], dtype=float) * 1e-9


def _only_joint_states(connections: Sequence[Any]) -> str:
    """Return the topic of the joint states, "" where there is not exactly one."""
    states = {c.topic for c in connections if c.msgtype == JOINT_STATE}
    return states.pop() if len(states) == 1 else ""


def _named_table(path: Path, columns: dict[str, Array]) -> LogTable:
    """Return columns by name, and those of a kind of joint signals together."""
    single: dict[str, tuple[int, ...]] = {name: (i,) for i, name in enumerate(columns)}
    several = {kind: _ending(columns, kind) for kind in ("position", "velocity", "effort")}
    joint = {kind: found for kind, found in several.items() if len(found) > 1}
    # The name of a single column stands; single columns come first.
    return LogTable(path, np.column_stack(list(columns.values())), single | joint | single)


def _ending(columns: Iterable[str], kind: str) -> tuple[int, ...]:
    """Return the indices of the columns of a kind of joint signals."""
    return tuple(i for i, name in enumerate(columns) if name.endswith(f"_{kind}"))
