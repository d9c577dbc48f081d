"""Content of the recordings and motions that a suite names, whatever their paths are called."""

from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from sysid_bench.canonical_json import canonical_hash
from sysid_bench.errors import SysidBenchError
from sysid_bench.input_files import file_hash
from sysid_bench.models.data_sets import SCHEME, find_motion
from sysid_bench.signals.log_description import log_description, read_keys


def content_of(written: str | Mapping[str, Any], folder: Path) -> dict[str, str]:
    """Return path as written -> 16 hex digits of its content, for a motion file, and for a log as a
    suite names it; without those that are not here, whose cells say so."""
    use = written if isinstance(written, str) else str(written.get("use", ""))
    found = {}
    with suppress(SysidBenchError, OSError):
        if use:
            found[use] = _content(use, folder)
    # A table of a suite may name another file; `$NAME/run.csv` is one below a variable.
    file = None if isinstance(written, str) else written.get("file")
    if isinstance(file, str):
        with suppress(SysidBenchError, OSError):
            hashes = [_hash(one) for one in log_description(written, folder).files]
            found[file] = canonical_hash(hashes)[:16]
    return found


def _content(use: str, folder: Path) -> str:
    """Hash of a motion of a data set, a description with its recordings, or a file."""
    if use.startswith(SCHEME):
        found, motion = find_motion(use, folder)
        stated = found.described  # what it states of its files, which need not be here
        parts = [stated.files_hash, stated.robot, stated.log, stated.motions[motion]]
    elif use.endswith(".toml"):
        keys, _ = read_keys(use, folder)
        files = log_description(use, folder).files
        parts = [_without_files(keys), *(_hash(file) for file in files)]
    else:
        return _hash(folder / use)
    return canonical_hash(parts)[:16]


def _without_files(keys: Any) -> Any:
    if isinstance(keys, Mapping):
        return {key: _without_files(value) for key, value in keys.items() if key != "file"}
    return keys


def _hash(file: Path) -> str:
    status = file.stat()
    return _hash_at(file.resolve(), status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=1024)
def _hash_at(file: Path, changed: int, size: int) -> str:
    """Hash of a file as last changed at `changed` (ns)."""
    return file_hash(file)[:16]
