"""Parts of a motion for cross-validation: by its phase, so that no part repeats another one."""

from typing import Final

import numpy as np

from sysid_bench.types import Array

_ROUNDING: Final = 1e-9


def time_labels(samples: int, period: float, count: int) -> Array:
    """Return the part (N,), 0 to count - 1, of each of N `samples`: by its phase in the `period`
    (samples, may be a fraction), or in the whole motion where that is 0."""
    periods = np.arange(samples) / (period or max(samples, 1))
    # Samples at the edge of a part belong behind it, rounded or not.
    return np.asarray(np.floor(periods % 1.0 * count + _ROUNDING) % count, dtype=int)
