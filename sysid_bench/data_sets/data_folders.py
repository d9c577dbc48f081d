"""Folders of recorded data on this machine: the mirror that a variable names, and the cache."""

import os
from pathlib import Path
from typing import Final

from sysid_bench.input_files import is_file

MIRROR: Final = "SYSID_BENCH_DATA"
"""Variable that names a folder with the files of data sets, as `fetch -o` writes it."""


def mirror_folder() -> Path | None:
    """Return the folder that MIRROR names, None where it is not set."""
    named = os.environ.get(MIRROR)
    return Path(named) if named else None


def cache_folder() -> Path:
    """Return the folder that `fetch` writes to: sysid-bench/datasets below XDG_CACHE_HOME, which is
    ~/.cache by default."""
    named = os.environ.get("XDG_CACHE_HOME")
    return (Path(named) if named else Path.home() / ".cache") / "sysid-bench" / "datasets"


def find_data(path: str) -> Path | None:
    """Return the file at `path` below the mirror or the cache, None where neither has it."""
    folders = (mirror_folder(), cache_folder())
    return next((f / path for f in folders if f is not None and is_file(f / path)), None)
