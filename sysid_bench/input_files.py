"""Input files: regular files of a bounded size, and TOML and JSON of bounded depth.

A device, a pipe or a folder in place of a file would be read without end, or not at all.
"""

import errno
import hashlib
import json
import stat
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from sysid_bench.errors import UsageError

LARGEST: Final = 64 * 2**20
"""Bytes of a text that people write; a larger one is a mistake."""

LARGEST_HASHED: Final = 2**33
"""Bytes of a file of which only the hash is taken, in parts."""

_PART: Final = 2**20

_DEEPEST: Final = 100
"""Levels of nested tables and lists; Python's recursion ends at a few hundred."""


def is_file(path: Path) -> bool:
    """Test for a file; False also for a text that no file can have as its name."""
    return _is(path, Path.is_file)


def is_folder(path: Path) -> bool:
    """Test for a folder; False also for a text that no folder can have as its name."""
    return _is(path, Path.is_dir)


def _is(path: Path, test: Callable[[Path], bool]) -> bool:
    try:
        return test(path)
    except (OSError, ValueError):  # too long, with a NUL
        return False


def check_file(path: Path, largest: int = LARGEST) -> None:
    """Raise OSError unless the file exists, is a regular one, and has `largest` bytes at most."""
    try:
        status = path.stat()
    except ValueError as error:
        raise OSError(f"{str(path)!r} is not the name of a file: {error}") from error
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder", str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(f"{str(path)!r} is a device or a pipe, not a file")
    if status.st_size > largest:
        raise OSError(_size_text(path, status.st_size, largest))


def read_data(path: Path, largest: int = LARGEST) -> bytes:
    """Return the content of a file; raises OSError as `check_file` does."""
    check_file(path, largest)
    with path.open("rb") as file:
        # One byte more than stated: a file that grows is noticed.
        content = file.read(path.stat().st_size + 1)
        while 0 < len(content) <= largest and (more := file.read(_PART)):
            content += more  # files of the system state no size
    if len(content) > largest:
        raise OSError(_size_text(path, len(content), largest))
    return content


def check_replaceable(file: Path, starts: tuple[str, ...], what: str) -> None:
    """Raise UsageError for a file that an output would replace and that is none of its kind, which
    begins with one of `starts`; `what`: that kind in words."""
    if not is_file(file):
        return
    with file.open("rb") as opened:
        start = opened.read(max(map(len, starts)))
    if start and not start.startswith(tuple(text.encode() for text in starts)):
        raise UsageError(
            f"{str(file)!r} exists and is not {what}: it would be lost. Name another file, or "
            "remove it."
        )


def file_hash(path: Path) -> str:
    """Return the sha256 of a file; raises OSError as `check_file` does."""
    check_file(path, LARGEST_HASHED)
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class TextError(UnicodeDecodeError):
    """Content of a file that is not text in its encoding."""

    def __str__(self) -> str:
        return f"it is not a text file (byte {self.start + 1} is not {self.encoding.upper()})"


def read_text(path: Path, encoding: str = "utf-8", largest: int = LARGEST) -> str:
    """Return the text of a file; raises OSError as `check_file` does, TextError for another
    encoding."""
    try:
        text = read_data(path, largest).decode(encoding)
    except UnicodeDecodeError as error:
        raise TextError(*error.args) from error
    # As text mode reads it; the lines of a mistake count alike on all systems.
    return text.replace("\r\n", "\n").replace("\r", "\n")


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text; raises ValueError for another text, also one with numbers
    or nesting beyond Python's limits."""
    try:
        tables = tomllib.loads(text)
    except RecursionError as error:
        raise ValueError(_DEPTH_TEXT) from error
    _check_depth(tables)
    return tables


def read_toml(file: Path, refusal: type[Exception]) -> dict[str, Any]:
    """Return the tables of a TOML file; raises `refusal`, with the file and the reason, for one
    that cannot be read."""
    try:
        return parse_toml(read_text(file))
    except OSError as error:
        raise refusal(f"{file} cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        raise refusal(f"{file} is not valid TOML: {error}.") from error


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON text; raises ValueError for another text, also one with numbers or
    nesting beyond Python's limits."""
    try:
        value = json.loads(text)
    except RecursionError as error:
        raise ValueError(_DEPTH_TEXT) from error
    _check_depth(value)
    return value


_DEPTH_TEXT: Final = f"tables or lists are nested more than {_DEEPEST} levels deep"


def _check_depth(value: Any) -> None:
    """Raise ValueError for a value that is nested too deeply."""
    # Level by level: recursion would overflow on the values that this is to refuse.
    level: list[Any] = [value]
    for _ in range(_DEEPEST):
        level = [inner for outer in level for inner in _inner(outer)]
    if level:
        raise ValueError(_DEPTH_TEXT)


def _inner(value: Any) -> list[Any]:
    if isinstance(value, Mapping):
        return list(value.values())
    return value if isinstance(value, list) else []


def _size_text(path: Path, size: int, largest: int) -> str:
    return f"{str(path)!r} has {size} bytes or more; {largest} are allowed at most"
