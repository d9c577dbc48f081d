"""Candidates that give each joint a gain of its own: wrong gains of some joints, and currents that
are declared as torques.

The gains k and the links theta that minimise sum_j |k_j tau_j - W_j theta - friction_j|^2 /
|k_j tau_j|^2, theta near the model file, follow from each other in turn: each slope of the links'
torque on the recorded one, and the links of the scaled torques. Factors on torques change nothing.
"""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import ERROR, WARNING, Finding
from sysid_bench.diagnosis.hypothesis import NORMAL, Candidate, Hypothesis, gain_edits
from sysid_bench.diagnosis.near_model import PENALTY
from sysid_bench.signals.torque_scale import scale_contradiction
from sysid_bench.types import Array

TURNS: Final = 8
"""Gains converge to two digits in as many turns, from those of the model file's links."""
CERTAIN: Final = 2.69
"""Standard deviations of a decision at 5 % on any of seven joints."""
WIDEST: Final = 0.5 * float(np.log(10.0))
"""Half of the widest interval of a gain that is one, in the logarithm."""
SMALLEST: Final = np.log(1.8)
"""A smaller gain lies within the spread of masses between a model file and its robot."""
ALIKE: Final = np.log(1.5)
"""Gains that differ by less are one factor."""
EXACT: Final = 1e-5
"""Least mean squared residual, relative to a joint's torque, of an interval of a gain."""
FOLLOWS: Final = 0.5
"""Share of a torque beyond friction that the model file's explains."""
LEAST: Final = 3.0
"""Least N m per A of a geared drive: masses of model files are less wrong."""
RIVAL: Final = 0.75
"""Evidence of a load over that of the first explanation, from which currents are a doubt."""
BLIND: Final = "joints whose torque is mostly friction; models without masses"


def joint_gains(before: Hypothesis) -> Iterator[Candidate]:
    """Yield the candidate in which two or more joints have wrong gains: one factor, or, where no
    joint is right and each has its own, the torque constants of currents.

    A factor common to all joints, or of one, is left to `torque_gain`.
    """
    e = before.evidence
    if e.placeholder:
        return
    logs, deviation = _log_gains(before)
    # An interval of more than a decade names no factor.
    deviation *= before.with_torque(np.diag(np.exp(logs))).strain
    decided = NORMAL * deviation < WIDEST
    wrong = decided & (np.abs(logs) > np.maximum(SMALLEST, CERTAIN * deviation))
    found = logs[wrong]
    if len(found) < 2:
        return
    middle, is_common = float(np.median(found)), float(np.ptp(found)) < ALIKE
    # A joint is right where 1 is possible and the gain of the others is not.
    right = (np.abs(logs) < NORMAL * deviation) & (np.abs(logs - middle) > NORMAL * deviation)
    if not right.any() and is_common:
        return
    # Geared drives give more N m than they take A.
    is_current = not right.any() and bool((found > 0).all())
    if is_current:
        # Joints that decide nothing take the gain of the others.
        logs = np.where(wrong, logs, middle)
    else:
        logs = np.where(wrong, middle if is_common else logs, 0.0)
    gains, half = np.exp(logs), NORMAL * float(deviation[wrong].max())
    cured, (edit, doubt) = before.with_torque(np.diag(gains)), gain_edits(e, gains, half)
    hit = np.flatnonzero(wrong).tolist()
    name, joints, unknowns, interval = "gain", tuple(hit), float(len(hit)), None
    if is_current:
        listed = ", ".join(f"{e.joints[j]} {gains[j]:.3g}" for j in hit)
        text = f"torques are off by a factor of their own in each joint ({listed}): currents?"
        edit = f'{edit}, and unit = "A" where these are currents'
        name, joints, unknowns = "current", tuple(range(e.count)), float(e.count)
    elif is_common:
        # One factor is known as well as all of its joints together know it.
        close, size = NORMAL / np.sqrt((deviation[wrong] ** -2).sum()), np.exp(abs(middle))
        interval, unknowns = (float(size * np.exp(-close)), float(size * np.exp(close))), 1.0
        listed = ", ".join(e.joints[j] for j in hit)
        text = f"the torques of {listed} are about {_times(gains[hit[0]])}"
    else:
        text = "; ".join(f"the torque of {e.joints[j]} is about {_times(gains[j])}" for j in hit)
    yield Candidate(
        name, joints, cured, text if is_current else f"{text}: a gear or a drive constant", edit,
        BLIND, unknowns=unknowns, doubt=doubt, interval=interval,
        estimate=_times(gains[hit[0]]) if interval else "",
    )  # fmt: skip


