"""Files of a run for machines that lack them: an archive named by its content."""

import hashlib
import io
import os
import re
import shutil
import tarfile
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import filterfalse
from pathlib import Path
from typing import Any, Final

from sysid_bench.errors import UsageError

MOST_BYTES: Final = 1e9
_PLAN: Final = "plan.jsonl"
"""A folder with this file is a run; runs are not needed elsewhere."""


@dataclass(frozen=True)
class RunFiles:
    """Archive of folders, and their paths on the machine that made it."""

    data: bytes
    folders: tuple[str, ...]

    @property
    def name(self) -> str:
        """Name of the unpacked archive, from its content."""
        return hashlib.sha256(self.data).hexdigest()[:24]

    def open_folder(self) -> Path:
        """Return the folder of the files on this machine, where they are unpacked once."""
        place = _private_folder() / self.name
        if not place.is_dir():
            beside = Path(tempfile.mkdtemp(prefix=".", dir=place.parent))
            try:
                with tarfile.open(fileobj=io.BytesIO(self.data)) as archive:
                    archive.extractall(beside, filter="data")
                beside.rename(place)
            except OSError:
                shutil.rmtree(beside, ignore_errors=True)
                if not place.is_dir():  # another thread was not first: it is a fault of the disk
                    raise
        return place

    def folder_map(self, unpacked: Path) -> Mapping[str, str]:
        """Return {folder on the machine that made the bundle: folder here}."""
        return {folder: str(unpacked / str(i)) for i, folder in enumerate(self.folders)}


def run_files(folders: Sequence[Path]) -> RunFiles:
    """Return the bundle of all files below these folders, hidden ones and runs left out.

    Raises UsageError where they are more than 1 GB.
    """
    roots = tuple(dict.fromkeys(str(folder.resolve()) for folder in folders))
    written = io.BytesIO()
    with tarfile.open(fileobj=written, mode="w", dereference=True) as archive:
        for i, root in enumerate(roots):
            _add(archive, Path(root), str(i))
            if archive.offset > MOST_BYTES:
                raise UsageError(
                    f"The folder {root!r} holds more than {MOST_BYTES / 1e9:g} GB, which are not "
                    "sent to workers. Move the suite into a folder of its own with its files, or "
                    "add '?shared' to the address where workers see the same file system."
                )
    return RunFiles(written.getvalue(), roots)


def _add(archive: tarfile.TarFile, root: Path, name: str) -> None:
    folder = tarfile.TarInfo(name)
    folder.type, folder.mode = tarfile.DIRTYPE, 0o755
    archive.addfile(folder)
    for file in _files(root):
        entry = archive.gettarinfo(file, arcname=f"{name}/{file.relative_to(root)}")
        entry.mtime, entry.uid, entry.gid, entry.uname, entry.gname = 0, 0, 0, "", ""
        with file.open("rb") as data:
            archive.addfile(entry, data)
        if archive.offset > MOST_BYTES:
            return


def _files(root: Path) -> Iterator[Path]:
    for folder, names, files in os.walk(root):
        if _PLAN in files:
            names.clear()
            continue
        names[:] = sorted(filterfalse(_is_hidden, names))
        paths = (Path(folder, name) for name in sorted(filterfalse(_is_hidden, files)))
        yield from filter(Path.is_file, paths)


def _is_hidden(name: str) -> bool:
    return name.startswith(".") or name == "__pycache__"


def _private_folder() -> Path:
    """Return a folder of this user alone: what lies in it is executed."""
    if not hasattr(os, "getuid"):
        return Path(tempfile.gettempdir())
    folder = Path(tempfile.gettempdir()) / f"sysid_bench-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if found.st_uid != os.getuid() or found.st_mode & 0o077 or folder.is_symlink():
        raise UsageError(f"{str(folder)!r} is open to other users; remove it, or set TMPDIR.")
    return folder


def with_folders(value: Any, places: Mapping[str, str]) -> Any:
    """Return a JSON value with paths of one machine as those of another, wherever they occur.

    Each is replaced once, the longest first, and where it is a whole path or the beginning of one.
    """
    if not places:
        return value
    old = "|".join(re.escape(path) for path in sorted(places, key=len, reverse=True))
    return _replaced(value, re.compile(rf"(?<![\w./-])(?:{old})(?![\w.-])"), places)


def _replaced(value: Any, pattern: re.Pattern[str], places: Mapping[str, str]) -> Any:
    if isinstance(value, str):
        return pattern.sub(lambda found: places[found[0]], value)
    if isinstance(value, Mapping):
        return dict(_replaced(item, pattern, places) for item in value.items())
    if isinstance(value, list | tuple):
        return [_replaced(item, pattern, places) for item in value]
    return value
