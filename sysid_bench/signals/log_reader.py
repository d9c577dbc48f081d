"""Choice of a log reader, by suffix, by what a folder holds or by name; reading one recording."""

import json
from collections.abc import Mapping
from functools import lru_cache
from itertools import chain, islice
from pathlib import Path
from typing import Any, ClassVar, Final, Protocol

from sysid_bench import plugin_names
from sysid_bench.errors import UsageError, reason_of
from sysid_bench.input_files import is_file, is_folder
from sysid_bench.signals.log_table import LogTable

KIND: Final = "log_reader"
"""Kind of plug-in; entry points join in the group `sysid_bench.log_readers`."""

_MOST_FILES: Final = 10_000
"""Files of a folder that are looked at."""

_NOT_A_FILE: Final = (
    "{!r} is not a file; name the recorded file itself, or the folder of a ROS 2 bag (with "
    "metadata.yaml) or of a LeRobot data set (with meta/info.json)."
)

ReaderSpec = str | Mapping[str, Any]
"""Name of a reader ("parquet", "module:object", "file:mine.py:Reader"), or {use = name, ...} with
its settings."""


class LogReader(Protocol):
    """Reader of one file format; a frozen dataclass whose fields are its settings.

    One of folders also has `folder_files`: the path of the file that marks its folders, then
    patterns of the others that it reads.
    """

    suffixes: ClassVar[tuple[str, ...]]
    """Suffixes of the files it reads, in lower case with their dot; () where it is only named."""

    def read(self, path: Path) -> LogTable:
        """Return the numbers of an existing file; raises UsageError where it cannot."""


def read_table(path: Path, reader: ReaderSpec | None = None) -> LogTable:
    """Return the numbers of a file, by its suffix where no reader is named.

    Raises UsageError with what is wrong in the file, or with the suffixes that can be read.
    """
    _state(path)
    if not is_file(path) and not is_folder(path):
        raise UsageError(f"{str(path)!r} is a device or a pipe; name the recorded file itself.")
    spec = _reader_spec(path, reader)
    make = plugin_names.resolve(KIND, spec["use"])
    settings = json.dumps(spec, sort_keys=True, default=str)
    state = tuple(_state(file) for file in recorded_files(path, spec))
    return _table(path, state, make, settings)


def recorded_files(path: Path, reader: ReaderSpec | None = None) -> tuple[Path, ...]:
    """Return the files of a recording: itself, or what the reader of a folder reads in it.

    Raises UsageError for one that does not exist, or that is not a recording.
    """
    _state(path)
    if is_file(path):
        return (path,)
    use = _reader_spec(path, reader)["use"]
    # What a plug-in reads in a folder is not asked: that would run its code.
    of_package = plugin_names.is_of_package(KIND, use)
    patterns = _declared(use, "folder_files") if of_package else ("**/*",)
    if not patterns:
        raise UsageError(_NOT_A_FILE.format(str(path)))
    found = chain.from_iterable(islice(path.glob(one), _MOST_FILES) for one in patterns)
    return tuple(sorted(filter(is_file, found)))


def _state(path: Path) -> tuple[int, int]:
    """Return time of the last change (ns) and size of a file; raises UsageError for none."""
    try:
        state = path.stat()
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = error.strerror if isinstance(error, OSError) else error
        raise UsageError(f"The recorded file {str(path)!r} cannot be read ({reason}).") from error
    return state.st_mtime_ns, state.st_size


def _declared(name: str, attribute: str) -> tuple[str, ...]:
    """Return the suffixes of a reader, or the patterns of the files of a folder that it reads, of
    which the first marks the folder."""
    found: tuple[str, ...] = getattr(plugin_names.resolve(KIND, name), attribute, ())
    return found


@lru_cache(maxsize=4)
def _table(path: Path, state: tuple[tuple[int, int], ...], make: Any, settings: str) -> LogTable:
    # q, v, tau and time often share one file. A file or a plug-in written again is read again.
    del state, make
    spec = json.loads(settings)
    try:
        table = plugin_names.build(KIND, spec).read(path)
    except UsageError:
        raise
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
    except Exception as error:  # a plug-in's own
        raise UsageError(
            f"{path}: the log reader {spec['use']!r} failed with {reason_of(error)}."
        ) from error
    if not isinstance(table, LogTable) or table.values.ndim != 2:
        raise UsageError(
            f"{path}: the log reader {spec['use']!r} must return a LogTable with values (N, c)."
        )
    return table


def _reader_spec(path: Path, reader: ReaderSpec | None = None) -> Mapping[str, Any]:
    """Return {use = name, settings} of the reader named, or of the one for the suffix of a file.

    Raises UsageError with the suffixes that can be read.
    """
    if isinstance(reader, str):
        return {"use": reader}
    if reader is not None:
        if not isinstance(reader.get("use"), str):
            raise UsageError(f"A log reader needs a name: {{ use = ... }}; got {dict(reader)}.")
        return reader
    if (found := package_reader(path)) is not None:
        return {"use": found}
    if is_folder(path):
        raise UsageError(_NOT_A_FILE.format(str(path)))
    known = {name: _declared(name, "suffixes") for name in plugin_names.known(KIND)}
    for name, suffixes in known.items():
        if path.suffix.lower() in suffixes:
            return {"use": name}
    every = dict.fromkeys(chain.from_iterable(known.values()))
    raise UsageError(
        f"{path}: no log reader for files that end in {path.suffix.lower()!r}. Readers exist for "
        f"{', '.join(every)}. Name one with reader = 'delimited-text', or one of your own with "
        f"reader = 'file:mine.py:Reader' (entry-point group 'sysid_bench.{KIND}s')."
    )


def package_reader(path: Path) -> str | None:
    """Return the reader of this package for the suffix of a file, or for the files in a folder;
    None without one."""
    is_one = is_folder(path)
    for name in plugin_names.BUILTIN[KIND]:
        marks = _declared(name, "folder_files")[:1] if is_one else _declared(name, "suffixes")
        if any(is_file(path / mark) if is_one else path.suffix.lower() == mark for mark in marks):
            return name
    return None


def reader_files(path: Path, reader: ReaderSpec | None = None) -> list[Path]:
    """Return the Python files of third-party readers that may read a file; none is imported.

    What is read depends on their code, so rows made with it are stale when that changes. A suffix
    that is not ours may belong to any of the installed ones.
    """
    names = [*plugin_names.known(KIND)] if package_reader(path) is None else []
    if reader is not None:
        names = [_reader_spec(path, reader)["use"]]
    foreign = [name for name in names if not plugin_names.is_of_package(KIND, name)]
    files = [plugin_names.source_file(KIND, name) for name in foreign]
    return [file for file in files if file is not None]
