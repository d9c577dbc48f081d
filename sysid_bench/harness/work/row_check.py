"""Check of what stands in a folder of rows: damaged rows are skipped and counted, never used in
part."""

from pathlib import Path
from typing import Any, Final

from sysid_bench.vocabulary import STATUSES

_TABLES: Final = ("joints", "parameters_table")


def is_row(value: Any) -> bool:
    """Test for an object with an id, a known status, and tables that are lists of objects."""
    if not isinstance(value, dict) or not isinstance(value.get("id"), str):
        return False
    return value.get("status") in STATUSES and all(_is_table(value.get(key)) for key in _TABLES)


def _is_table(value: Any) -> bool:
    if isinstance(value, dict):
        return "columns" in value  # written by column, and checked where it is read so
    entries = [] if value is None else value
    return isinstance(entries, list) and all(isinstance(entry, dict) for entry in entries)


def not_files(folder: Path, pattern: str) -> list[str]:
    """Return the names of folders, devices, pipes and dangling links: they are not read."""
    return sorted(path.name for path in folder.glob(pattern) if not path.is_file())
