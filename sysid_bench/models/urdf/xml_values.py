"""Numbers in the attributes of a URDF, checked: finite, and three in a vector."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence

from sysid_bench.errors import ModelError


def finite_value(element: ET.Element, key: str, label: str, default: float | None = None) -> float:
    """The number of an attribute, `default` where it is absent; raises ModelError, with `label`,
    for anything that is not a finite number."""
    text = element.get(key)
    if text is None and default is not None:
        return default
    (value,) = _parsed([text or ""])
    if not math.isfinite(value):
        raise ModelError(f"{label}: {key} is {text!r}; it must be a finite number.")
    return value


def check_origin(origin: ET.Element | None, label: str) -> None:
    """Raise ModelError, with `label`, for an <origin> whose xyz or rpy is not three numbers."""
    if origin is None:
        return
    for key in ("xyz", "rpy"):
        check_numbers(origin, key, label)


def check_numbers(element: ET.Element, key: str, label: str, default: str = "0 0 0") -> None:
    """Raise ModelError, with `label`, for an attribute that is not three finite numbers."""
    text = element.get(key, default)
    numbers = _parsed(text.split())
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise ModelError(
            f"{label}: the {key} of an <{element.tag}> is {text!r}; write three finite numbers."
        )


def _parsed(words: Sequence[str]) -> list[float]:
    """The numbers of words; NaN alone where one of them is not a number."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return [math.nan]
