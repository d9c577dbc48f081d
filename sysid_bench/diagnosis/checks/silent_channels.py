"""Torque or position channels that never change."""

import numpy as np

from sysid_bench.diagnosis.evidence import Evidence
from sysid_bench.diagnosis.finding import ERROR, WARNING, Finding


def silent_channels(evidence: Evidence) -> list[Finding]:
    """Return joints whose torque is zero or constant, and those that never move."""
    q = evidence.log.recording.q[:, evidence.addresses]
    still = [j for j in range(evidence.count) if np.ptp(q[:, j]) == 0]
    dead = [
        j
        for j in range(evidence.count)
        if np.ptp(evidence.torque_samples[:, j]) == 0 and j not in still
    ]
    found = []
    if dead:
        names = tuple(evidence.joints[j] for j in dead)
        found.append(
            Finding(
                name="zero",
                severity=ERROR,
                message=f"the torque of {', '.join(names)} never changes: another column?",
                joints=names,
                edit="tau = { columns = [...] }: the columns of measured torques",
            )
        )
    if still:
        names = tuple(evidence.joints[j] for j in still)
        found.append(
            Finding(
                name="standstill",
                severity=WARNING,
                message=f"{', '.join(names)} never moves: its own parameters cannot be found",
                joints=names,
                edit="leave the joint out of joints and state it in locked",
            )
        )
    return found
