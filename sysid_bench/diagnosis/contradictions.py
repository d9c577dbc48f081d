"""Contradictions between a recording and its robot: the candidates of all checks compete.

A mistake leaves a residual that other candidates remove in part as well; the one with the largest
evidence is named first, and every kind of explanation that gains anything stands in its table.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from sysid_bench.diagnosis import motion_candidates as of_motion
from sysid_bench.diagnosis import torque_candidates as of_torque
from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import ERROR, WARNING, Finding
from sysid_bench.diagnosis.gain_candidates import drive_currents, joint_gains, torque_scale
from sysid_bench.diagnosis.hypothesis import Candidate, Hypothesis, first_hypothesis
from sysid_bench.diagnosis.model_candidates import (
    LINK,
    gravity_direction,
    link_inertia,
    other_robot,
)

LOAD: Final = "load"
GAIN: Final = "gain"

Search = Callable[[Hypothesis], Iterator[Candidate]]
SEARCHES: Final[Sequence[Search]] = (
    of_motion.sampling_rate, of_torque.torque_direction, of_torque.torque_magnitude,
    of_torque.torque_columns,
    of_torque.tool_load, of_torque.torque_gain, joint_gains, drive_currents, gravity_direction,
    of_motion.encoder_offset,
    of_motion.joint_columns, of_motion.joint_direction, of_motion.position_unit,
)  # fmt: skip
"""Searches in the order in which equal candidates are named."""

OF_JOINTS: Final = SEARCHES[-3:]
ROUGH: Final = 0.06
"""Cost below which no joint moves the wrong way, in the place of another or in other units."""

SURE: Final = 6.0
DOUBTFUL: Final = 3.0
"""Evidence of an error and of a warning: odds of 20 to 1 and of 4 to 1."""

LARGE: Final = 0.03
"""Cost that an error has to remove: less costs little accuracy, however certain it is."""

LEAST: Final = 0.1
NOTICED: Final = 0.01
"""A candidate removes this share of the cost, or a cost of a tenth of one joint's torque: what is
left may be other mistakes, but one that explains next to nothing is none."""

EQUAL: Final = 0.9
"""Share of what the best explanation gains, or explains, from which another one is as likely."""

RIVAL: Final = 0.75
"""The same of gains that are far apart: a number that one has to apply is to be certain."""

AHEAD: Final = 6
"""Candidates after which a load is looked for."""

EXPLAINED: Final = 0.75
FOREIGN: Final = 0.15
FITTING: Final = 0.35
"""Explained share and cost: the library is not searched for another robot where a candidate
explains more, or where the cost is lower. One that explains less than the last share is a doubt: of
many robots one fits better by chance."""

ROUNDS: Final = 3
"""Mistakes that are looked for one after another."""


def contradictions(evidence: DiagnoseInput) -> list[Finding]:
    """Return the mistakes that a robot near the model explains, each after the one before it is
    corrected."""
    found: list[Finding] = []
    unsure: dict[int, str] = {}
    current = first_hypothesis(evidence)
    for _ in range(ROUNDS):
        candidates = _ranked_candidates(current)
        if not candidates:
            break
        found.append(_finding(candidates, current))
        unsure[len(found) - 1] = candidates[0].doubt
        if found[-1].severity != ERROR and candidates[0].most == ERROR:
            break
        current = candidates[0].hypothesis
    # Gains found one after another, as of currents, have made up for each other.
    if sum(bool(doubt) for doubt in unsure.values()) > 1:
        found = [replace(one, edit=unsure[k] or one.edit) for k, one in enumerate(found)]
    # A mistake that is found again once it is corrected has no number that anybody should apply.
    times = Counter((one.name, one.joints) for one in found)
    found = [
        replace(one, severity=WARNING) if times[one.name, one.joints] > 1 else one for one in found
    ]
    return [*found, *torque_scale(evidence, found)]


def _ranked_candidates(current: Hypothesis) -> list[Candidate]:
    """Return all candidates that gain anything, the best first, and none if the best one gains
    little; other robots and other inertias of links only where there is something to explain."""
    if current.fit.score < DOUBTFUL:
        return []
    rough = current.fit.cost >= ROUGH
    searches = [search for search in SEARCHES if rough or search not in OF_JOINTS]
    tried = _tried(current, searches)
    candidates = _sorted(current, tried)
    if rough and not (candidates and candidates[0].share(current) >= EXPLAINED):
        candidates = _sorted(current, _hidden_by_load(current, tried))
    is_explained = bool(candidates) and candidates[0].share(current) >= EXPLAINED
    if current.fit.cost > FOREIGN and not is_explained:
        robots = [
            one if one.share(current) >= FITTING else replace(one, most=WARNING)
            for one in _tried(current, [other_robot])
        ]
        candidates = _sorted(current, [*candidates, *robots])
    if not candidates or candidates[0].evidence(current) < DOUBTFUL:
        return []
    candidates = _sorted(current, [*candidates, *_ranked(current, [link_inertia])])
    return _looked_ahead(candidates, current)


def _hidden_by_load(current: Hypothesis, tried: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates, those that gain little with what a load gains after them: neither is
    visible without the other."""
    weak = [k for k, one in enumerate(tried) if one.gain(current) > 0 and one.name != LOAD]
    weak.sort(key=lambda k: -tried[k].gain(current))
    found = list(tried)
    for k in weak[:AHEAD]:
        if found[k].evidence(current) < DOUBTFUL:
            # Less than what the candidate has to add to a load that explains as much alone.
            after = _after(found[k], [of_torque.tool_load], SURE) - DOUBTFUL
            found[k] = replace(found[k], ahead=max(after, 0.0))
    return found


