"""Checks of one joint at a time, and of the motion: delays, missing terms, joints that no model
explains, placeholders in the model, standstill and conditioning.

A joint's torque is fitted by its own columns, without model parameters or other torques.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.diagnosis.channel_checks import touches
from sysid_bench.diagnosis.diagnose_input import DiagnoseInput, JointMotion
from sysid_bench.diagnosis.finding import ERROR, NOTE, WARNING, Finding
from sysid_bench.diagnosis.hypothesis import first_hypothesis
from sysid_bench.diagnosis.near_model import PENALTY
from sysid_bench.models.manifest import DRIVE_TERMS
from sysid_bench.regressors.joint_features import Play
from sysid_bench.types import Array

SAMPLES: Final = 1500
FOLDS: Final = 5
RIDGE: Final = 1e-8
"""Relative to the largest singular value squared."""

LONGEST: Final = 0.15
"""s, of a delay that is tried."""
LAGS: Final = 25
"""Steps to either side."""
SURE: Final = 0.5
"""Share of the mean squared residual that a shift has to remove: friction that is not modelled also
looks like a shift, of a smaller share."""
LONG: Final = 0.045
SHORTEST: Final = 0.022
"""s, of an error and of a note; short shifts are those of filters and drives, and cost little."""
SMOOTH: Final = (0.03, 0.1, 0.3, 1.0)
"""Widths, relative to the RMS rate, over which friction may change its sign."""
WIDTHS: Final = (0.003, 0.01, 0.03)
"""Widths of play as shares of the joint's range."""
GOOD: Final = 0.5
"""Relative residual above which a joint is not explained well enough to be timed."""

WORTH: Final = 0.15
"""Share of the mean squared error in left-out parts of time from which a term is named."""
SMALL: Final = 0.05
"""Relative error of a joint below which nothing is worth a term."""
UNEXPLAINED: Final = 0.7
"""Relative error from which a joint's torque is not explained: half of its power."""
WIDTH: Final = 0.01
"""of the joint's range, for play and hysteresis."""
TRANSITION: Final = 0.05
"""rad/s, m/s, of Coulomb friction."""
EDITS: Final = {
    "armature": "--terms viscous,coulomb,offset,armature",
    "spring": "--terms viscous,coulomb,offset,spring",
    "play": "--choose play",
    "tanh": "--choose tanh",
    "load-dependent friction": "a feature of your own (--choose file:mine.py:Feature)",
}

SLOW: Final = 0.02
SHARE: Final = 0.02
"""rad/s, m/s, and share of the RMS rate, below which a joint stands still."""
MANY: Final = 0.5
SOME: Final = 0.05
ALL: Final = 0.99

TOUCHES: Final = 4
"""Times that a torque has to come down to zero without ever crossing it: where noise is as large as
what is left, by chance one in 2^4, and few torques come near zero so often and stay on one side."""
POOR: Final = 0.1
BETTER: Final = 0.5
"""Relative residual of a torque of one sign, and the share of it that is left where the signs of a
model are given to it: gravity that keeps a torque to one side explains it without them."""
SIGNINGS: Final = 8
"""Fits, each to the torque with the signs of the fit before."""

FAIR: Final = 0.25
"""Share of the directions of the links that the motion excites less than the model file knows
them: least squares is then worse than a feasible fit or one with a prior."""


