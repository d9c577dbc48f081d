"""Folders of recorded data on this machine: the mirror that a variable names, and the cache."""

import os
from functools import lru_cache
from pathlib import Path
from typing import Final

from sysid_bench.input_files import file_hash, is_file

MIRROR: Final = "SYSID_BENCH_DATA"
"""Variable that names a folder with the files of data sets, as `fetch -o` writes it."""


def source_folder() -> Path | None:
    """Return the folder that MIRROR names, None where it is not set."""
    named = os.environ.get(MIRROR)
    return Path(named) if named else None


def cache_folder() -> Path:
    """Return the folder that `fetch` writes to: sysid-bench/datasets below XDG_CACHE_HOME, which is
    ~/.cache by default."""
    named = os.environ.get("XDG_CACHE_HOME")
    return (Path(named) if named else Path.home() / ".cache") / "sysid-bench" / "datasets"


def has_hash(path: Path, size: int, sha256: str) -> bool:
    """True for a file of `size` bytes with this SHA-256, which is taken once for each change."""
    if not is_file(path):
        return False
    status = path.stat()
    return status.st_size == size and _hash(path, status.st_mtime_ns, size) == sha256


@lru_cache(maxsize=1024)
def _hash(path: Path, changed: int, size: int) -> str:
    """SHA-256 of the file as last changed at `changed` (ns)."""
    return file_hash(path)
