"""Candidates that change torques: their signs, columns and gains, and a load at the tool."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import Final

import numpy as np

from sysid_bench.diagnosis.finding import WARNING
from sysid_bench.diagnosis.hypothesis import (
    Candidate,
    Hypothesis,
    columns_edit,
    joint_factors,
    setting_edit,
)
from sysid_bench.evaluation.intervals import coverage_factor, level_text
from sysid_bench.models.model_checks import length

NORMAL: Final = 1.96
"""97.5 % quantile of the normal distribution, of a decision."""

EXCHANGED: Final = 0.5
"""Cost below which three or more columns cannot be exchanged."""

FACTORS: Final = np.logspace(-4, 4, 33)
"""Gains tried: four to a decade."""
REFINED: Final = np.logspace(-0.125, 0.125, 7)
SMALLEST: Final = 1.8
"""A smaller gain lies within the spread of masses between a model file and its robot."""
EXACT: Final = 0.003
"""Least residual, relative to a joint's RMS torque, of an interval of a gain."""
MASSLESS: Final = 0.01
"""Mass, relative to the heaviest link, that rounding and spread give links without any."""
KNOWN: Final = {1e3: "mN m for N m", 180 / np.pi: "degrees for radians in a gain"}
"""Ratios of units."""
BLIND_GAIN: Final = (
    "joints whose torque is mostly friction or rotor inertia, such as wrists and vertical first "
    "axes; a common factor below 2 needs a known load"
)

LEAST: Final = 0.5
"""Least share of the cost that a load removes: ten more unknowns explain a part of any residual."""
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
    """Yield candidates with another gain of all torques, or of one joint: units, gear ratios, motor
    side, drive constants."""
    n = before.evidence.count
    yield from _gain(before, tuple(range(n)))
    for j in range(n):
        yield from _gain(before, (j,))


def _gain(before: Hypothesis, joints: tuple[int, ...]) -> Iterator[Candidate]:
    e = before.evidence

    def scaled(factor: float) -> Hypothesis:
        return before.with_torque(np.diag(joint_factors(e.count, joints, factor)))

    costs = np.array([scaled(k).fit.cost for k in FACTORS])
    coarse = FACTORS[np.argmin(costs)]
    factor = min(coarse * REFINED, key=lambda k: scaled(k).fit.cost)
    best, size = scaled(factor), max(factor, 1 / factor)
    # The 95 % interval of the gain, from the costs at FACTORS, has to have two ends and to leave 1
    # out. The residuals of the joints count as one independent number each: models, not noise, make
    # most of them.
    level = max(float((best.fit.residual[list(joints)] ** 2).mean()), EXACT**2)
    limit = best.fit.cost + NORMAL**2 * level
    # No link may need a negative mass; links without one in the file are left aside.
    mass = best.fit.links[::10]
    possible = e.placeholder != "" or bool((mass > -MASSLESS * mass.max()).all())
    decided = min(before.fit.cost, costs[0], costs[-1]) > limit
    if size < SMALLEST or not (decided and possible):
        return
    names = "all joints" if len(joints) == e.count else e.joints[joints[0]]
    cause = (
        "a unit, a gear ratio or a drive constant" if size > 20 else "a drive constant or a gear"
    )
    cause = next((text for k, text in KNOWN.items() if abs(np.log(size / k)) < 0.2), cause)
    kind = "small" if factor > 1 else "large"
    message = f"the torque of {names} is about {size:.3g} times too {kind}: {cause}"
    edit = setting_edit(e, "tau", "gain", joint_factors(e.count, joints, factor))
    yield Candidate("gain", joints, best, message, edit, BLIND_GAIN)


def tool_load(before: Hypothesis) -> Iterator[Candidate]:
    """Yield the candidate with ten unknown inertial parameters at the tool, where these are those
    of a body: of positive mass, and not far larger than the robot."""
    e = before.evidence
    if e.loaded or e.placeholder or e.robot.tree.carrier[e.robot.tool_body] < 0:
        return
    loaded = replace(before, evidence=replace(e, loaded=True), given=None)
    phi, explains = loaded.fit.links[-10:], 1.0 - loaded.fit.cost / before.fit.cost
    # Inertias that the motion hardly excites may have any sign: half of their trace decides.
    mass, farthest = float(phi[0]), FARTHEST * length(e.robot)
    turning = 0.5 * abs(phi[4] + phi[7] + phi[9])
    is_near = np.linalg.norm(phi[1:4]) <= farthest * mass and turning <= farthest**2 * mass
    if explains < LEAST or not (mass > 0 and is_near):
        return
    deviation = loaded.model.deviation(loaded.mixing, len(loaded.fit.links) - 10)
    half = round(coverage_factor(np.inf), 2) * deviation
    body = e.robot.body_names[e.robot.tool_body]
    yield Candidate(
        "load", tuple(range(e.count)), loaded,
        f"a load at {body} that the model lacks explains the torque: {mass:.3g} kg "
        f"({level_text()} in [{max(mass - half, 0.0):.3g}, {mass + half:.3g}], as far as the "
        "masses of the links are known)",
        f"payload = {{ mass = {mass:.3g} }}, with its com and inertia, if that was mounted; "
        "identify finds it with the task payload",
        "a last link much heavier than in the model file looks alike", most=WARNING,
    )  # fmt: skip
