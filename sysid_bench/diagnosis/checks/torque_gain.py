"""Gain of torques: units, gear ratios, motor side, drive constants."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from sysid_bench.diagnosis.edit import factor_edit
from sysid_bench.diagnosis.hypothesis import Candidate, Hypothesis

FACTORS: Final = np.logspace(-4, 4, 33)
"""Factors tried: four to a decade."""
REFINED: Final = np.logspace(-0.125, 0.125, 7)
SMALLEST: Final = 1.8
"""A smaller factor lies within the spread of masses between a model file and its robot."""
KNOWN: Final = {1e3: "mN m for N m", 180 / np.pi: "degrees for radians in a gain"}
"""Ratios of units."""
BLIND: Final = (
    "joints whose torque is mostly friction or rotor inertia, such as wrists and vertical first "
    "axes; a common factor below 2 needs a known load"
)


def torque_gain(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates with another gain of all torques, or of one joint."""
    n = before.evidence.count
    yield from _cures(before, tuple(range(n)))
    for j in range(n):
        yield from _cures(before, (j,))


def _cures(before: Hypothesis, joints: tuple[int, ...]) -> Iterator[Candidate]:
    coarse = min(FACTORS, key=lambda k: _scaled(before, joints, k).fit.cost)
    if coarse in (FACTORS[0], FACTORS[-1]):  # the best gain is none: the links explain nothing
        return
    factor = min(coarse * REFINED, key=lambda k: _scaled(before, joints, k).fit.cost)
    if max(factor, 1 / factor) < SMALLEST:
        return
    e = before.evidence
    names = "all joints" if len(joints) == e.count else e.joints[joints[0]]
    gains = np.ones(e.count)
    gains[list(joints)] = factor
    yield Candidate(
        name="gain",
        joints=joints,
        hypothesis=_scaled(before, joints, factor),
        message=f"the torque of {names} is about {_text(factor)}",
        edit=factor_edit(e, "tau", "gain", gains),
        blind=BLIND,
    )


def _scaled(before: Hypothesis, joints: tuple[int, ...], factor: float) -> Hypothesis:
    gains = np.ones(before.evidence.count)
    gains[list(joints)] = factor
    return before.with_torque(np.diag(gains))


def _text(factor: float) -> str:
    """Meaning of a factor on the torques."""
    size = max(factor, 1 / factor)
    kind = "small" if factor > 1 else "large"
    near = [text for known, text in KNOWN.items() if abs(np.log(size / known)) < 0.2]
    gear = "a unit, a gear ratio or a drive constant" if size > 20 else "a drive constant or a gear"
    return f"{size:.3g} times too {kind}: {near[0] if near else gear}"
