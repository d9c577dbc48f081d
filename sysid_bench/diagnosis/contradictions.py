"""Contradictions between a recording and its robot: the candidates of all checks compete.

A mistake leaves a residual that other candidates remove in part as well; the one that removes most
is named first.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Final

from sysid_bench.diagnosis import motion_candidates as of_motion
from sysid_bench.diagnosis import torque_candidates as of_torque
from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import ERROR, WARNING, Finding
from sysid_bench.diagnosis.gain_candidates import joint_gains
from sysid_bench.diagnosis.hypothesis import Candidate, Hypothesis, first_hypothesis
from sysid_bench.diagnosis.model_candidates import gravity_direction, other_robot

SEARCHES: Final[Sequence[Callable[[Hypothesis], Iterator[Candidate]]]] = (
    of_motion.sampling_rate, of_torque.torque_direction, of_torque.torque_columns,
    of_torque.tool_load, of_torque.torque_gain, joint_gains, gravity_direction,
    of_motion.encoder_offset,
    of_motion.joint_columns, of_motion.joint_direction, of_motion.position_unit,
)  # fmt: skip
"""Searches in the order in which equal candidates are named."""

OF_JOINTS: Final = SEARCHES[-3:]
ROUGH: Final = 0.06
"""Cost below which no joint moves the wrong way, in the place of another or in other units."""

GATE: Final = 0.002
"""Cost below which nothing is left to explain: two per cent of the torque on each of six joints."""

LITTLE: Final = 0.03
CLEAR: Final = 0.6
"""Cost below which a candidate has to remove this share of it, or noise would be explained."""

SURE: Final = 0.35
DOUBTFUL: Final = 0.2
"""Shares of the cost that a candidate has to remove, for an error and for a warning."""

LARGE: Final = 0.03
NOTICED: Final = 0.01
"""Costs that an error, and a warning on joints that explain little of the cost, have to remove."""

EQUAL: Final = 0.02
"""Difference of the shares of two candidates that recordings do not decide."""

EXPLAINED: Final = 0.75
FOREIGN: Final = 0.15
"""Explained share and cost: the library is not searched for another robot where a candidate
explains more, or where the cost is lower."""

ROUNDS: Final = 3
"""Mistakes that are looked for one after another."""


def contradictions(evidence: DiagnoseInput) -> list[Finding]:
    """Return the mistakes that a robot near the model explains, each after the one before it is
    corrected."""
    found: list[Finding] = []
    current = first_hypothesis(evidence)
    for _ in range(ROUNDS):
        if current.fit.cost < GATE:
            break
        candidates = _ranked_candidates(current)
        least = DOUBTFUL if current.fit.cost > LITTLE else CLEAR
        if not candidates or not _is_clear(candidates[0], current, least):
            break
        found.append(_finding(candidates, current))
        if found[-1].severity != ERROR and candidates[0].most == ERROR:
            break
        current = candidates[0].hypothesis
    return found


def _is_clear(candidate: Candidate, before: Hypothesis, least: float) -> bool:
    """True where a candidate removes enough of the cost, or of what its own joints leave."""
    if candidate.share(before) >= least:
        return True
    own = candidate.share_on_joints(before)
    return own >= CLEAR and candidate.difference(before) >= NOTICED


def _ranked_candidates(current: Hypothesis) -> list[Candidate]:
    """Return all candidates, the best first; other robots only where no other candidate explains
    the recording."""

    def cost(candidate: Candidate) -> float:
        return candidate.hypothesis.fit.cost

    rough = current.fit.cost >= ROUGH
    searches = [search for search in SEARCHES if rough or search not in OF_JOINTS]
    candidates = sorted((one for search in searches for one in search(current)), key=cost)
    if candidates and candidates[0].share(current) < EXPLAINED and current.fit.cost > FOREIGN:
        # Of many robots one fits better by chance: such a candidate is an error or nothing.
        foreign = [one for one in other_robot(current) if one.share(current) >= SURE]
        candidates = sorted([*candidates, *foreign], key=cost)
    return candidates


def _finding(candidates: Sequence[Candidate], before: Hypothesis) -> Finding:
    """Finding of the best of some candidates, with another one that is as good."""
    candidate, explains = candidates[0], candidates[0].share(before)
    changed = candidate.share_on_joints(before)
    sure = candidate.difference(before) >= LARGE and (explains >= SURE or changed >= CLEAR)
    others = [one for one in candidates[1:] if one.share(before) > explains - EQUAL]
    other = next((one for one in others if one.name != candidate.name), None)
    return Finding(
        name=candidate.name,
        severity=candidate.most if sure else WARNING,
        message=candidate.message + (f" (or, as likely: {other.message})" if other else ""),
        joints=tuple(before.evidence.joints[j] for j in candidate.joints),
        explains=round(explains, 3),
        confidence=round(min(1.0, max(explains, changed)) * (0.5 if other else 1.0), 2),
        blind=candidate.blind,
        edit=candidate.edit,
    )
