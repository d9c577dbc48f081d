"""Single channels that are updated more slowly than the recording."""

from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import WARNING, Finding
from sysid_bench.types import Array

SLOW: Final = 3.0
"""Median run of equal values above which a channel is held: drives update every cycle, and
quantised ones repeat a value now and then."""
LEVELS: Final = 40
"""Distinct values below which a channel is coarse rather than held."""


def held_channels(evidence: DiagnoseInput) -> list[Finding]:
    """Return torques that repeat their values in long runs while others do not."""
    raw = evidence.raw.tau[:, evidence.columns]
    runs = np.array([_typical_run(raw[:, j]) for j in range(evidence.count)])
    held = np.flatnonzero(runs >= SLOW)
    if len(held) == 0:
        return []
    names = tuple(evidence.joints[j] for j in held)
    rate = evidence.rate / runs[held].max()
    return [
        Finding(
            name="held",
            severity=WARNING,
            message=(
                f"the torque of {', '.join(names)} changes every {runs[held].max():.0f} samples "
                f"only: its true rate is about {rate:.4g} Hz, and it lags by half of that"
            ),
            joints=names,
            edit="record the torque at its own rate, or filter well below that",
            blind="quantised torques, and joints at rest",
        )
    ]


def _typical_run(x: Array) -> float:
    """Median length of the runs of equal values; 1 for coarse values."""
    if len(np.unique(x)) < LEVELS:
        return 1.0
    edges = np.flatnonzero(np.diff(x) != 0)
    return float(np.median(np.diff(np.concatenate([[-1], edges, [len(x) - 1]]))))
