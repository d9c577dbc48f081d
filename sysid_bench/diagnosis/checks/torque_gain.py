"""Gain of torques: units, gear ratios, motor side, drive constants."""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from sysid_bench.diagnosis.edit import factor_edit
from sysid_bench.diagnosis.hypothesis import Candidate, Hypothesis
from sysid_bench.types import Array

FACTORS: Final = np.logspace(-4, 4, 33)
"""Factors tried: four to a decade."""
REFINED: Final = np.logspace(-0.125, 0.125, 7)
SMALLEST: Final = 1.8
"""A smaller factor lies within the spread of masses between a model file and its robot."""
NORMAL: Final = 1.96
"""97.5 % quantile of the normal distribution."""
EXACT: Final = 0.003
"""Least residual, relative to a joint's RMS torque, of an interval."""
MASSLESS: Final = 0.01
"""Mass, relative to the heaviest link, that rounding and spread give links without any."""
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
    costs = np.array([_scaled(before, joints, k).fit.cost for k in FACTORS])
    coarse = FACTORS[np.argmin(costs)]
    factor = min(coarse * REFINED, key=lambda k: _scaled(before, joints, k).fit.cost)
    best = _scaled(before, joints, factor)
    if max(factor, 1 / factor) < SMALLEST:
        return
    if not (_is_decided(before, best, joints, costs) and _is_possible(best)):
        return
    e = before.evidence
    names = "all joints" if len(joints) == e.count else e.joints[joints[0]]
    gains = np.ones(e.count)
    gains[list(joints)] = factor
    yield Candidate(
        name="gain",
        joints=joints,
        hypothesis=best,
        message=f"the torque of {names} is about {_text(factor)}",
        edit=factor_edit(e, "tau", "gain", gains),
        blind=BLIND,
    )


def _is_decided(before: Hypothesis, best: Hypothesis, joints: Sequence[int], costs: Array) -> bool:
    """True where the 95 % interval of the gain, from the costs at FACTORS, has two ends and leaves
    1 out. The residuals of the joints count as one independent number each: models, not noise,
    make most of them."""
    level = max(float((best.fit.residual[list(joints)] ** 2).mean()), EXACT**2)
    limit = best.fit.cost + NORMAL**2 * level
    return bool(min(before.fit.cost, costs[0], costs[-1]) > limit)


def _is_possible(best: Hypothesis) -> bool:
    """True where no link needs a negative mass, links without one in the file left aside."""
    mass = best.fit.links[::10]
    return best.evidence.placeholder != "" or bool((mass > -MASSLESS * mass.max()).all())


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
