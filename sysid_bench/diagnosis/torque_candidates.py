"""Candidates that change torques: their signs, columns and gains, and a load at the tool."""

from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from itertools import combinations
from typing import Final

import numpy as np

from sysid_bench.diagnosis.channel_checks import touches
from sysid_bench.diagnosis.diagnose_input import TOOL, DiagnoseInput, terms
from sysid_bench.diagnosis.finding import ERROR, NOTE, WARNING, Finding
from sysid_bench.diagnosis.gain_candidates import WIDEST
from sysid_bench.diagnosis.hypothesis import (
    NORMAL,
    Candidate,
    Hypothesis,
    columns_edit,
    curvature_half,
    first_hypothesis,
    gain_edits,
    joint_factors,
    setting_edit,
)
from sysid_bench.diagnosis.near_model import FREE
from sysid_bench.evaluation.intervals import coverage_factor, level_text
from sysid_bench.models.model_checks import length
from sysid_bench.types import Array

SIGNINGS: Final = 3
"""Fits, each to a torque with the signs of the fit before."""
SIGNS: Final = 2.0 * float(np.log(2.0))
"""Twice the logarithm of the odds of a sign where a torque comes down to zero."""
EXCHANGED: Final = 0.5
"""Cost below which three or more columns cannot be exchanged."""

FACTORS: Final = np.logspace(-4, 4, 9)
"""Gains tried: one to a decade; the best one is refined by steps that are halved."""
GAINS: Final = (5.0, 10.0, 20.0, 50.0)
"""N m per A of common geared drives."""
HALVED: Final = 7
LIKELY: Final = 1.25
"""A gain of one joint that may be as small lies within the spread of masses."""
SMALLEST: Final = 1.8
"""A smaller gain may be the spread of masses between a model file and its robot as well."""
SAME: Final = 5.0
"""A gain of all joints that may be smaller may be that of all masses, which nothing tells apart: a
public model of a surgical robot states four times its masses."""
APART: Final = 3.0
"""Factor of one joint that fits better beside the common one: that is not common, then."""
GROSS: Final = 10.0
"""No model file is wrong by a larger one in all of its masses."""
KNOWN: Final = {1e3: "mN m for N m", 180 / np.pi: "degrees for radians in a gain"}
"""Ratios of units."""
CLOSE: Final = 0.3
"""Distance of a gain and of its limits from a ratio, in the logarithm: 100 is as far from 180/pi as
its double."""
BLIND_GAIN: Final = (
    "joints whose torque is mostly friction or rotor inertia, such as wrists and vertical first "
    "axes; a common factor below 2 needs a known load"
)

FARTHEST: Final = 0.5
"""Distance of a load's centre of mass from the body that carries it, and radius of gyration, as
shares of the robot's length, above which it is none."""