def drive_currents(before: Hypothesis) -> Iterator[Candidate]:
    """Yield the candidate in which torques are currents of geared drives: those of the model file
    on several joints, each times a small factor, and a sign, of its own."""
    e, n = before.evidence, before.evidence.count
    parts = np.array([_without_terms(before, j, np.zeros(before.model.rank))[-2:, -2:]
                      for j in range(n)])  # fmt: skip
    of_file, both, recorded = parts[:, 0, 0], parts[:, 0, 1], parts[:, 1, 1]
    follows = both**2 > FOLLOWS * of_file * recorded
    gains = of_file[follows] / both[follows]
    if e.placeholder or len(gains) < 2 or np.abs(gains).min() < LEAST:
        return
    logs = np.log(np.abs(gains))
    if np.ptp(logs) < ALIKE and np.ptp(np.sign(gains)) == 0:
        return  # one gain of all joints
    every = np.full(n, float(np.exp(np.median(logs))))
    every[follows] = gains
    listed = ", ".join(f"{e.joints[j]} {every[j]:.3g}" for j in np.flatnonzero(follows))
    edit, doubt = gain_edits(e, np.abs(every), WIDEST)
    yield Candidate(
        "current", tuple(range(n)), before.with_torque(np.diag(every)),
        "torques follow those of the model file, each at a factor of its own "
        f"({listed} times too small): currents?",
        f'{edit}, and unit = "A" where these are currents', BLIND, unknowns=float(n), doubt=doubt,
    )  # fmt: skip


def torque_scale(evidence: DiagnoseInput, found: Sequence[Finding]) -> Iterator[Finding]:
    """Yield currents, or torques of motors, that no finding yet refuses: torques that follow those
    of the model at another scale; a doubt where a load explains them.

    A model that is fitted to them is as good on their own motion, and wrong by their gains.
    """
    e, described = evidence, evidence.log.description.tau
    is_stated = "A" in (described.unit or ()) or described.pd is not None
    if is_stated or e.placeholder or any(one.is_error for one in found):
        return
    recording = e.log.recording
    q = recording.q[:, e.position_columns]
    reason = scale_contradiction(q, e.torque_samples, recording.t, e.robot, e.joints, sure=True)
    if reason:
        tables = [one.alternatives for one in found if one.alternatives]
        is_load = any(one.name == "load" and one.evidence > RIVAL * rows[0].evidence
                      for rows in tables for one in rows)  # fmt: skip
        severity = WARNING if is_load else ERROR
        yield Finding(
            "current", severity, f"tau does not hold torques of joints in N m: {reason}", e.joints,
            edit="tau = { unit = 'A', gain = ... }, or ratio = ... of the gears", blind=BLIND,
        )  # fmt: skip


def _times(factor: float) -> str:
    return f"{max(factor, 1 / factor):.3g} times too {'small' if factor > 1 else 'large'}"


def _log_gains(before: Hypothesis) -> tuple[Array, Array]:
    """Logarithms (n,) of the gains of all joints, and their standard deviations; infinite where the
    links have no part in the torque, or one of the other sign."""
    model, n = before.model, before.evidence.count
    links, slope = np.zeros(model.rank), np.ones(n)
    for _ in range(TURNS):
        parts = [_without_terms(before, j, links) for j in range(n)]
        slope = np.array(
            [part[-2, -1] / part[-2, -2] if part[-2, -2] > 0 else 0.0 for part in parts]
        )
        gains = 1.0 / np.where(slope > 0, slope, 1.0)
        fit = before.with_torque(np.diag(gains)).fit
        links = model.basis.T @ ((fit.links - model.known) / model.scale)
    deviation = np.full(n, np.inf)
    used = np.flatnonzero(slope > 0)
    if len(used):
        level = max(EXACT, fit.cost / n)
        deviation[used] = _deviations(before, links, slope, used) * np.sqrt(level)
    return -np.log(np.where(slope > 0, slope, 1.0)), deviation


def _without_terms(before: Hypothesis, j: int, links: Array) -> Array:
    """Mean products (r + 2, r + 2) of joint j's columns [links, torque of these links, recorded
    torque] after its friction, armature and offset are fitted to each."""
    P, r = before.model.without_terms[0][j], before.model.rank
    C = np.zeros((len(P), r + 2))
    C[:r, :r] = np.eye(r)
    C[:r, r], C[r, r] = links, 1.0
    C[r + 1 :, r + 1] = before.mixing[:, j]
    return np.asarray(C.T @ P @ C)


def _deviations(before: Hypothesis, links: Array, slope: Array, used: Array) -> Array:
    """Standard deviations (k,) of the logarithms of the used joints' gains, at a mean squared
    relative residual of 1; residuals of a joint count as one independent number."""
    model = before.model
    r, k, scale = model.rank, len(used), model.torque_scale(before.mixing)
    H = np.zeros((r + k, r + k))
    H[:r, :r] = PENALTY**2 * np.eye(r)
    for i, j in enumerate(used.tolist()):
        G = _without_terms(before, j, links)
        weight = slope[j] ** 2 * scale[j]
        H[:r, :r] += weight * G[:r, :r]
        H[:r, r + i] = H[r + i, :r] = weight * G[:r, r]
        H[r + i, r + i] = weight * G[r, r]
    size = np.sqrt(np.maximum(np.diag(H), 1e-300))
    inverse = np.linalg.inv(H / np.outer(size, size) + 1e-9 * np.eye(r + k))
    # Of a joint without motion or torque only rounding is left: its gain is unknown.
    variance = np.diag(inverse)[r:]
    known = (variance > 0) & (variance < 1e8)
    return np.where(known, np.sqrt(np.where(known, variance, 1.0)) / size[r:], np.inf)
