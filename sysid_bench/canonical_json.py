"""Canonical JSON, equal for equal values, of which ids, seeds and rows are made."""

import hashlib
import json
import math
from collections.abc import Mapping
from typing import Any


def plain(value: Any) -> Any:
    """Convert numpy numbers and arrays, tuples and mappings to values of JSON.

    NaN and infinities become None, so that no reader takes them for a measurement. Raises TypeError
    for other types.
    """
    kind = type(value)  # rows hold thousands of numbers: the common types come first
    if kind is float:
        return value if math.isfinite(value) else None
    if kind is dict:
        return {key if type(key) is str else str(key): plain(inner) for key, inner in value.items()}
    if value is None or isinstance(value, (bool, int)):
        return value
    if isinstance(value, str):
        if value.isascii():
            return value
        # Half of a surrogate pair, as in undecodable file names, is not valid UTF-8.
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    raise TypeError(
        f"{value!r} ({type(value).__name__}) cannot be stored as JSON; use numbers and strings."
    )


def canonical(value: Any) -> str:
    """Return one text per value: sorted keys, no blanks."""
    return json.dumps(plain(value), sort_keys=True, separators=(",", ":"))


def digest(value: Any) -> str:
    """Return the sha256 of the canonical text, 64 hex digits."""
    return hashlib.sha256(canonical(value).encode()).hexdigest()