@dataclass(frozen=True, eq=False)
class JointRows:
    """Rows of one recording: link columns and friction of each joint for its own torque."""

    evidence: DiagnoseInput

    @cached_property
    def rows(self) -> slice:
        """Samples in use among those of the evidence."""
        return slice(0, None, max(1, -(-len(self.evidence.motion) // SAMPLES)))

    @cached_property
    def motion(self) -> JointMotion:
        """Motion at these samples."""
        return self.evidence.motion.rows(self.rows)

    @cached_property
    def torque(self) -> Array:
        """Torque (N, n) at these samples."""
        return np.asarray(self.evidence.torque[self.rows])

    @cached_property
    def _regressor(self) -> Array:
        return self.evidence.regressor(self.motion)

    @cached_property
    def _links(self) -> Array:
        return np.asarray(self._regressor * self.evidence.link_std)

    @property
    def file_torque(self) -> Array:
        """Torque (N, n) of the links in the model file."""
        return np.asarray(self._regressor @ self.evidence.file_parameters.ravel())

    def friction(self, j: int) -> Array:
        """Columns (N, 3) of viscous and Coulomb friction and offset."""
        m = self.motion
        return np.column_stack([m.v[:, j], m.sign[:, j], np.ones(len(m))])

    def link_columns(self, j: int) -> Array:
        """Independent columns (N, r) of the links in the torque of joint j."""
        W = self._links[:, j]
        values, vectors = np.linalg.eigh(W.T @ W)
        kept = values > RIDGE * max(float(values[-1]), 1e-300)
        return np.asarray(W @ vectors[:, kept] / np.sqrt(values[kept]))

    def columns(self, j: int) -> Array:
        """Columns (N, r + 4) of the links, friction, offset and armature."""
        return np.column_stack([self.link_columns(j), self.friction(j), self.motion.a[:, j]])

    def left_out_error(self, X: Array, j: int) -> float:
        """Mean squared error of joint j's torque in parts of time that columns X (N, k) were not
        fitted to."""
        y = self.torque[:, j]
        # Parts of time, not single samples: neighbours have the same error of the model.
        folds = np.arange(len(y)) * FOLDS // len(y)
        size = np.linalg.norm(X, axis=0)
        Xs = X[:, size > 0] / size[size > 0]
        error = 0.0
        for fold in range(FOLDS):
            out = folds == fold
            A, b = Xs[~out], y[~out]
            H = A.T @ A + RIDGE * np.eye(Xs.shape[1])
            error += float(((y[out] - Xs[out] @ np.linalg.solve(H, A.T @ b)) ** 2).sum())
        return error / len(y)


def unsigned_torque(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield torques without sign: never negative, though they come down to zero again and again, or
    though the joint's own motion explains them with signs alone."""
    counts = np.array([touches(column) for column in evidence.raw.tau[:, evidence.columns].T])
    own = JointRows(evidence)
    # The sizes of all currents have touches enough together; a joint that rests on zero has many.
    every = bool((counts >= 0).all()) and evidence.count > 1 and int(counts.sum()) >= TOUCHES
    found = [
        every or count >= TOUCHES or (count >= 0 and evidence.rms[j] > 0 and _is_folded(own, j))
        for j, count in enumerate(counts.tolist())
    ]
    if any(found):
        names = evidence.names(np.array(found))
        whose = "all joints" if all(found) else ", ".join(names)
        yield Finding(
            "magnitude", ERROR,
            f"the torque of {whose} has no sign: it never crosses zero where the motion asks for "
            "it", names, blind="joints that gravity loads to one side",
            edit="tau = { columns = [...] }: torques or currents with their signs; where drives "
            "record none: tau = { pd = ... }, --task actuators",
        )  # fmt: skip


def _is_folded(own: JointRows, j: int) -> bool:
    """True where the torque of joint j is explained with the signs of its own model alone."""
    X, size = own.columns(j), np.abs(own.torque[:, j])
    Q = np.linalg.qr(X)[0]

    def error(y: Array) -> float:
        # A joint that nothing moves gives no sign at all.
        return float(np.linalg.norm(y - Q @ (Q.T @ y)) / np.linalg.norm(y)) if y.any() else np.inf

    before = error(own.torque[:, j])
    if before < POOR:
        return False
    # Friction, or the links of the model file, give the first signs.
    starts = own.motion.v[:, j], own.file_torque[:, j]
    for sign in map(np.sign, starts):
        for _ in range(SIGNINGS):
            sign = np.sign(Q @ (Q.T @ (sign * size)))
        if error(sign * size) < BETTER * before:
            return True
    return False


def torque_delay(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield joints whose torque fits their own motion better at another time: in both halves of
    the recording alike."""
    own = JointRows(evidence)
    step = max(1, round(LONGEST / LAGS * evidence.rate))
    most = min(LAGS, max(1, round(LONGEST * evidence.rate / step)))
    lags = step * np.arange(-most, most + 1)
    for j in np.flatnonzero(evidence.rms > 0):
        yield from _delay(own, int(j), lags)


def _delay(own: JointRows, j: int, lags: Array) -> Iterator[Finding]:
    """Yield the finding of a joint whose residual is smallest at one of the lags, in samples."""
    shifted, rows = own.evidence.torque_with_delay(j, lags, own.rows)
    X = np.column_stack([own.columns(j), _late_friction(own, j)])[rows]
    X = X / np.maximum(np.linalg.norm(X, axis=0), 1e-300)
    H = X.T @ X + 1e-9 * np.eye(X.shape[1])
    residual = np.asarray((shifted - X @ np.linalg.solve(H, X.T @ shifted)) ** 2)
    whole = residual.sum(axis=0)
    best, zero = int(np.argmin(whole)), len(lags) // 2
    explains = 1.0 - float(whole[best] / whole[zero]) if whole[zero] > 0 else 0.0
    delay = float(lags[best]) / own.evidence.rate
    size = float((shifted[:, zero] ** 2).sum())
    good = size > 0 and np.sqrt(whole[best] / size) < GOOD
    # A delay is the same all the time; friction that looks like one is not.
    halves = [int(np.argmin(part.sum(axis=0))) for part in np.array_split(residual, 2)]
    agree = max(abs(half - best) for half in halves) <= 1 + abs(best - zero) // 3
    interior = 0 < best < len(lags) - 1
    if explains < SURE or abs(delay) < SHORTEST or not (interior and good and agree):
        return
    name, milliseconds = own.evidence.joints[j], 1e3 * delay
    yield Finding(
        # Torques come late from buses and filters, and early from friction alone.
        "delay", ERROR if delay >= LONG else NOTE,
        f"the torque of {name} is {abs(milliseconds):.0f} ms {'late' if delay > 0 else 'early'}: a "
        f"shift explains {100 * explains:.0f} % of its residual",
        (name,), round(explains, 3), confidence=round(explains, 2),
        blind="all channels late alike, q and v included; joints that friction alone loads",
        edit=f"shift the torque of {name} by {-milliseconds:.0f} ms in the file",
    )  # fmt: skip


def _late_friction(own: JointRows, j: int) -> Array:
    """Columns (N, k) of play and smooth friction, which lag the sign of v: without them they would
    be delays."""
    q, v = own.motion.q[:, j], own.motion.v[:, j]
    scale, reach = float(np.sqrt((v**2).mean())) or 1.0, (float(q.min()), float(q.max()))
    smooth = [np.tanh(v / (width * scale)) for width in SMOOTH]
    return np.column_stack([*smooth, *(Play(width).values(q, v, reach) for width in WIDTHS)])


def joints_without_fit(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield joints whose torque, in parts of time left out of the fit, friction and offset explain
    as well as the whole model: a doubt where the model file explains little as well."""
    own = JointRows(evidence)
    near = first_hypothesis(evidence).fit.residual
    joints: list[int] = np.flatnonzero(evidence.rms > 0).tolist()
    alone = {j: own.left_out_error(own.friction(j), j) for j in joints}
    poor = [j for j in joints if own.left_out_error(own.columns(j), j) >= alone[j] > 0]
    unknown = [j for j in poor if min(np.sqrt(alone[j]) / evidence.rms[j], near[j]) > UNEXPLAINED]
    of_friction = [j for j in poor if j not in unknown]
    worse = [j for j in joints if near[j] > 1.0 and j not in unknown]
    zero = (
        "a robot near the model file explains the torque of {} worse than zero torque does "
        f"({100 * near.max():.0f} %)"
    )
    doubt = "neither the links nor friction explain the torque of {}"
    note = (
        "in parts of time left out of the fit, friction explains the torque of {} as well as "
        "the links do: this recording hardly holds their inertial parameters"
    )
    rows = (unknown, WARNING, doubt), (worse, WARNING, zero), (of_friction, NOTE, note)
    for found, severity, text in rows:
        if found:
            names = tuple(evidence.joints[j] for j in found)
            yield Finding(
                "unexplained", severity, text.format(", ".join(names)), names,
                edit="move these joints faster or with a payload; check their torque columns",
                blind="motions that repeat, of which a left-out part is known",
            )  # fmt: skip


def missing_terms(evidence: DiagnoseInput) -> list[Finding]:
    """Return for each joint the term that would explain most of what is left, ranked and never
    summed: terms overlap."""
    own = JointRows(evidence)
    found = [one for j in np.flatnonzero(evidence.rms > 0) for one in _best_term(own, int(j))]
    return sorted(found, key=lambda one: -(one.explains or 0))


def _best_term(own: JointRows, j: int) -> Iterator[Finding]:
    q, v, links = own.motion.q[:, j], own.motion.v[:, j], own.link_columns(j)
    reach = float(q.min()), float(q.max())
    model = links @ np.linalg.lstsq(links, own.torque[:, j], rcond=None)[0]
    columns = {
        "armature": own.motion.a[:, j],
        "spring": q,
        "load-dependent friction": np.abs(model) * np.sign(v),
        "play": Play(WIDTH).values(q, v, reach),
        "tanh": np.tanh(v / TRANSITION),
    }
    start = np.column_stack([links, own.friction(j)])
    # The terms of the manifest, or the default ones, may hold the inertia of the rotors.
    if "armature" in (own.evidence.robot.manifest.terms or DRIVE_TERMS):
        start = np.column_stack([start, columns.pop("armature")])
    before = own.left_out_error(start, j)
    if np.sqrt(before) < SMALL * own.evidence.rms[j]:
        return
    errors = {
        name: own.left_out_error(np.column_stack([start, column]), j)
        for name, column in columns.items()
    }
    term = min(errors, key=lambda name: errors[name])
    share, joint = 1.0 - errors[term] / before, own.evidence.joints[j]
    if share >= WORTH:
        text = (
            f"{term} would explain {100 * share:.0f} % of the residual of {joint} (parts of time "
            "left out of the fit)"
        )
        yield Finding(
            "terms", NOTE, text, (joint,), round(share, 3), confidence=0.5,
            blind="terms overlap: ranked, not summed", edit=EDITS[term],
        )  # fmt: skip


def model_inertia(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield a finding where the file's inertias are placeholders."""
    if evidence.placeholder:
        text = (
            f"the inertias of the model are placeholders ({evidence.placeholder}): gains, gravity "
            "and offsets are judged by friction and by the fit alone"
        )
        edit = "give the model its masses, or use no prior from it"
        yield Finding("inertias", WARNING, text, edit=edit)


def model_limits(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield joints whose torque limit is zero in the file, which means that none is stated."""
    names = evidence.names(evidence.robot.limits.tau[evidence.dofs] == 0)
    if names:
        text = f'effort="0" of {", ".join(names)} is read as no limit'
        edit = 'write the torque limits into the model (effort="...")'
        yield Finding("limits", NOTE, text, names, edit=edit)


def standstill(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield the share of the samples at which each joint stands still, where it is large: static
    friction then balances any torque."""
    v = evidence.motion.v
    limit = np.maximum(SLOW, SHARE * np.sqrt((v**2).mean(axis=0)))
    shares = (np.abs(v) < limit).mean(axis=0)
    many = np.flatnonzero(shares > SOME)
    if len(many):
        listed = ", ".join(f"{evidence.joints[j]} {100 * shares[j]:.0f} %" for j in many)
        severity = WARNING if float(np.median(shares)) > MANY else NOTE
        text, names = f"joints at rest: {listed} of the samples", evidence.names(many)
        edit = "--pipeline parallel leaves these rows out; compare torque_error_moving"
        if shares.min() > ALL:
            edit = "check the unit of time and of q: no joint moves faster than that in any part"
        yield Finding("standstill", severity, text, names, edit=edit)


def excitation(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield the number of directions of the links that the motion hardly excites."""
    # Along these directions the motion says less than one standard deviation of the prior.
    information = evidence.near_model.information
    weak = int((information < PENALTY**2).sum())
    if not evidence.placeholder and weak / max(len(information), 1) >= FAIR:
        text = (
            f"{weak} of {len(information)} combinations of the links' parameters are better "
            "known from the model file than from this motion"
        )
        edit = "--estimator lmi (feasible), or a method with a prior; design a motion: excite"
        blind = "good conditioning does not mean a small error"
        yield Finding("condition", NOTE, text, blind=blind, edit=edit)
