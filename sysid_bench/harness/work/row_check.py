"""Check of a row that was read: a damaged one is skipped and counted, never used in part."""

from typing import Any, Final

from sysid_bench.vocabulary import STATUSES

_TABLES: Final = ("joints", "parameters_table")


def is_row(value: Any) -> bool:
    """Test for an object with an id, a known status, and tables that are lists of objects."""
    if not isinstance(value, dict) or not isinstance(value.get("id"), str):
        return False
    return value.get("status") in STATUSES and all(_is_table(value.get(key)) for key in _TABLES)


def _is_table(value: Any) -> bool:
    entries = [] if value is None else value
    return isinstance(entries, list) and all(isinstance(entry, dict) for entry in entries)