def torque_direction(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates that negate all torques, or one: friction then feeds power into a joint."""
    e = before.evidence
    every = tuple(range(e.count))
    for joints in (every, *((j,) for j in every)):
        of_one = f"torque of {e.joints[joints[0]]} has"
        whose = "torques of all joints have" if joints is every else of_one
        signs = joint_factors(e.count, joints, -1.0)
        negated, edit = before.with_torque(np.diag(signs)), setting_edit(e, "tau", "gain", signs)
        blind = "a joint with almost no friction, load and inertia"
        yield Candidate("sign", joints, negated, f"the {whose} the opposite sign", edit, blind)


def torque_magnitude(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates with signs for a torque of one sign that comes down to zero: those that a
    robot near the model gives it."""
    e = before.evidence
    for j, column in enumerate(e.columns):
        count = touches(e.raw.tau[:, column])
        if count < 1:
            continue
        W, friction = e.regressor(before.motion)[:, j], terms(before.motion)[:, j]
        # First the links that the other torques ask for, then those of the signed one as well.
        signed = before.with_torque(np.diag(joint_factors(e.count, [j], 0.0)))
        for _ in range(SIGNINGS):
            torque = W @ signed.fit.links + friction @ signed.fit.terms[j]
            signed = _signed(before, j, torque)
        # A torque whose sign is wrong throughout may only lack one.
        negated = before.with_torque(np.diag(joint_factors(e.count, [j], -1.0)))
        if signed.fit.score > negated.fit.score - SIGNS * count:
            continue
        yield Candidate(
            "magnitude", (j,), signed, f"the torque of {e.joints[j]} has no sign: it never crosses "
            "zero where a robot near the model asks for it",
            "tau = { columns = [...] }: torques or currents with their signs",
            "joints that gravity loads to one side",
            # Each time that the torque comes down to zero its sign may change or not.
            unknowns=SIGNS * count,
        )  # fmt: skip


def _signed(before: Hypothesis, j: int, torque: Array) -> Hypothesis:
    """The hypothesis with a recorded torque of joint j that has the signs of another one."""
    e, recording = before.evidence, before.evidence.log.recording
    at = np.arange(len(recording))[e.kept][e.fit_rows]
    tau = recording.tau.copy()
    row = e.torque_columns[j]
    tau[:, row] = np.abs(tau[:, row]) * np.sign(np.interp(np.arange(len(tau)), at, torque))
    log = replace(e.log, recording=replace(recording, tau=tau))
    return replace(before, evidence=replace(e, log=log), given=None)


def torque_columns(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates that exchange two torque columns, and the best assignment of all columns."""
    e, n = before.evidence, before.evidence.count
    orders = set()
    for i, j in combinations(range(n), 2):
        order = list(range(n))
        order[i], order[j] = j, i
        orders.add(tuple(order))
    if before.fit.cost > EXCHANGED:
        orders |= {_assignment(before)} - {tuple(range(n))}
    for best in sorted(orders):
        moved = tuple(j for j, i in enumerate(best) if i != j)
        pairs = ", ".join(f"that of {e.joints[j]} stands with {e.joints[best[j]]}" for j in moved)
        yield Candidate(
            "columns", moved, before.with_torque(np.eye(n)[:, list(best)]),
            f"torque columns are exchanged: {pairs}", columns_edit(e, ["tau"], best),
            "twin joints, whose torques are alike: parallel axes, the fingers of a gripper",
        )  # fmt: skip


def _assignment(before: Hypothesis) -> tuple[int, ...]:
    """The column of each joint (Hungarian method): the one whose torque alone is nearest to what
    friction and a robot near the model give."""
    from scipy.optimize import linear_sum_assignment  # 0.3 s, which clean recordings need not spend

    n = before.evidence.count
    distance = np.ones((n, n))
    for k in range(n):
        # Joint j with the torque of joint (j + k) mod n: n fits give the whole table.
        order = [(j + k) % n for j in range(n)]
        distance[range(n), order] = before.with_torque(np.eye(n)[:, order]).fit.residual
    return tuple(int(i) for i in linear_sum_assignment(distance)[1])


def torque_gain(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates with another gain of all torques, with a load at the tool or without, or of
    one joint: units, gear ratios, motor side, drive constants."""
    n = before.evidence.count
    yield from _gain(before, tuple(range(n)))
    for one in _gain(with_load(before), tuple(range(n))) if may_carry(before) else ():
        # Links near the file are too light for a load: without it the gain would be too large.
        if (carried := _load_mass(one.hypothesis)) is not None:
            text = f"{one.message}, and a load of {carried[0]:.3g} kg that the model lacks"
            yield replace(one, message=text, unknowns=1.0 + load_unknowns(one.hypothesis))
    for j in range(n):
        yield from _gain(before, (j,))


def _gain(before: Hypothesis, joints: tuple[int, ...]) -> Iterator[Candidate]:
    e, is_common = before.evidence, len(joints) == before.evidence.count

    def scaled(factor: float, some: Collection[int] = joints) -> Hypothesis:
        return before.with_torque(np.diag(joint_factors(e.count, some, factor)))

    if (minimum := _best_factor(before, scaled, is_common)) is None:
        return
    factor, half = minimum
    size, least = max(factor, 1 / factor), 1.0 if is_common else LIKELY
    # The interval has to leave 1 out; links or a tool of which the file says nothing may be far
    # heavier.
    if half >= np.log(size / (FREE if e.placeholder and factor < 1 else least)):
        return
    # No link may need a negative mass; links without one in the file are left aside.
    found = scaled(factor)
    heaviest = found.fit.links[::10] + NORMAL * e.link_std[::10] * np.sqrt(found.variances[::10])
    half *= found.strain
    if (is_common and half > WIDEST) or not (e.placeholder or (heaviest >= 0).all()):
        return
    names, cause = "all joints" if is_common else e.joints[joints[0]], _cause(size, half)
    if is_common and size >= SMALLEST and cause not in KNOWN.values():
        # The fewest joints that explain as much, first those without which the others explain least
        order = sorted(joints, key=lambda j: -scaled(factor, {*joints} - {j}).fit.score)
        some = (scaled(factor, order[:k]) for k in range(2, e.count))
        limit = found.fit.score + NORMAL**2
        if fewer := next((k for k, one in enumerate(some, 2) if one.fit.score < limit), 0):
            joints = tuple(sorted(order[:fewer]))
            names, found = ", ".join(e.joints[j] for j in joints), scaled(factor, joints)
            cause += "; the torques of the other joints do not decide it"
        # Currents have a factor of their own in each joint: the common one is none of them.
        own = (joint_factors(e.count, [j], k) for j in joints for k in (1 / APART, APART))
        score = found.fit.score - NORMAL**2
        if any(found.with_torque(np.diag(one)).fit.score < score for one in own):
            half = max(half, float(np.log(APART)))
    interval = float(size * np.exp(-half)), float(size * np.exp(half))
    is_number, ends = half <= WIDEST, " to ".join(f"{float(f'{end:.2g}'):g}" for end in interval)
    number = f"{size:.3g}" if is_number else ends
    estimate = f"{number} times too {'small' if factor > 1 else 'large'}"
    between = f"{level_text()} in [{interval[0]:.3g}, {interval[1]:.3g}]"
    most = ERROR if is_number and interval[0] >= (SAME if is_common else SMALLEST) else WARNING
    edit, doubt = gain_edits(e, joint_factors(e.count, joints, factor), half)
    # What the other joints leave open may be a gain of its own in each of these, as of currents.
    edit = doubt if is_common and len(joints) < e.count else edit
    yield Candidate(
        "gain", joints, found, f"the torque of {names} is about {estimate} ({between}): {cause}",
        edit, BLIND_GAIN, most=most, doubt=doubt, estimate=estimate, interval=interval,
        # Links without mass fit small torques as well, at no cost but the prior's.
        is_gross=is_common and interval[0] > GROSS and e.placeholder == "",
    )  # fmt: skip


def _best_factor(
    before: Hypothesis, scaled: Callable[[float], Hypothesis], is_common: bool
) -> tuple[float, float] | None:
    """Return the gain of the least score, and half of the 95 % interval of its logarithm; None
    where nothing decides one of its ends, or where it is 1."""
    scores = np.array([scaled(factor).fit.score for factor in FACTORS])
    factor, best = float(FACTORS[np.argmin(scores)]), float(scores.min())
    if factor in FACTORS[[0, -1]]:
        return None
    for halved in range(HALVED):
        step = WIDEST * 0.5**halved
        near = [factor * np.exp(-step), factor * np.exp(step)]
        beside = [scaled(one).fit.score for one in near]
        if min(beside) < best:
            factor, best = near[int(np.argmin(beside))], min(beside)
        if factor == 1 and halved and not is_common:
            return None  # what is left are gains within the spread of masses
    limit = best + NORMAL**2
    if min(before.fit.score, scores[0], scores[-1]) <= limit:
        return None
    low, high = (scaled(factor * np.exp(one)).fit.score for one in (-0.1, 0.1))
    half = curvature_half(low, best, high, 0.1)
    inside = np.flatnonzero(scores < limit)
    if half <= WIDEST or is_common or not len(inside):
        return (factor, half) if half <= WIDEST else None
    # Over decades scores are far from parabolas: of a joint whose torque is certainly wrong, though
    # no number is, the ends of the interval are where they cross the limit.
    ends = []
    for i, out in ((inside[0], -1), (inside[-1], 1)):
        share = (limit - scores[i]) / (scores[i + out] - scores[i])
        ends.append(np.log(FACTORS[i]) + out * share * np.log(10.0))
    nearest = ends[0] if ends[0] > 0 else -ends[1]
    if nearest < np.log(SAME):
        return None
    return float(np.exp(np.mean(ends))), float(np.ptp(ends)) / 2


def open_gains(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield the joints whose torque other gains explain as well: friction, which may have any size,
    is most of it."""
    before, n, listed, names = first_hypothesis(evidence), evidence.count, [], []
    for j in np.flatnonzero(evidence.rms > 0).tolist():
        tried = [before.with_torque(np.diag(joint_factors(n, [j], k))) for k in FACTORS]
        scores = np.array([one.fit.score for one in tried])
        possible = FACTORS[scores < before.fit.score + NORMAL**2]
        if possible.max() > 9 * possible.min():
            low = possible.min() if possible.min() > FACTORS[0] else 0.0
            names.append(evidence.joints[j])
            listed.append(f"{names[-1]} {low:.3g} to {possible.max():.3g}")
    if _is_scale_open(before):
        yield Finding(
            "undecided", WARNING,
            "the recording does not tell torques in N m from currents in A or torques of motors: "
            "all of them times 5 or more fit the model as well",
            evidence.joints, blind="motions whose torque is mostly friction",
            edit='tau = { unit = "N m" } where that is sure, else gain or ratio = [...]',
        )  # fmt: skip
    elif names:
        yield Finding(
            "undecided", NOTE,
            "the recording does not decide the gain of joints whose torque is mostly friction "
            f"(times the stated one: {', '.join(listed)}): the stated one is accepted",
            tuple(names), edit="compare with the data sheet of the drive",
        )  # fmt: skip


def _is_scale_open(before: Hypothesis) -> bool:
    """True where nobody states the unit of the torques, and gains of drives fit them as well."""
    tau, one = before.evidence.log.description.tau, np.eye(before.evidence.count)
    # Whoever states a gain or a ratio knows what they multiply.
    is_stated = tau.unit is not None or tau.pd is not None or {*tau.gain, *tau.ratio} != {1.0}
    if is_stated or before.evidence.placeholder:
        return False
    scores = [before.with_torque(one * gain).fit.score for gain in GAINS]
    return min(scores) < before.fit.score + NORMAL**2


def _cause(size: float, half: float) -> str:
    """Likely cause of a gain that is so many times too large or too small, known to a factor of
    exp(half)."""
    if size < SMALLEST:
        return "a drive constant, or links that are as much heavier or lighter than in the file"
    if size <= 20:
        return "a drive constant or a gear"
    if half > WIDEST:
        return "a gear ratio or a drive constant, or a balance that the model lacks"
    known = next((text for k, text in KNOWN.items() if abs(np.log(size / k)) < CLOSE), "")
    if known and half < CLOSE:
        return known
    # A wide interval holds gear ratios and drive constants as well.
    return f"a unit{f' ({known})' if known else ''}, a gear ratio or a drive constant"


def tool_load(before: Hypothesis) -> Iterator[Candidate]:
    """Yield the candidate with ten unknown inertial parameters at the tool, where these are those
    of a body: of positive mass, and not far larger than the robot."""
    e = before.evidence
    if not may_carry(before):
        return
    loaded = with_load(before)
    if (found := _load_mass(loaded)) is None:
        return
    mass, interval = found
    body = e.robot.body_names[e.robot.tool_body]
    yield Candidate(
        "load", tuple(range(e.count)), loaded,
        f"a load at {body} that the model lacks explains the torque: {mass:.3g} kg "
        f"({level_text()} in [{interval[0]:.3g}, {interval[1]:.3g}], as far as the masses of the "
        "links are known)",
        f"payload = {{ mass = {mass:.3g} }}, with its com and inertia, if that was mounted; "
        "identify finds it with the task payload",
        "a last link much heavier than in the model file looks alike", most=WARNING,
        estimate=f"{mass:.3g} kg", interval=interval, unknowns=load_unknowns(loaded),
    )  # fmt: skip


def _load_mass(loaded: Hypothesis) -> tuple[float, tuple[float, float]] | None:
    """Mass of the load and its interval, None where no body has such moments."""
    e, phi = loaded.evidence, loaded.fit.links[-10:]
    # Inertias that the motion hardly excites may have any sign: half of their trace decides.
    reach, turning = FARTHEST * length(e.robot), 0.5 * abs(phi[4] + phi[7] + phi[9])
    least = max(float(np.linalg.norm(phi[1:4])) / reach, turning / reach**2)
    half = coverage_factor(np.inf) * float(np.sqrt(_load_variances(loaded)[0]))
    # No arm carries a load heavier than itself, and none is far larger than its robot.
    low = max(float(phi[0]) - half, least)
    high = min(float(phi[0]) + half, float(e.file_parameters[:, 0].sum()))
    # A pivot at the centre of rotation of a wrist leaves the mass open, not the moments.
    return (float(np.clip(phi[0], low, high)), (low, high)) if 0 < low <= high else None


def may_carry(before: Hypothesis) -> bool:
    """True where a load is not there yet, and moves with links of which the file says something."""
    e = before.evidence
    return not (e.loaded or e.placeholder) and e.robot.tree.carrier[e.robot.tool_body] >= 0


def with_load(before: Hypothesis) -> Hypothesis:
    """The hypothesis with a load at the tool."""
    return replace(before, evidence=before.evidence.carrying, given=None)


def _load_variances(loaded: Hypothesis) -> Array:
    """Variances (10,) of the load."""
    std = loaded.evidence.link_std[-10:]
    return np.asarray(loaded.variances[-10:] * std**2)


def load_unknowns(loaded: Hypothesis) -> float:
    """Numbers of the load that the torque decides: those that it leaves open by more than a tool
    has are not fitted."""
    e = loaded.evidence
    reach = TOOL * length(e.robot)
    mass = TOOL * float(e.file_parameters[:, 0].sum())
    tool = mass * np.array([1.0, *[reach] * 3, *[reach**2] * 6])
    return float((tool**2 / (tool**2 + _load_variances(loaded))).sum())
