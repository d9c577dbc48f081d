"""Files of messages over time: bags of ROS 1 and 2, read without ROS, other MCAP files, and Rerun
recordings."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, Final

import numpy as np

from sysid_bench.errors import UsageError, first_names
from sysid_bench.input_files import check_file, is_file
from sysid_bench.signals.log_library import library_errors, log_library, report
from sysid_bench.signals.log_table import LARGEST_LOG, LogTable, columns_with_names
from sysid_bench.signals.mcap_messages import is_of_another, read_messages
from sysid_bench.types import Array

JOINT_STATE: Final = "sensor_msgs/msg/JointState"
_JOINT_SIGNALS: Final = ("position", "velocity", "effort")

_LARGEST: Final = 2**40
"""Bytes of a bag, which holds images beside the messages that are read."""

_SCALARS: Final = "Scalars:scalars"
_AUTOMATIC: Final = ("log_time", "log_tick")
"""Timelines that every Rerun recording has, of the computer that wrote it."""

_Rows = tuple[list[int], list[int], dict[str, Array]]
"""Stamps of bag and header (ns), and columns (N,) by name."""


@dataclass(frozen=True)
class Rosbag2:
    """Messages of a topic, by default the only one of joint states: `t` (s) is the stamp of the bag
    from its start, `t_header` that of the message from the same instant.

    Joint states give `<joint>_position`, `<joint>_velocity` and `<joint>_effort` in the order of
    the names, whatever the order in each message; where messages differ in their joints, those
    with `joint` are read. Other messages give their numbers by field ("wrench.force.x"), also those
    of MCAP files of other recorders, in JSON or protobuf.
    """

    topic: str = ""
    joint: str = ""
    name: ClassVar[str] = "rosbag2"
    version: ClassVar[int] = 2
    suffixes: ClassVar[tuple[str, ...]] = (".db3", ".mcap")
    folder_files: ClassVar[tuple[str, ...]] = ("metadata.yaml", "*.db3", "*.mcap", "*.zstd")

    def read(self, path: Path) -> LogTable:
        """Return the messages as rows; raises UsageError for a damaged bag, or where the topic or
        the joints are not clear."""
        inner = [file for pattern in self.folder_files for file in path.glob(pattern)]
        for file in [path] if is_file(path) else inner:
            check_file(file, _LARGEST)
        if is_file(path) and path.suffix.lower() == ".mcap" and is_of_another(path):
            return self._read_mcap(path)
        library = log_library(f"rosbags.{self.name}", path)
        kind = f"a ROS {self.version} bag that can be read"
        with library_errors(path, kind), library.Reader(path) as bag:
            connections = self._of_topic(path, bag.connections)
            count = sum(connection.msgcount for connection in connections)
            if count * 8 > LARGEST_LOG:
                raise UsageError(f"{path} states {count} messages, more than a log may have.")
            messages = _messages(path, bag, connections, self.version)
            if connections[0].msgtype == JOINT_STATE:
                stamps, headers, columns = _joint_columns(path, messages, self.joint)
            else:
                stamps, headers, columns = _scalar_columns(messages)
            if not stamps:
                raise UsageError(f"{path} holds no message of {connections[0].topic!r}.")
            start = min(stamps[0], bag.start_time)
        return _table(path, (stamps, headers, columns), start)

    def _read_mcap(self, path: Path) -> LogTable:
        """Return the messages of a recorder that is not of ROS."""
        with library_errors(path, "an MCAP file that can be read"):
            messages = list(read_messages(path, self.topic))
            if not messages:
                raise UsageError(f"{path} holds no message of {self.topic or 'its only topic'!r}.")
            states = [(stamp, _joint_state(message)) for stamp, message in messages]
            if all(state is not None for _, state in states):
                rows = _joint_columns(path, states, self.joint)
            else:
                rows = _scalar_columns(messages)
        return _table(path, rows, rows[0][0])

    def _of_topic(self, path: Path, connections: Sequence[Any]) -> list[Any]:
        """Return the connections of the topic; raises UsageError with all topics where it is not
        clear."""
        states = {c.topic for c in connections if c.msgtype == JOINT_STATE}
        wanted = self.topic or (states.pop() if len(states) == 1 else "")
        found = [c for c in connections if c.topic == wanted]
        if len({c.msgtype for c in found}) == 1:
            return found
        listed = [f"{c.topic} ({c.msgtype}, {c.msgcount} messages)" for c in connections]
        raise UsageError(
            f"{path}: which topic? Name one of {first_names(listed)} with reader = {{ use = "
            f"{self.name!r}, topic = '...' }}."
        )


@dataclass(frozen=True)
class Rosbag1(Rosbag2):
    """The same of a bag of ROS 1."""

    name: ClassVar[str] = "rosbag1"
    version: ClassVar[int] = 1
    suffixes: ClassVar[tuple[str, ...]] = (".bag",)
    folder_files: ClassVar[tuple[str, ...]] = ()


def _table(path: Path, rows: _Rows, start: int) -> LogTable:
    """Return messages as a table, with times from an instant (ns)."""
    stamps, headers, columns = rows
    columns = {**_seconds(stamps, headers, start), **columns}
    return LogTable(path, np.column_stack(list(columns.values())), _indices(list(columns)))


def _joint_state(message: Any) -> Any:
    """Return a decoded message that names joints as that of ROS does, None for another one."""
    if not (isinstance(message, Mapping) and isinstance(message.get("name"), list)):
        return None
    parts = {name: np.array(message.get(name) or [], dtype=float) for name in _JOINT_SIGNALS}
    return SimpleNamespace(name=message["name"], **parts)


def _seconds(stamps: Sequence[int], headers: Sequence[int], start: int) -> dict[str, Array]:
    """Return the stamps of bag and header (ns), if there are any, in s from the start."""
    # Differences of whole nanoseconds: s since 1970 would be rounded to 0.2 us.
    times = {"t": stamps, "t_header": headers} if any(headers) else {"t": stamps}
    return {
        name: np.array([int(stamp) - start for stamp in part], dtype=float) * 1e-9
        for name, part in times.items()
    }


def _indices(names: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """Return the columns of each name; those of a kind of joint signals have a name together,
    unless a single one has it."""
    indices: dict[str, tuple[int, ...]] = {name: (i,) for i, name in enumerate(names)}
    for kind in _JOINT_SIGNALS:
        found = tuple(i for i, name in enumerate(names) if name.endswith(f"_{kind}"))
        if len(found) > 1:
            indices.setdefault(kind, found)
    return indices


def _messages(
    path: Path, bag: Any, connections: Sequence[Any], version: int
) -> Iterator[tuple[int, Any]]:
    """Yield bag stamp (ns) and content of each message, of types of ROS or of the bag itself;
    raises ValueError for a type that nobody defines."""
    system = log_library("rosbags.typesys", path)
    is_first = version == 1
    stores = system.Stores
    store = system.get_typestore(stores.ROS1_NOETIC if is_first else stores.LATEST)
    deserialize = store.deserialize_ros1 if is_first else store.deserialize_cdr
    total = sum(connection.msgcount for connection in connections)
    for number, (connection, stamp, raw) in enumerate(bag.messages(connections)):
        if number % 1000 == 0:
            report(path, number, total)
        if connection.msgtype not in store.types:
            definition = connection.msgdef
            if definition.format.name == "MSG":
                found = system.get_types_from_msg(definition.data, connection.msgtype)
            elif definition.format.name == "IDL":
                found = system.get_types_from_idl(definition.data)
            else:
                raise ValueError(f"the type {connection.msgtype} is not defined in the bag")
            store.register({k: v for k, v in found.items() if k not in store.types})
        yield stamp, deserialize(raw, connection.msgtype)


def _joint_columns(path: Path, messages: Iterable[tuple[int, Any]], joint: str) -> _Rows:
    """Return joint states in the order of the names of their joints; raises UsageError where
    messages differ in their joints and `joint` does not decide."""
    stamps: list[int] = []
    headers: list[int] = []
    rows: list[Array] = []
    joints: tuple[str, ...] = ()
    orders: dict[tuple[str, ...], list[int]] = {}
    for stamp, message in messages:
        names = tuple(message.name)
        if names not in orders:
            orders[names] = sorted(range(len(names)), key=names.__getitem__)
        if joint and joint not in names:
            continue
        order = orders[names]
        ordered = tuple(names[i] for i in order)
        if stamps and ordered != joints:
            raise UsageError(
                f"{path}: some messages hold the joints {first_names(joints)}, others "
                f"{first_names(ordered)}; choose those with one joint: reader = {{ use = "
                "'rosbag2', joint = '...' }."
            )
        if len(set(ordered)) < len(ordered):
            raise UsageError(f"{path}: a message names a joint twice.")
        joints = ordered
        stamps.append(stamp)
        headers.append(_header_stamp(message))
        rows.append(_joint_row(message, order))
    return stamps, headers, _stated_columns(rows, joints) if rows else {}


def _stated_columns(rows: Sequence[Array], joints: Sequence[str]) -> dict[str, Array]:
    """Return the joint signals that any message has, by name."""
    values = np.array(rows).reshape(len(rows), -1)
    words = [f"{name}_{signal}" for signal, name in product(_JOINT_SIGNALS, joints)]
    return {word: x for word, x in zip(words, values.T, strict=True) if np.isfinite(x).any()}


def _joint_row(message: Any, order: list[int]) -> Array:
    """Return the signals of a joint state, NaN where it has no such signal."""
    parts = [getattr(message, signal) for signal in _JOINT_SIGNALS]
    empty = np.full(len(order), np.nan)
    return np.concatenate([x[order] if len(x) == len(order) else empty for x in parts])


def _header_stamp(message: Any) -> int:
    """Return the stamp in the header of a message (ns), 0 without one."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _scalar_columns(messages: Iterable[tuple[int, Any]]) -> _Rows:
    """Return the numbers of messages by field; raises ValueError where they differ in number."""
    stamps: list[int] = []
    headers: list[int] = []
    rows: list[dict[str, float]] = []
    for stamp, message in messages:
        row = dict(_numbers("", message))
        for part in ("sec", "nanosec"):
            row.pop(f"header.stamp.{part}", None)
        if rows and row.keys() != rows[0].keys():
            raise ValueError("its messages differ in the number of their values")
        stamps.append(stamp)
        headers.append(_header_stamp(message))
        rows.append(row)
    names = list(rows[0]) if rows else []
    return stamps, headers, {name: np.array([row[name] for row in rows]) for name in names}


