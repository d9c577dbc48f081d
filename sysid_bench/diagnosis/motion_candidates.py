"""Candidates that change the motion: sampling rate, zeros, columns, directions and units."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Final

import numpy as np

from sysid_bench.diagnosis.hypothesis import (
    Candidate,
    Hypothesis,
    columns_edit,
    joint_factors,
    joints_edit,
    setting_edit,
)
from sysid_bench.signals.log_samples import UNITS
from sysid_bench.types import Array

RATES: Final = (0.01, 0.1, 0.2, 0.25, 0.5, 2.0, 4.0, 5.0, 10.0, 100.0)
"""True over declared rate: halved, doubled, tenfold, and what lies between."""

SMALLEST: Final = 0.05
"""rad, m; smaller offsets lie within the spread of centres of mass."""
QUARTERS: Final = (0.5 * np.pi, -0.5 * np.pi, np.pi)
"""rad; zeros of other conventions."""
ZERO_STEP: Final = 0.03
"""rad, m, beside an offset, where the score is taken for its interval."""
STEP: Final = 1e-4
TRIED: Final = (0.4, 0.2, 0.1, 0.05, 0.025, 0.01, 0.004)
STEPS: Final = 4
CLOSE: Final = 2e-3
"""Steps of the search for an offset, and the step (rad, m) at which it ends."""
BLIND_OFFSET: Final = "axes parallel to gravity; a payload or another centre of mass looks alike"

BLIND_COLUMNS: Final = "joints that move alike, or that carry almost no torque"
BLIND_DIRECTION: Final = "balanced joints with little friction"

POSITION_UNITS: Final = {"hinge": ("rad", "deg"), "slide": ("m", "mm")}
MOST: Final = 1.5
"""Range and speed of the motion in another unit, relative to the limits of the joint, above which
it is none."""
LEAST_MOTION: Final = {"hinge": 0.1, "slide": 0.01}
"""Range of the joint that moves most: nobody records less, in which all torques are friction."""
BLIND_UNIT: Final = "balanced joints; slides parallel to gravity and vertical axes that move slowly"


def sampling_rate(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates with another rate, for recordings without velocities; the reader checks the
    rate of others."""
    e = before.evidence
    if e.log.measured_rate is not None:
        return
    W = e.regressor(before.motion)
    gravity = e.regressor(replace(before.motion, v=0 * before.motion.v, a=0 * before.motion.a))
    for factor in RATES:
        # Inertial and Coriolis torques are quadratic in the rate; gravity does not depend on it.
        def at(rate: float) -> Hypothesis:
            columns = gravity + (rate / e.rate) ** 2 * (W - gravity)
            return before.with_columns(columns, before.motion.with_rate(rate / e.rate))

        rate = factor * e.rate
        yield Candidate(
            "rate", tuple(range(e.count)), at(rate),
            f"inertial torques fit a rate of about {rate:.4g} Hz, not {e.rate:.4g} Hz",
            f'rate = "{rate:.4g} Hz"', "slow motion, whose torques are gravity and friction alone",
            estimate=f"{rate:.4g} Hz", along=(rate, 0.02 * rate, at),
        )  # fmt: skip


