"""Zero of the encoders: positions off by a constant."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from sysid_bench.diagnosis.edit import offset_edit
from sysid_bench.diagnosis.hypothesis import Candidate, Hypothesis
from sysid_bench.types import Array

SMALLEST: Final = 0.05
"""rad, m; smaller offsets lie within the spread of centres of mass."""
QUARTERS: Final = (0.5 * np.pi, -0.5 * np.pi, np.pi)
"""rad; zeros of other conventions."""
STEP: Final = 1e-4
TRIED: Final = 0.3
BLIND: Final = "axes parallel to gravity; a payload or another centre of mass looks alike"


def encoder_offset(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates with each joint's positions moved by quarter turns, and by the best small
    offset."""
    e = before.evidence
    for j, small in enumerate(_small_offsets(before)):
        quarters = QUARTERS if e.kinds[j] == "hinge" else ()
        for offset in (*quarters, small):
            if abs(offset) >= SMALLEST:
                yield _cure(before, j, float(offset))


def _cure(before: Hypothesis, j: int, offset: float) -> Candidate:
    e = before.evidence
    offsets = np.zeros(e.count)
    offsets[j] = offset
    unit = "rad" if e.kinds[j] == "hinge" else "m"
    return Candidate(
        name="offset",
        joints=(j,),
        hypothesis=before.with_motion(before.motion.with_offset(offsets)),
        message=f"the zero of {e.joints[j]} is off by {-offset:.3g} {unit}",
        edit=offset_edit(e, "q", offsets),
        blind=BLIND,
    )


def _small_offsets(before: Hypothesis) -> Array:
    """Offset (n,) of each joint alone that minimises the cost, with torques linear in it."""
    n = before.evidence.count
    model = before.evidence.normal(before.motion, more=_slopes(before))
    offsets = np.zeros(n)
    for k in range(n):
        costs = []
        for offset in (-TRIED, 0.0, TRIED):
            mixing = np.zeros((2 * n, n))
            mixing[:n], mixing[n + k] = before.mixing, -offset
            costs.append(model.fit(mixing).cost)
        curvature = costs[0] - 2 * costs[1] + costs[2]
        if curvature > 0:
            offsets[k] = np.clip(0.5 * TRIED * (costs[0] - costs[2]) / curvature, -1.0, 1.0)
    return offsets


def _slopes(before: Hypothesis) -> Array:
    """Derivatives (N, n, n) of the fitted torques by the position of each joint (last axis)."""
    e, links = before.evidence, before.fit.links
    reference = e.regressor(before.motion) @ links
    slopes = []
    for k in range(e.count):
        step = np.zeros(e.count)
        step[k] = STEP
        slopes.append((e.regressor(before.motion.with_offset(step)) @ links - reference) / STEP)
    return np.stack(slopes, axis=2)