def _numbers(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """Yield name and number of each field, recursing into messages and arrays."""
    if isinstance(value, (bool, int, float)):
        yield name, float(value)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        yield from ((f"{name}:{i}", float(x)) for i, x in enumerate(value.ravel(), start=1))
    elif isinstance(value, list):
        for i, part in enumerate(value, start=1):
            # Of joints in a list, each with its name, the name is known.
            own = part.get("name") if isinstance(part, Mapping) else None
            yield from _numbers(f"{name}:{own if isinstance(own, str) else i}", part)
    elif isinstance(value, Mapping):
        for key, part in value.items():
            yield from _numbers(f"{name}.{key}" if name else str(key), part)
    elif is_dataclass(value):
        for field in (field.name for field in fields(value) if field.name != "__msgtype__"):
            yield from _numbers(f"{name}.{field}" if name else field, getattr(value, field))


@dataclass(frozen=True)
class RerunRecording:
    """Series of scalars of a Rerun recording, named by the paths of their entities, over one
    timeline: the largest set of entities with equal times, all of the file or those below the path
    `entity`; `t` is the time (s, or the number of a sequence)."""

    timeline: str = ""
    entity: str = ""
    suffixes: ClassVar[tuple[str, ...]] = (".rrd",)

    def read(self, path: Path) -> LogTable:
        """Return the series as columns; raises UsageError for a damaged file, or where the timeline
        is not clear."""
        check_file(path, LARGEST_LOG)
        chunks: dict[str, list[tuple[Array, Array]]] = defaultdict(list)
        with library_errors(path, "a Rerun recording that can be read"):
            batches = list(_scalar_batches(path, self.entity.strip("/")))
            timeline = self._timeline(path, [batch for _, batch in batches])
            for entity, batch in batches:
                if timeline in batch.schema.names:
                    chunks[entity].append((_times(batch.column(timeline)), _scalars(batch)))
            series = {entity: _joined(parts) for entity, parts in chunks.items()}
        sets: dict[bytes, list[str]] = defaultdict(list)
        for entity, (times, _) in series.items():
            sets[times.tobytes()].append(entity)
        if not sets:
            raise UsageError(f"{path} holds no series of scalars.")
        largest = max(sets.values(), key=lambda names: (len(names), len(series[names[0]][0])))
        times = series[largest[0]][0]
        together = {entity: (series[entity][1], ()) for entity in sorted(largest)}
        return LogTable(path, *columns_with_names(path, {"t": (times[:, None], ()), **together}))

    def _timeline(self, path: Path, batches: list[Any]) -> str:
        """Return the timeline named, or the only one that the recording's author chose: one that
        Rerun does not add itself, or that of logging alone."""
        names = {name for batch in batches for name in batch.schema.names}
        every = {name for name in names if ":" not in name and not name.startswith("rerun")}
        chosen = every - {*_AUTOMATIC} or every & {"log_time"}
        if self.timeline:
            chosen = {self.timeline}
        if len(chosen) == 1 and chosen <= every:
            return str(*chosen)
        raise UsageError(
            f"{path} has the timelines {', '.join(sorted(every)) or '(none)'}; name one with "
            "reader = { use = 'rerun', timeline = '...' }."
        )


def _scalar_batches(path: Path, below: str) -> Iterator[tuple[str, Any]]:
    """Yield entity and Arrow batch of each chunk of scalars that change over time."""
    library = log_library("rerun.chunk", path)  # 0.6 s, spent only where such a file is read
    for chunk in library.RrdReader(path).stream():
        entity = chunk.entity_path.strip("/")
        is_below = not below or entity == below or entity.startswith(f"{below}/")
        if is_below and not chunk.is_static:
            batch = chunk.to_record_batch()
            if _SCALARS in batch.schema.names:
                yield entity, batch


def _times(column: Any) -> Array:
    """Return times in s, or the numbers of a sequence; a date counts from 1970."""
    import pyarrow

    scale = 1.0 if pyarrow.types.is_integer(column.type) else 1e-9
    return np.asarray(column.cast(pyarrow.int64()).to_numpy(zero_copy_only=False) * scale)


def _scalars(batch: Any) -> Array:
    """Return the scalars (N, k) of a chunk; NaN where one logged none or another number of them."""
    lists = batch.column(batch.schema.names.index(_SCALARS))
    flat = np.asarray(lists.flatten().to_numpy(zero_copy_only=False), dtype=float)
    width = max(len(flat) // max(len(lists), 1), 1)
    lengths = np.array([len(value) if value.is_valid else 0 for value in lists])
    if (lengths == width).all():
        return flat.reshape(-1, width)
    rows = [value.as_py() or [] for value in lists]
    return np.array([row if len(row) == width else [np.nan] * width for row in rows], dtype=float)


def _joined(chunks: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return the chunks of an entity as one series in the order of time."""
    widest = max(x.shape[1] for _, x in chunks)
    kept = [(t, x) for t, x in chunks if x.shape[1] == widest]
    times = np.concatenate([t for t, _ in kept])
    order = np.argsort(times, kind="stable")
    return times[order], np.concatenate([x for _, x in kept])[order]
