"""Sign of the torques: of all, or of one joint; friction then feeds power into the joint."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from sysid_bench.diagnosis.edit import factor_edit
from sysid_bench.diagnosis.hypothesis import Candidate, Hypothesis

BLIND: Final = "a joint with almost no friction, load and inertia"


def torque_direction(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates that negate all torques, or one."""
    e = before.evidence
    n = e.count
    yield _cure(before, tuple(range(n)), "the torques of all joints have the opposite sign")
    for j in range(n):
        yield _cure(before, (j,), f"the torque of {e.joints[j]} has the opposite sign")


def _cure(before: Hypothesis, joints: tuple[int, ...], message: str) -> Candidate:
    signs = np.ones(before.evidence.count)
    signs[list(joints)] = -1.0
    return Candidate(
        name="sign",
        joints=joints,
        hypothesis=before.with_torque(np.diag(signs)),
        message=message,
        edit=factor_edit(before.evidence, "tau", "gain", signs),
        blind=BLIND,
    )
