"""Root mean square of errors."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike


def rms(values: ArrayLike) -> float:
    """Return the root mean square of an array of any shape; NaN if it is empty."""
    values = np.asarray(values)
    return float(np.sqrt((values**2).mean())) if values.size else float("nan")


def known_rms(values: Iterable[float | None]) -> float | None:
    """Return the root mean square of those values that are not None; None if there are none."""
    known = [value for value in values if value is not None]
    return rms(known) if known else None
