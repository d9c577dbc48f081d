"""Directions of joints: positions and velocities of the opposite sign to the axis of the model."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from sysid_bench.diagnosis.edit import factor_edit
from sysid_bench.diagnosis.hypothesis import Candidate, Hypothesis

BLIND: Final = "balanced joints with little friction"
AXIS: Final = "the axis of {} points the other way in the model: positions and torques are negated"


def joint_direction(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates that turn all joints or one, without the torque or with it."""
    n = before.evidence.count
    yield _turned(before, tuple(range(n)))
    for j in range(n):
        turned = _turned(before, (j,))
        yield turned
        yield _with_torque(before, turned)


def _turned(before: Hypothesis, joints: tuple[int, ...]) -> Candidate:
    e = before.evidence
    signs = _signs(e.count, joints)
    names = "all joints" if len(joints) == e.count else e.joints[joints[0]]
    edits = [
        factor_edit(e, s, "ratio", signs) for s in ("q", "v") if s in e.log.description.signals
    ]
    return Candidate(
        name="direction",
        joints=joints,
        hypothesis=before.with_motion(before.motion.scaled(signs)),
        message=f"{names}: positions and velocities have the opposite direction",
        edit="; ".join(edits),
        blind=BLIND,
    )


def _with_torque(before: Hypothesis, turned: Candidate) -> Candidate:
    e = before.evidence
    signs = _signs(e.count, turned.joints)
    return Candidate(
        name="direction",
        joints=turned.joints,
        hypothesis=turned.hypothesis.with_torque(np.diag(signs)),
        message=AXIS.format(e.joints[turned.joints[0]]),
        edit=f"{turned.edit}; {factor_edit(e, 'tau', 'gain', signs)}",
        blind=BLIND,
    )


def _signs(n: int, joints: tuple[int, ...]) -> np.ndarray:
    signs = np.ones(n)
    signs[list(joints)] = -1.0
    return signs
