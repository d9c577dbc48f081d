"""Values kept in the user's cache until packages change: reading them takes milliseconds, and
asking plug-ins and the metadata of packages up to a second."""

import json
import os
import sys
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")

_PACKAGE = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
_FOLDER = "sysid_bench"


def stored(name: str, make: Callable[[], T]) -> T:
    """Return a JSON value of this installation, stored or made anew; a cache that cannot be written
    makes the answer slow and nothing else."""
    path = os.path.join(cache_folder(), f"{name}-{_state()}.json")
    try:
        with open(path, encoding="utf-8") as file:
            value: T = json.load(file)
    except (OSError, ValueError):
        value = make()
        _store(path, f"{name}-", value)
    return value


def cache_folder() -> str:
    """Return the folder of this program in the user's cache."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return os.path.join(base, _FOLDER)


def _state() -> str:
    """Text that changes with the code of this package and the packages beside it, whose folder
    changes when one is installed or removed."""
    folders = [path for path in sys.path if path.endswith("-packages")]
    own = [_PACKAGE, os.path.join(_PACKAGE, "commands")]
    files = (*folders, *own, *_entries(own[0]), *_entries(own[1]))
    times = [os.stat(path).st_mtime_ns for path in files if os.path.exists(path)]
    return f"{_checksum(f'{folders}{times}'.encode()):016x}"


def _checksum(data: bytes) -> int:
    """FNV-1a of 64 bits, the same in every process; hashlib would be one more import."""
    value = 0xCBF29CE484222325
    for byte in data:
        value = (value ^ byte) * 0x100000001B3 & 0xFFFFFFFFFFFFFFFF
    return value


def _entries(folder: str) -> list[str]:
    with os.scandir(folder) as entries:
        return sorted(entry.path for entry in entries if entry.name.endswith(".py"))


def _store(path: str, start: str, value: Any) -> None:
    """Write a cache in place of older ones, whole or not at all."""
    folder = os.path.dirname(path)
    part = f"{path}.{os.getpid()}"
    try:
        os.makedirs(folder, exist_ok=True)
        for name in os.listdir(folder):
            if name.startswith(start):
                os.remove(os.path.join(folder, name))
        with open(part, "w", encoding="utf-8") as file:
            json.dump(value, file)
        os.replace(part, path)
    except OSError:
        return
