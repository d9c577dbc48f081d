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
    patterns = _folder_files(use) if plugin_names.is_of_package(KIND, use) else ("**/*",)
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
        raise UsageError(f"There is no recorded file {str(path)!r} ({reason}).") from error
    return state.st_mtime_ns, state.st_size


def _folder_files(name: str) -> tuple[str, ...]:
    """Return the patterns of the files of a folder that a reader reads, the first marks it."""
    found: tuple[str, ...] = getattr(plugin_names.resolve(KIND, name), "folder_files", ())
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
    return _valid_table(table, path, spec["use"])


def _valid_table(table: Any, path: Path, use: str) -> LogTable:
    """Return what a reader returned; raises UsageError unless it is a table."""
    if not isinstance(table, LogTable) or table.values.ndim != 2:
        raise UsageError(
            f"{path}: the log reader {use!r} must return a LogTable with values (N, c)."
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
    return {"use": _reader_by_suffix(path)}


def package_reader(path: Path) -> str | None:
    """Return the reader of this package for the suffix of a file, or for the files in a folder;
    None without one."""
    names = plugin_names.BUILTIN[KIND]
    if is_folder(path):
        return next((name for name in names if _marks(name, path)), None)
    return next((name for name in names if path.suffix.lower() in _suffixes(name)), None)


def _marks(name: str, folder: Path) -> bool:
    """Test whether a folder holds the file that marks those of a reader."""
    patterns = _folder_files(name)
    return bool(patterns) and is_file(folder / patterns[0])


def _suffixes(name: str) -> tuple[str, ...]:
    suffixes: tuple[str, ...] = getattr(plugin_names.resolve(KIND, name), "suffixes", ())
    return suffixes


def _reader_by_suffix(path: Path) -> str:
    if (found := package_reader(path)) is not None:
        return found
    if is_folder(path):
        raise UsageError(_NOT_A_FILE.format(str(path)))
    known = {name: _suffixes(name) for name in plugin_names.known(KIND)}
    for name, suffixes in known.items():
        if path.suffix.lower() in suffixes:
            return name
    every = dict.fromkeys(chain.from_iterable(known.values()))
    raise UsageError(
        f"{path}: no log reader for files that end in {path.suffix.lower()!r}. Readers exist for "
        f"{', '.join(every)}. Name one with reader = 'delimited-text', or one of your own with "
        f"reader = 'file:mine.py:Reader' (entry-point group 'sysid_bench.{KIND}s')."
    )


def reader_files(path: Path, reader: ReaderSpec | None = None) -> list[Path]:
    """Return the Python files of third-party readers that may read a file; none is imported.

    What is read depends on their code, so rows made with it are stale when that changes. A suffix
    that is not ours may belong to any of the installed ones.
    """
    foreign = [
        name for name in _candidates(path, reader) if not plugin_names.is_of_package(KIND, name)
    ]
    files = [plugin_names.source_file(KIND, name) for name in foreign]
    return [file for file in files if file is not None]


def _candidates(path: Path, reader: ReaderSpec | None) -> list[str]:
    """Return the names of readers that may read a file: the one given, else all that exist, unless
    a reader of ours is known for it."""
    if reader is not None:
        return [_reader_spec(path, reader)["use"]]
    return [*plugin_names.known(KIND)] if package_reader(path) is None else []
