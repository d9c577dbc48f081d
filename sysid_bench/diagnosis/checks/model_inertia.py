"""Inertias of the model file that are placeholders, and torque limits that are absent."""

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import NOTE, WARNING, Finding


def model_inertia(evidence: DiagnoseInput) -> list[Finding]:
    """Return a finding where the file's inertias are placeholders."""
    if not evidence.placeholder:
        return []
    return [
        Finding(
            name="inertias",
            severity=WARNING,
            message=(
                f"the inertias of the model are placeholders ({evidence.placeholder}): gains, "
                "gravity and offsets are judged by friction and by the fit alone"
            ),
            edit="give the model its masses, or use no prior from it",
            blind="",
        )
    ]


def model_limits(evidence: DiagnoseInput) -> list[Finding]:
    """Return joints whose torque limit is zero in the file, which means that none is stated."""
    effort = evidence.robot.limits.tau[evidence.dofs]
    zero = [evidence.joints[j] for j in np.flatnonzero(effort == 0)]
    if not zero:
        return []
    return [
        Finding(
            name="limits",
            severity=NOTE,
            message=f'effort="0" of {", ".join(zero)} is read as no limit',
            joints=tuple(zero),
            edit='write the torque limits into the model (effort="...")',
        )
    ]
