"""TOML text of plain data: top-level tables as sections, their values on one line each."""

import json
import re
from collections.abc import Mapping
from itertools import chain, starmap
from typing import Any

from sysid_bench.errors import UsageError

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def toml_text(data: Mapping[str, Any]) -> str:
    """Return TOML of a mapping; keys with the value None are left out, tuples become arrays."""
    data = _without_none(data)
    lines = [_pair(key, value) for key, value in data.items() if not _is_section(value)]
    for key, value in data.items():
        if _is_section(value):
            lines += _section(_key(key), value)
    return "\n".join(lines) + "\n"


def _section(key: str, value: Any) -> list[str]:
    """Return the lines of a table, or of each table of a list."""
    if isinstance(value, Mapping):
        return ["", f"[{key}]", *starmap(_pair, value.items())]
    tables = (["", f"[[{key}]]", *starmap(_pair, table.items())] for table in value)
    return list(chain.from_iterable(tables))


def _without_none(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_none(inner) for key, inner in value.items() if not _absent(inner)}
    if isinstance(value, (list, tuple)):
        return [_without_none(inner) for inner in value]
    return value


def _absent(value: Any) -> bool:
    """Return whether a key was not written: None, or a sweep of None alone."""
    return value is None or (isinstance(value, (list, tuple)) and [*value] == [None])


def _is_section(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and all(isinstance(element, Mapping) for element in value)
    return isinstance(value, Mapping)


def _pair(key: str, value: Any) -> str:
    return f"{_key(key)} = {_value(value)}"


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else _text(key)


def _text(text: str) -> str:
    # JSON strings are TOML strings, but for DEL, which JSON does not escape.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return json.dumps(value)
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(starmap(_pair, value.items())) + " }" if value else "{}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    raise UsageError(
        f"{value!r} ({type(value).__name__}) cannot be written in a suite; use a string."
    )