def encoder_offset(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates with each joint's positions moved by quarter turns, and by the best small
    offset; that of the joint that fits best is searched to the end."""
    e = before.evidence
    best: tuple[Candidate, float] | None = None
    for j, small in enumerate(_small_offsets(before, range(e.count), SMALLEST)):
        quarters = QUARTERS if e.kinds[j] == "hinge" else ()
        for offset in (*quarters, float(small)):
            if abs(offset) >= SMALLEST:
                candidate = _moved(before, j, offset)
                yield candidate
                if best is None or candidate.hypothesis.fit.score < best[0].hypothesis.fit.score:
                    best = candidate, offset
    if best is not None:
        yield from _searched(before, *best)


def _searched(before: Hypothesis, start: Candidate, offset: float) -> Iterator[Candidate]:
    """Yield the candidate of the least cost near a start, if it is another one."""
    # Torques are not linear in a large offset, and the first step misses the minimum of the cost.
    candidate, (j,) = start, start.joints
    for _ in range(STEPS):
        step = float(_small_offsets(candidate.hypothesis, (j,))[0])
        moved = _moved(before, j, offset + step)
        if moved.hypothesis.fit.score >= candidate.hypothesis.fit.score:
            break
        candidate, offset = moved, offset + step
        if abs(step) < CLOSE:
            break
    if candidate is not start and abs(offset) >= SMALLEST:
        yield candidate


def _moved(before: Hypothesis, j: int, offset: float) -> Candidate:
    e = before.evidence
    own = np.eye(e.count)[j]

    def at(zero: float) -> Hypothesis:
        return before.with_motion(before.motion.with_offset(-zero * own))

    zero = f"{-offset:.3g} {POSITION_UNITS[e.kinds[j]][0]}"
    return Candidate(
        "offset", (j,), at(-offset), f"the zero of {e.joints[j]} is off by {zero}",
        setting_edit(e, "q", "offset", summands=offset * own), BLIND_OFFSET,
        estimate=zero, along=(-offset, ZERO_STEP, at),
    )  # fmt: skip


def _small_offsets(before: Hypothesis, joints: Sequence[int], least: float = 0.0) -> Array:
    """Offset (k,) of each of some joints alone that minimises the cost, with torques linear in
    it: their derivatives by the positions are further columns of the fit. Those below `least` may
    be left out."""
    e, links, n = before.evidence, before.fit.links, before.evidence.count
    reference = e.regressor(before.motion) @ links
    slopes = []
    for j in joints:
        step = np.zeros(n)
        step[j] = STEP
        slopes.append((e.regressor(before.motion.with_offset(step)) @ links - reference) / STEP)
    model = e.normal(before.motion, more=np.stack(slopes, axis=2))
    offsets = np.zeros(len(joints))
    for k in range(len(joints)):
        best = before.fit.score
        for size in TRIED:
            if size < least and offsets[k] == 0:
                break  # the steps that are left sum up to less
            for moved in (offsets[k] - size, offsets[k] + size):
                # The fit of torques less slope times offset: no new regressor.
                mixing = np.zeros((n + len(joints), n))
                mixing[:n], mixing[n + k] = before.mixing, -moved
                score = model.fit(mixing).score
                if score < best:
                    best, offsets[k] = score, moved
    return offsets


def joint_columns(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates that exchange two columns of q and v, or two joints with their torques."""
    e = before.evidence
    for pair in combinations(range(e.count), 2):
        order = list(range(e.count))
        order[pair[0]], order[pair[1]] = pair[1], pair[0]
        names = f"{e.joints[pair[0]]} and {e.joints[pair[1]]}"
        exchanged = before.with_motion(before.motion.columns(order))
        yield Candidate(
            "columns", pair, exchanged, f"the positions of {names} are exchanged",
            columns_edit(e, ["q", "v"], order), BLIND_COLUMNS,
        )  # fmt: skip
        yield Candidate(
            "columns", pair, exchanged.with_torque(np.eye(e.count)[:, order]),
            f"the joints {names} are exchanged: positions and torques", joints_edit(e, order),
            BLIND_COLUMNS,
        )  # fmt: skip


def joint_direction(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates that turn all joints or one, without the torque or with it."""
    e = before.evidence
    recorded = [signal for signal in ("q", "v") if signal in e.log.description.signals]
    every = tuple(range(e.count))
    for joints in (every, *((j,) for j in every)):
        signs = joint_factors(e.count, joints, -1.0)
        names = "all joints" if len(joints) == e.count else e.joints[joints[0]]
        edit = "; ".join(setting_edit(e, signal, "ratio", signs) for signal in recorded)
        turned = before.with_motion(before.motion.scaled(signs))
        message = f"{names}: positions and velocities have the opposite direction"
        yield Candidate("direction", joints, turned, message, edit, BLIND_DIRECTION)
        if joints is not every:
            yield Candidate(
                "direction", joints, turned.with_torque(np.diag(signs)),
                f"the axis of {e.joints[joints[0]]} points the other way in the model: positions "
                "and torques are negated",
                f"{edit}; {setting_edit(e, 'tau', 'gain', signs)}", BLIND_DIRECTION,
            )  # fmt: skip


def position_unit(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates with the positions of all hinges, or of all slides, in another unit: degrees
    for radians, millimetres for metres, or the reverse.

    A log with a transmission gets none: its units are those of motors.
    """
    e, log = before.evidence, before.evidence.log.description
    if log.transmission is not None:
        return
    stated = [POSITION_UNITS[kind][0] for kind in e.kinds]
    if log.q.unit is not None:
        stated = [log.q.unit[k if len(log.q.unit) > 1 else 0] for k in e.columns]
    for kind, units in POSITION_UNITS.items():
        for unit in units:
            joints = [j for j in range(e.count) if e.kinds[j] == kind and stated[j] != unit]
            if joints:
                yield from _restated(before, joints, stated, unit)


def _restated(
    before: Hypothesis, joints: list[int], stated: Sequence[str], unit: str
) -> Iterator[Candidate]:
    """Yield the candidate with the positions of some joints in a unit, where the robot reaches
    them."""
    e, log = before.evidence, before.evidence.log.description
    factors = np.ones(e.count)
    for j in joints:
        scale = UNITS["q"][e.kinds[j]]
        factors[j] = scale[unit] / scale[stated[j]]
    offset = log.joint_values("q.offset", log.q.offset)[e.columns]
    restated = before.motion.scaled(factors).with_offset((1 - factors) * offset)
    limits, dofs = e.robot.limits, e.dofs[joints]
    reach = MOST * (limits.q_high[dofs] - limits.q_low[dofs])
    within = np.ptp(restated.q[:, joints], axis=0) <= reach
    slow = np.abs(restated.v[:, joints]).max(axis=0) <= MOST * limits.v[dofs]
    least = [LEAST_MOTION[e.kinds[j]] for j in joints]
    moves = np.ptp(restated.q[:, joints], axis=0) > least
    if not (within & slow).all() or not moves.any():
        return
    names = ", ".join(e.joints[j] for j in joints)
    was = " or ".join(dict.fromkeys(stated[j] for j in joints))
    edits = []
    for signal, text in (("q", unit), ("v", f"{unit}/s")):
        if signal in log.signals and len(joints) == len(log.joints):
            edits.append(f'{signal} = {{ unit = "{text}" }}')
        elif signal in log.signals:
            edits.append(f'{signal}.unit of {names}: "{text}"')
    message = f"positions of {names} fit {unit}, not {was}"
    moved = before.with_motion(restated)
    yield Candidate("units", tuple(joints), moved, message, "; ".join(edits), BLIND_UNIT)
