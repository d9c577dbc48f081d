"""Canonical JSON, equal for equal values, of which ids, seeds and rows are made."""

import hashlib
import json
import math
from collections.abc import Mapping
from types import NoneType
from typing import Any, Final


def plain(value: Any) -> Any:
    """Convert numpy numbers and arrays, tuples and mappings to values of JSON.

    NaN and infinities become None, so that no reader takes them for a measurement. Raises TypeError
    for other types.
    """
    # Rows hold thousands of numbers and texts: the common types first, abstract ones last.
    if isinstance(value, float):  # of a subclass such as numpy.float64, too
        # JSON has no NaN, and other readers than Python's refuse the word.
        return float(value) if math.isfinite(value) else None
    if isinstance(value, (int, NoneType)):
        return value
    if isinstance(value, str):
        # Undecodable file names hold halves of surrogate pairs, which are not UTF-8.
        return value if value.isascii() else value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    if isinstance(value, (dict, Mapping)):
        return {key if type(key) is str else str(key): plain(x) for key, x in value.items()}
    if hasattr(value, "tolist"):  # arrays and scalars of numpy
        return plain(value.tolist())
    raise TypeError(
        f"{value!r} ({type(value).__name__}) cannot be stored as JSON; use numbers and strings."
    )


# One encoder: json.dumps with settings makes a new one for each call.
_CANONICAL: Final = json.JSONEncoder(sort_keys=True, separators=(",", ":"))


def canonical(value: Any) -> str:
    """Return one text per value: sorted keys, no blanks."""
    return _CANONICAL.encode(plain(value))


def canonical_hash(value: Any) -> str:
    """Return the sha256 of the canonical text, 64 hex digits."""
    return hashlib.sha256(canonical(value).encode()).hexdigest()
