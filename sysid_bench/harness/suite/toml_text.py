"""Plain data as TOML text: tables of the file as sections, everything inside them on one line."""

import json
import math
import re
from collections.abc import Mapping
from typing import Any

from sysid_bench.errors import UsageError

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def toml_text(data: Mapping[str, Any]) -> str:
    """TOML of a mapping; keys whose value is None are left out, tuples become arrays."""
    data = _without_none(data)
    lines = [_pair(key, value) for key, value in data.items() if not _is_section(value)]
    for key, value in data.items():
        if isinstance(value, Mapping):
            lines += ["", f"[{_key(key)}]", *(_pair(*item) for item in value.items())]
        elif _is_section(value):
            for element in value:
                lines += ["", f"[[{_key(key)}]]", *(_pair(*item) for item in element.items())]
    return "\n".join(lines) + "\n"


def _without_none(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_none(inner) for key, inner in value.items() if not _absent(inner)}
    if isinstance(value, (list, tuple)):
        return [_without_none(inner) for inner in value]
    return value


def _absent(value: Any) -> bool:
    """A sweep of nothing but None is a key that was not written."""
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
    # JSON's strings are TOML's, but for the one control character that JSON leaves as it is.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else str(value)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(_pair(*item) for item in value.items()) + " }" if value else "{}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    raise UsageError(f"{value!r} ({type(value).__name__}) has no place in a suite; write a text.")
