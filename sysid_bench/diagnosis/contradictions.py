"""Contradictions between a recording and its robot: the cures of all checks compete.

A mistake leaves a residual that other cures remove in part as well; the one that removes most is
named first.
"""

from collections.abc import Sequence
from typing import Final

from sysid_bench.diagnosis.checks.encoder_offset import encoder_offset
from sysid_bench.diagnosis.checks.gravity_direction import gravity_direction
from sysid_bench.diagnosis.checks.joint_columns import joint_columns
from sysid_bench.diagnosis.checks.joint_direction import joint_direction
from sysid_bench.diagnosis.checks.sample_rate import sample_rate
from sysid_bench.diagnosis.checks.torque_columns import torque_columns
from sysid_bench.diagnosis.checks.torque_gain import torque_gain
from sysid_bench.diagnosis.checks.torque_sign import torque_sign
from sysid_bench.diagnosis.checks.wrong_robot import wrong_robot
from sysid_bench.diagnosis.evidence import Evidence
from sysid_bench.diagnosis.finding import ERROR, WARNING, Finding
from sysid_bench.diagnosis.hypothesis import Cure, CureSearch, Hypothesis, as_recorded

SEARCHES: Final[Sequence[CureSearch]] = (
    sample_rate, torque_sign, torque_columns, torque_gain, gravity_direction, encoder_offset,
    joint_columns, joint_direction,
)  # fmt: skip
"""Searches in the order in which equal cures are named."""

OF_MOTION: Final = (joint_columns, joint_direction)
ROUGH: Final = 0.06
"""Cost below which no joint moves the wrong way or in the place of another."""

GATE: Final = 0.002
"""Cost below which nothing is left to explain: two per cent of the torque on each of six joints."""

LITTLE: Final = 0.03
CLEAR: Final = 0.6
"""Cost below which a cure has to remove this share of it, or noise would be explained."""

SURE: Final = 0.35
DOUBTFUL: Final = 0.2
"""Shares of the cost that a cure has to remove, for an error and for a warning."""

LARGE: Final = 0.03
"""Cost that an error has to remove."""

EQUAL: Final = 0.02
"""Difference of the shares of two cures that recordings do not decide."""

EXPLAINED: Final = 0.75
FOREIGN: Final = 0.15
"""Share of the cost that a cure explains, and cost, from which and up to which the library is not
searched for another robot."""

ROUNDS: Final = 3
"""Mistakes that are looked for one after another."""


def contradictions(evidence: Evidence) -> list[Finding]:
    """Return the mistakes that a robot near the model explains, each after the one before it is
    cured."""
    found: list[Finding] = []
    current = as_recorded(evidence)
    for _ in range(ROUNDS):
        if current.fit.cost < GATE:
            break
        cures = _ranked_cures(current)
        least = DOUBTFUL if current.fit.cost > LITTLE else CLEAR
        if not cures or cures[0].explains(current) < least:
            break
        found.append(_finding(cures, current))
        if found[-1].severity != ERROR:
            break
        current = cures[0].hypothesis
    return found


def _ranked_cures(current: Hypothesis) -> list[Cure]:
    """All cures, the best first; other robots only where nothing else explains the recording."""
    rough = current.fit.cost >= ROUGH
    searches = [search for search in SEARCHES if rough or search not in OF_MOTION]
    cures = [cure for search in searches for cure in search(current)]
    cures.sort(key=_cost)
    if cures and cures[0].explains(current) < EXPLAINED and current.fit.cost > FOREIGN:
        # Of many robots one fits better by chance: such a cure is an error or nothing.
        foreign = [cure for cure in wrong_robot(current) if cure.explains(current) >= SURE]
        cures = sorted([*cures, *foreign], key=_cost)
    return cures


def _cost(cure: Cure) -> float:
    return cure.hypothesis.fit.cost


def _finding(cures: Sequence[Cure], before: Hypothesis) -> Finding:
    """Finding of the best of some cures, with another one that is as good."""
    cure, explains = cures[0], cures[0].explains(before)
    sure = explains >= SURE and cure.removes(before) >= LARGE
    others = [one for one in cures[1:] if one.explains(before) > explains - EQUAL]
    other = next((one for one in others if one.name != cure.name), None)
    return Finding(
        name=cure.name,
        severity=ERROR if sure else WARNING,
        message=cure.message + (f" (or, as likely: {other.message})" if other else ""),
        joints=tuple(before.evidence.joints[j] for j in cure.joints),
        explains=round(explains, 3),
        confidence=round(min(1.0, explains) * (0.5 if other else 1.0), 2),
        blind=cure.blind,
        edit=cure.edit,
    )
