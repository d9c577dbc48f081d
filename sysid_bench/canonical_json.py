"""Canonical JSON, equal for equal values, of which ids, seeds and rows are made."""

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping
from types import NoneType
from typing import Any, Final


def plain(value: Any) -> Any:
    """Convert numpy numbers and arrays, tuples and mappings to values of JSON.

    NaN and infinities become None, so that no reader takes them for a measurement. Raises TypeError
    for other types.
    """
    convert = _OF_TYPE.get(type(value))
    if convert is not None:
        return convert(value)
    for kinds, convert_kind in _CONVERSIONS:
        if isinstance(value, kinds):
            return convert_kind(value)
    if hasattr(value, "tolist"):  # arrays and scalars of numpy
        return plain(value.tolist())
    raise TypeError(
        f"{value!r} ({type(value).__name__}) cannot be stored as JSON; use numbers and strings."
    )


def _same(value: Any) -> Any:
    return value


def _text(value: str) -> str:
    """Text in valid UTF-8: undecodable file names hold halves of surrogate pairs, which are not."""
    return value if value.isascii() else value.encode("utf-8", "backslashreplace").decode()


def _number(value: float) -> float | None:
    """A plain float, of a subclass such as numpy.float64 too."""
    return float(value) if math.isfinite(value) else None


def _items(values: Iterable[Any]) -> list[Any]:
    return [plain(inner) for inner in values]


def _mapping(value: Mapping[Any, Any]) -> dict[str, Any]:
    return {key if type(key) is str else str(key): plain(inner) for key, inner in value.items()}


# The first that fits applies, the common types first.
_CONVERSIONS: Final[tuple[tuple[tuple[type, ...], Callable[[Any], Any]], ...]] = (
    ((dict,), _mapping),
    ((bool, int, NoneType), _same),
    ((str,), _text),
    ((float,), _number),
    ((list, tuple), _items),
    ((Mapping,), _mapping),
)

_OF_TYPE: Final = {kind: convert for kinds, convert in _CONVERSIONS for kind in kinds}
"""Conversion of values that are exactly of a type: rows hold thousands of numbers and texts."""


_CANONICAL: Final = json.JSONEncoder(sort_keys=True, separators=(",", ":"))


def canonical(value: Any) -> str:
    """Return one text per value: sorted keys, no blanks."""
    return _CANONICAL.encode(plain(value))


def canonical_hash(value: Any) -> str:
    """Return the sha256 of the canonical text, 64 hex digits."""
    return hashlib.sha256(canonical(value).encode()).hexdigest()
