"""Check of what stands in a folder of rows: damaged rows are skipped and counted, never used in
part."""

from pathlib import Path
from typing import Any, Final

from sysid_bench.words import STATUSES

TABLES: Final = ("joints", "parameters_table")
"""Fields of a row that are tables."""


def is_row(value: Any) -> bool:
    """Test for an object with an id, a known status, and tables by entry or by column."""
    if not isinstance(value, dict) or not isinstance(value.get("id"), str):
        return False
    return value.get("status") in STATUSES and all(_is_table(value.get(key)) for key in TABLES)


def _is_table(value: Any) -> bool:
    """Test for nothing, a list of objects, or {"columns": {key: values}} of one length."""
    if isinstance(value, dict):
        return len(value) == 1 and _are_columns(value.get("columns"))
    entries = [] if value is None else value
    return isinstance(entries, list) and all(isinstance(entry, dict) for entry in entries)


def _are_columns(columns: Any) -> bool:
    if not isinstance(columns, dict) or not columns:
        return False
    values = columns.values()
    return all(isinstance(v, list) for v in values) and len(set(map(len, values))) == 1


def other_files(folder: Path, pattern: str) -> list[str]:
    """Return the names of folders, devices, pipes and dangling links: they are not read."""
    return sorted(path.name for path in folder.glob(pattern) if not path.is_file())
