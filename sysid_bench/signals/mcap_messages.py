"""MCAP files of other recorders than ROS 2: messages in JSON, and in protobuf by the descriptors in
the file."""

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from sysid_bench.errors import UsageError, first_names
from sysid_bench.signals.log_library import log_library

_MAGIC = b"\x89MCAP0\r\n"


def is_of_another(path: Path) -> bool:
    """Test whether a file is MCAP with another profile than that of ROS 2."""
    with path.open("rb") as file:
        start = file.read(64)
    # Magic, code and length (9 bytes) of the header, then the length of the profile and its text.
    return start.startswith(_MAGIC) and start[21 : 21 + start[17]] != b"ros2"


def read_messages(path: Path, topic: str) -> Iterator[tuple[int, Any]]:
    """Yield stamp (ns) and content, of mappings, lists and numbers, of each message of a topic, by
    default the only one.

    Raises UsageError with all topics where it is not clear, and for another encoding.
    """
    library = log_library("mcap.reader", path)
    with path.open("rb") as file:
        summary = library.make_reader(file).get_summary()
        if summary is None:
            raise ValueError("it ends before its summary: the recorder was stopped")
        kinds = {c.topic: c.message_encoding for c in summary.channels.values()}
        wanted = topic or (next(iter(kinds)) if len(kinds) == 1 else "")
        if wanted not in kinds:
            listed = first_names([f"{name} ({kind})" for name, kind in kinds.items()])
            raise UsageError(
                f"{path}: which topic? Name one of {listed} with reader = {{ use = 'rosbag2', "
                "topic = '...' }."
            )
        decoders: dict[int, Callable[[bytes], Any]] = {}
        for schema, channel, message in library.make_reader(file).iter_messages(topics=[wanted]):
            if channel.id not in decoders:
                decoders[channel.id] = _decoder(path, channel.message_encoding, schema)
            yield message.log_time, decoders[channel.id](message.data)


def _decoder(path: Path, encoding: str, schema: Any) -> Callable[[bytes], Any]:
    """Return what decodes the messages of a channel; raises UsageError for another encoding."""
    if encoding == "json":
        return json.loads
    if encoding != "protobuf" or schema is None:
        raise UsageError(
            f"{path}: its messages are in {encoding!r}; json, protobuf and those of ROS 2 are read."
        )
    found = log_library("google.protobuf.descriptor_pb2", path).FileDescriptorSet()
    found.ParseFromString(schema.data)
    pool = log_library("google.protobuf.descriptor_pool", path).DescriptorPool()
    left = {file.name: file for file in found.file}

    def add(name: str) -> None:  # files that it imports come first
        file = left.pop(name, None)
        if file is not None:
            for other in file.dependency:
                add(other)
            pool.AddSerializedFile(file.SerializeToString())

    for name in list(left):
        add(name)
    kind = pool.FindMessageTypeByName(schema.name)
    message = log_library("google.protobuf.message_factory", path).GetMessageClass(kind)
    return lambda data: _plain(message.FromString(data))


def _plain(value: Any) -> Any:
    """Return a protobuf message as mappings, lists and numbers, defaults among them."""
    if hasattr(value, "DESCRIPTOR"):
        return {f.name: _plain(getattr(value, f.name)) for f in value.DESCRIPTOR.fields}
    if isinstance(value, (bool, int, float, str, bytes, Mapping)):
        return value
    return [_plain(part) for part in value]