def _looked_ahead(candidates: Sequence[Candidate], current: Hypothesis) -> list[Candidate]:
    """Return the candidates in the order of what they explain together with a load after them, or
    of a load with the best after it: mistakes hide a load that the model lacks, and the reverse."""
    found = list(candidates)
    for k, one in enumerate(found[:AHEAD]):
        if one.name != LOAD and not one.ahead and one.evidence(current) >= DOUBTFUL:
            found[k] = replace(one, ahead=_after(one, [of_torque.tool_load], SURE))
    found = _sorted(current, found)
    at = next((k for k, one in enumerate(found) if one.name == LOAD), 0)
    if at > 0 and found[at].evidence(current) >= SURE:
        # The mistake itself comes first where both orders explain as much.
        after = _after(found[at], SEARCHES, DOUBTFUL) - SURE
        found[at] = replace(found[at], ahead=max(after, 0.0))
    return _sorted(current, found)


def _after(first: Candidate, searches: Sequence[Search], least: float) -> float:
    """Evidence of the best candidate after another, 0 where it is below some least one."""
    best = max((one.evidence(first.hypothesis) for one in _ranked(first.hypothesis, searches)),
               default=0.0)  # fmt: skip
    return best if best >= least else 0.0


def _ranked(current: Hypothesis, searches: Sequence[Search]) -> list[Candidate]:
    return _sorted(current, _tried(current, searches))


def _tried(current: Hypothesis, searches: Sequence[Search]) -> list[Candidate]:
    """Candidates of some searches, each with the number of sets of joints, or of robots, that its
    search has tried."""
    found: list[Candidate] = []
    for search in searches:
        some = list(search(current))
        count = len({(one.joints, one.edit if one.name == "robot" else "") for one in some})
        found += [replace(one, choices=count) for one in some]
    return found


def _sorted(current: Hypothesis, candidates: Sequence[Candidate]) -> list[Candidate]:
    ranked = sorted(candidates, key=lambda one: -one.evidence(current))
    return [one for one in ranked if one.evidence(current) > 0 and _is_visible(one, current)]


def _is_visible(candidate: Candidate, current: Hypothesis) -> bool:
    """True where a candidate removes a share of the cost, or, of a joint among others that nothing
    explains, a part of that joint's torque."""
    removed, least = candidate.removed(current), LEAST * current.fit.cost
    of_some = len(candidate.joints) < current.evidence.count
    return candidate.is_gross or removed >= (min(NOTICED, least) if of_some else least)


def _is_disputed(best: Candidate, candidates: Sequence[Candidate], before: Hypothesis) -> bool:
    """True where gains that are far apart are about as likely: none is one to apply."""
    if best.name != GAIN:
        return False
    gains, least = np.abs(np.diag(best.hypothesis.mixing)), RIVAL * best.gain(before)
    rivals = [one for one in candidates if one.name == GAIN and one.gain(before) >= least]
    others = [np.abs(np.diag(one.hypothesis.mixing)) for one in rivals]
    far = of_torque.APART
    return any(bool(((one > far * gains) | (gains > far * one)).any()) for one in others)


def _finding(candidates: Sequence[Candidate], before: Hypothesis) -> Finding:
    """Finding of the best of some candidates, with those that are as likely."""
    best = candidates[0]
    kinds = list({one.name: one for one in reversed(candidates)}.values())[::-1]
    kinds = _sorted(before, kinds)
    likely = [
        one
        for one in kinds
        if one is not best
        and not (one.name == LOAD and best.ahead)  # the load that shows after the best
        and (
            one.gain(before) >= EQUAL * best.gain(before)
            # A centre of mass may explain as much as an offset, with more numbers.
            or (one.name == LINK and one.share(before) >= EQUAL * best.share(before))
        )
    ]
    # Where the recording may be intact it is usable, and nobody has to correct it.
    certain = all(one.most == ERROR for one in (best, *likely))
    # A robot that an explanation fits worse than the joint it is about is not explained by it.
    large = best.is_gross or (best.removed(before) >= LARGE and best.share(before) > 0)
    sure = best.evidence(before) - best.ahead >= SURE and large
    severity = ERROR if certain and sure else WARNING if best.most == ERROR else best.most
    if _is_disputed(best, candidates, before):
        best = replace(best, edit=best.doubt or best.edit)
    others = "".join(f" (or, as likely: {one.message})" for one in likely)
    return Finding(
        name=best.name,
        severity=severity,
        message=best.message + others,
        joints=tuple(before.evidence.joints[j] for j in best.joints),
        explains=round(best.share(before), 3),
        confidence=round(1.0 / (1 + len(likely) + np.exp(-0.5 * best.evidence(before))), 2),
        blind=best.blind,
        edit="; or, whichever is true: ".join(
            one.edit if severity == ERROR else one.doubt or one.edit for one in (best, *likely)
        ),
        alternatives=tuple(one.alternative(before) for one in kinds),
        as_likely=tuple(one.name for one in likely),
    )
