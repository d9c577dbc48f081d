"""Torque or position channels that never change."""

from collections.abc import Iterator

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import ERROR, WARNING, Finding


def static_channels(evidence: DiagnoseInput) -> list[Finding]:
    """Return joints whose torque is zero or constant, and those that never move."""
    return list(_findings(evidence))


def _findings(evidence: DiagnoseInput) -> Iterator[Finding]:
    q = evidence.log.recording.q[:, evidence.position_columns]
    still = np.ptp(q, axis=0) == 0
    dead = (np.ptp(evidence.torque_samples, axis=0) == 0) & ~still
    if dead.any():
        names = _names(evidence, dead)
        yield Finding(
            name="zero",
            severity=ERROR,
            message=f"the torque of {', '.join(names)} never changes: another column?",
            joints=names,
            edit="tau = { columns = [...] }: the columns of measured torques",
        )
    if still.any():
        names = _names(evidence, still)
        yield Finding(
            name="standstill",
            severity=WARNING,
            message=f"{', '.join(names)} never moves: its own parameters cannot be found",
            joints=names,
            edit="leave the joint out of joints and state it in locked",
        )


def _names(evidence: DiagnoseInput, mask: np.ndarray) -> tuple[str, ...]:
    """Joints of a mask (n,)."""
    return tuple(evidence.joints[j] for j in np.flatnonzero(mask))
