"""Numbers in the attributes of a URDF, checked: finite, and three in a vector."""

import math
import xml.etree.ElementTree as ET

from sysid_bench.errors import ModelError


def finite_number(
    element: ET.Element | None, key: str, label: str, default: float | None = None
) -> float:
    """The number of an attribute, `default` where it is absent; raises ModelError, with `label`,
    for anything that is not a finite number."""
    text = None if element is None else element.get(key)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ModelError(f"{label}: {key} is {text!r}; it must be a finite number.")
    return value


def check_origin(origin: ET.Element | None, label: str) -> None:
    """Raise ModelError, with `label`, for an <origin> whose xyz or rpy is not three numbers."""
    for key in ("xyz", "rpy"):
        text = "0 0 0" if origin is None else origin.get(key, "0 0 0")
        try:
            numbers = [float(word) for word in text.split()]
        except ValueError:
            numbers = []
        if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
            raise ModelError(
                f"{label}: the inertial origin's {key} is {text!r}; write three finite numbers."
            )
