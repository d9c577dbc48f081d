"""Content of ROS 2 messages as numbers: joint states by name, other messages by field."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, first_names
from sysid_bench.signals.log_library import log_library
from sysid_bench.types import Array

SIGNALS: Final = ("position", "velocity", "effort")

Rows = tuple[list[int], Array, dict[str, Array]]
"""Stamps of bag and header (ns, (N,)), and columns (N,) by name."""


class RosTypes:
    """Types of messages: those of ROS, and those that the bag itself defines."""

    def __init__(self, path: Path) -> None:
        self._system = log_library("rosbags.typesys", path)
        self._store = self._system.get_typestore(self._system.Stores.LATEST)

    def read(self, connection: Any, raw: bytes) -> Any:
        """Return a message; raises ValueError for a type that nobody defines."""
        if connection.msgtype not in self._store.types:
            self._register(connection)
        return self._store.deserialize_cdr(raw, connection.msgtype)

    def _register(self, connection: Any) -> None:
        definition = connection.msgdef
        if definition.format.name == "MSG":
            found = self._system.get_types_from_msg(definition.data, connection.msgtype)
        elif definition.format.name == "IDL":
            found = self._system.get_types_from_idl(definition.data)
        else:
            raise ValueError(f"the type {connection.msgtype} is not defined in the bag")
        self._store.register({k: v for k, v in found.items() if k not in self._store.types})


def joint_columns(path: Path, messages: Iterable[tuple[int, Any]], joint: str) -> Rows:
    """Return joint states in the order of the names of their joints; raises UsageError where
    messages differ in their joints and `joint` does not decide."""
    stamps: list[int] = []
    headers: list[int] = []
    rows: list[Array] = []
    kinds: Counter[tuple[str, ...]] = Counter()
    orders: dict[tuple[str, ...], list[int]] = {}
    for stamp, message in messages:
        names = tuple(message.name)
        if names not in orders:
            orders[names] = sorted(range(len(names)), key=names.__getitem__)
        if joint and joint not in names:
            continue
        kinds[tuple(names[i] for i in orders[names])] += 1
        _check_joints(path, kinds)
        stamps.append(stamp)
        headers.append(_header_stamp(message))
        rows.append(_ordered(message, orders[names]))
    (joints,) = kinds or [()]
    return stamps, np.array(headers), _known_columns(rows, joints)


def _known_columns(rows: list[Array], joints: Iterable[str]) -> dict[str, Array]:
    """Return the numbers of joints by name, of each signal that some message states."""
    values = np.array(rows).reshape(len(rows), -1)
    names = [f"{name}_{signal}" for signal, name in product(SIGNALS, joints)]
    return {name: x for name, x in zip(names, values.T, strict=True) if np.isfinite(x).any()}


def _check_joints(path: Path, kinds: Mapping[tuple[str, ...], int]) -> None:
    if len(kinds) > 1:
        first, second = (first_names(names) for names in list(kinds)[:2])
        raise UsageError(
            f"{path}: some messages hold the joints {first}, others {second}; choose those with "
            "one joint: reader = { use = 'rosbag2', joint = '...' }."
        )
    if len(set(next(iter(kinds)))) < len(next(iter(kinds))):
        raise UsageError(f"{path}: a message names a joint twice.")


def _ordered(message: Any, order: list[int]) -> Array:
    """Return position, velocity, effort (3 k,) of the joints in an order; NaN where a message has
    none."""
    parts = [getattr(message, signal) for signal in SIGNALS]
    empty = np.full(len(order), np.nan)
    return np.concatenate([part[order] if len(part) == len(order) else empty for part in parts])


def _header_stamp(message: Any) -> int:
    """Return the stamp in the header of a message (ns), 0 without one."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else int(stamp.sec) * 10**9 + int(stamp.nanosec)


def scalar_columns(messages: Iterable[tuple[int, Any]]) -> Rows:
    """Return the numbers of messages by field; raises ValueError where they differ in number."""
    stamps: list[int] = []
    headers: list[int] = []
    rows: list[dict[str, float]] = []
    for stamp, message in messages:
        row = dict(_numbers("", message))
        row.pop("header.stamp.sec", None), row.pop("header.stamp.nanosec", None)
        if rows and row.keys() != rows[0].keys():
            raise ValueError("its messages differ in the number of their values")
        stamps.append(stamp)
        headers.append(_header_stamp(message))
        rows.append(row)
    names = list(rows[0]) if rows else []
    return stamps, np.array(headers), {name: np.array([r[name] for r in rows]) for name in names}


def _numbers(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """Yield name and number of each field, recursing into messages and arrays."""
    if isinstance(value, (bool, int, float)):
        yield name, float(value)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        yield from ((f"{name}:{i}", float(x)) for i, x in enumerate(value.ravel(), start=1))
    elif isinstance(value, list):
        for i, part in enumerate(value, start=1):
            yield from _numbers(f"{name}:{i}", part)
    elif is_dataclass(value):
        for field in _fields(value):
            yield from _numbers(f"{name}.{field}" if name else field, getattr(value, field))


def _fields(message: Any) -> list[str]:
    return [field.name for field in fields(message) if field.name != "__msgtype__"]
