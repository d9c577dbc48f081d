"""Torques that stay at their extreme value: a saturated drive or converter."""

from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import WARNING, Finding
from sysid_bench.types import Array

SHARE: Final = 0.01
"""Share of the samples at one extreme from which a channel is clipped."""
COARSE: Final = 20
"""Values between the extremes below which a channel is coarse rather than clipped."""


def clipped_channels(evidence: DiagnoseInput) -> list[Finding]:
    """Return joints with many torques at the same extreme."""
    raw = evidence.raw.tau[:, evidence.columns]
    shares = np.array([_clipped_share(raw[:, j]) for j in range(evidence.count)])
    clipped = np.flatnonzero(shares > SHARE)
    if len(clipped) == 0:
        return []
    names = tuple(evidence.joints[j] for j in clipped)
    listed = ", ".join(f"{100 * shares[j]:.0f} % of {evidence.joints[j]}" for j in clipped)
    return [
        Finding(
            name="clipped",
            severity=WARNING,
            message=f"torques stay at their extreme value: {listed}",
            joints=names,
            edit="record with a wider range, or with a slower motion",
            blind="clipping of fewer than 1 % of the samples, or before a filter",
        )
    ]


def _clipped_share(x: Array) -> float:
    """Share of the samples at the extremes, where the values between are not coarse."""
    extremes = [(x == x.max()).mean(), (x == x.min()).mean()]
    # The typical share of any other value: for a coarse converter that of the extremes too.
    typical = 1.0 / max(len(np.unique(x)), 1)
    return float(sum(share for share in extremes if share > COARSE * typical))
