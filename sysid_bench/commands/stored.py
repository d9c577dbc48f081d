"""Values kept in the user's cache until packages change: reading them takes milliseconds, and
asking plug-ins and the metadata of packages up to a second."""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar
from zlib import crc32

T = TypeVar("T")

_PACKAGE = Path(__file__).parents[1]


def stored(name: str, make: Callable[[], T]) -> T:
    """Return a JSON value of this installation, stored or made anew; a cache that cannot be written
    makes the answer slow and nothing else."""
    # The folder of packages changes when one is installed or removed.
    packages = [Path(path) for path in sys.path if path.endswith("-packages")]
    own = [_PACKAGE, _PACKAGE / "commands"]
    code = (file for folder in own for file in sorted(folder.glob("*.py")))
    times = [path.stat().st_mtime_ns for path in (*packages, *own, *code) if path.exists()]
    file = cache_folder() / f"{name}-{crc32(f'{packages}{times}'.encode()):08x}.json"
    try:
        value: T = json.loads(file.read_text(encoding="utf-8"))
        return value
    except (OSError, ValueError):
        value = make()
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        for older in file.parent.glob(f"{name}-*"):
            # One file of a name: caches do not grow with each edit of a checkout.
            older.unlink()
        # Whole or not at all: other commands may read it, or write it at the same time.
        part = file.with_name(f"{file.name}.{os.getpid()}")
        part.write_text(json.dumps(value), encoding="utf-8")
        part.replace(file)
    except OSError:
        pass
    return value


def cache_folder() -> Path:
    """Return the folder of this program in the user's cache."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "sysid_bench"
