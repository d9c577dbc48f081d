"""Zero of the encoders: positions off by a constant."""

from collections.abc import Iterator, Sequence
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
STEPS: Final = 4
CLOSE: Final = 2e-3
"""Steps of the search for an offset, and the step (rad, m) at which it ends."""
BLIND: Final = "axes parallel to gravity; a payload or another centre of mass looks alike"


def encoder_offset(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates with each joint's positions moved by quarter turns, and by the best small
    offset; that of the joint that fits best is searched to the end."""
    e = before.evidence
    best: tuple[Candidate, int, float] | None = None
    for j, small in enumerate(_small_offsets(before, range(e.count))):
        quarters = QUARTERS if e.kinds[j] == "hinge" else ()
        for offset in (*quarters, float(small)):
            if abs(offset) >= SMALLEST:
                candidate = _cure(before, j, offset)
                yield candidate
                if best is None or candidate.hypothesis.fit.cost < best[0].hypothesis.fit.cost:
                    best = candidate, j, offset
    if best is not None:
        yield from _searched(before, *best)


def _searched(
    before: Hypothesis, candidate: Candidate, j: int, offset: float
) -> Iterator[Candidate]:
    """Yield the candidate with the offset at which the cost has its minimum: torques are not linear
    in a large offset, and the first step misses it."""
    start = candidate
    for _ in range(STEPS):
        step = float(_small_offsets(candidate.hypothesis, (j,))[0])
        moved = _cure(before, j, offset + step)
        if moved.hypothesis.fit.cost >= candidate.hypothesis.fit.cost:
            break
        candidate, offset = moved, offset + step
        if abs(step) < CLOSE:
            break
    if candidate is not start and abs(offset) >= SMALLEST:
        yield candidate


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


def _small_offsets(before: Hypothesis, joints: Sequence[int]) -> Array:
    """Offset (k,) of each of some joints alone that minimises the cost, with torques linear in
    it."""
    n = before.evidence.count
    model = before.evidence.normal(before.motion, more=_slopes(before, joints))
    offsets = np.zeros(len(joints))
    for k in range(len(joints)):
        costs = []
        for offset in (-TRIED, 0.0, TRIED):
            mixing = np.zeros((n + len(joints), n))
            mixing[:n], mixing[n + k] = before.mixing, -offset
            costs.append(model.fit(mixing).cost)
        curvature = costs[0] - 2 * costs[1] + costs[2]
        if curvature > 0:
            offsets[k] = np.clip(0.5 * TRIED * (costs[0] - costs[2]) / curvature, -1.0, 1.0)
    return offsets


def _slopes(before: Hypothesis, joints: Sequence[int]) -> Array:
    """Derivatives (N, n, k) of the fitted torques by the positions of some joints (last axis)."""
    e, links = before.evidence, before.fit.links
    reference = e.regressor(before.motion) @ links
    slopes = []
    for j in joints:
        step = np.zeros(e.count)
        step[j] = STEP
        slopes.append((e.regressor(before.motion.with_offset(step)) @ links - reference) / STEP)
    return np.stack(slopes, axis=2)
