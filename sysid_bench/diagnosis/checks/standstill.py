"""Samples at rest, at which static friction balances any torque."""

from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import NOTE, WARNING, Finding

SLOW: Final = 0.02
"""rad/s, m/s."""
SHARE: Final = 0.02
"""of the RMS rate."""
MANY: Final = 0.5
SOME: Final = 0.05


def standstill(evidence: DiagnoseInput) -> list[Finding]:
    """Return the share of the samples at which each joint stands still, where it is large."""
    v = evidence.motion.v
    limit = np.maximum(SLOW, SHARE * np.sqrt((v**2).mean(axis=0)))
    shares = (np.abs(v) < limit).mean(axis=0)
    many = np.flatnonzero(shares > SOME)
    if len(many) == 0:
        return []
    listed = ", ".join(f"{evidence.joints[j]} {100 * shares[j]:.0f} %" for j in many)
    return [
        Finding(
            name="standstill",
            severity=WARNING if float(np.median(shares)) > MANY else NOTE,
            message=f"joints at rest: {listed} of the samples",
            joints=tuple(evidence.joints[j] for j in many),
            edit="--pipeline parallel leaves these rows out; compare torque_error_moving",
        )
    ]
