"""Conditioning of the motion: what it does not excite, and which methods then help."""

from typing import Final

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import NOTE, Finding
from sysid_bench.diagnosis.near_model import PENALTY

FAIR: Final = 0.25
"""Share of the directions of the links that the motion excites less than the model file knows
them: least squares is then worse than a feasible fit or one with a prior."""


def excitation(evidence: DiagnoseInput) -> list[Finding]:
    """Return the number of directions of the links that the motion hardly excites."""
    information = evidence.near_model.information
    weak = int((information < PENALTY**2).sum())
    share = weak / max(len(information), 1)
    if evidence.placeholder or share < FAIR:
        return []
    return [
        Finding(
            name="condition",
            severity=NOTE,
            message=(
                f"{weak} of {len(information)} combinations of the links' parameters are better "
                "known from the model file than from this motion"
            ),
            edit="--estimator lmi (feasible), or a method with a prior; design a motion: excite",
            blind="good conditioning does not mean a small error",
        )
    ]
