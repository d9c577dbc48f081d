"""First files of a user: existing files are replaced only with `force`."""

import os
from pathlib import Path

from sysid_bench.errors import UsageError


def relative_to(path: Path, folder: Path) -> str:
    """Return a path as a file in `folder` names it: relative where it lies below or beside it."""
    relative = os.path.relpath(path.resolve(), folder.resolve())
    return str(path.resolve()) if relative.startswith(f"..{os.sep}..") else relative


def write_new(path: Path, text: str, force: bool) -> None:
    """Write a text file, and its folder; raise UsageError for an existing one without `force`, or
    for one that cannot be written."""
    if not force and (path.exists() or path.is_symlink()):
        raise UsageError(
            f"{str(path)!r} exists; name another file with -o, or write it again: --force."
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except (OSError, ValueError) as error:
        raise UsageError(f"{str(path)!r} cannot be written: {error}.") from error
