"""Terms that the model of the fit lacks, and joints that no model explains."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import NOTE, WARNING, Finding
from sysid_bench.diagnosis.hypothesis import first_hypothesis
from sysid_bench.diagnosis.joint_rows import JointRows
from sysid_bench.models.manifest import DRIVE_TERMS
from sysid_bench.regressors.joint_features import Play
from sysid_bench.types import Array

WORTH: Final = 0.15
"""Share of the mean squared error in left-out parts of time from which a term is named."""
SMALL: Final = 0.05
"""Relative error of a joint below which nothing is worth a term."""
UNEXPLAINED: Final = 0.7
"""Relative error from which a joint's torque is not explained: half of its power."""
WIDTH: Final = 0.01
"""of the joint's range, for play and hysteresis."""
SMOOTH: Final = 0.05
"""rad/s, m/s, of the transition of Coulomb friction."""


def missing_terms(evidence: DiagnoseInput) -> list[Finding]:
    """Return for each joint the term that would explain most of what is left, ranked and never
    summed: terms overlap."""
    own = JointRows(evidence)
    best = [_best_term(own, j) for j in range(evidence.count) if evidence.rms[j] > 0]
    return sorted((one for one in best if one is not None), key=lambda one: -(one.explains or 0))


def joints_without_fit(evidence: DiagnoseInput) -> list[Finding]:
    """Return joints whose torque, in parts of time left out of the fit, friction and offset explain
    as well as the whole model: a doubt where the model file explains little as well."""
    own = JointRows(evidence)
    near = first_hypothesis(evidence).fit.residual
    joints = [j for j in range(evidence.count) if evidence.rms[j] > 0]
    alone = {j: own.left_out_error(own.friction(j), j) for j in joints}
    poor = [j for j in joints if own.left_out_error(own.columns(j), j) >= alone[j] > 0]
    unknown = [j for j in poor if min(np.sqrt(alone[j]) / evidence.rms[j], near[j]) > UNEXPLAINED]
    of_friction = [j for j in poor if j not in unknown]
    found = [_finding_of(evidence, unknown, WARNING), _finding_of(evidence, of_friction, NOTE)]
    return [finding for finding in found if finding.joints]


NOT_EXPLAINED: Final = {
    WARNING: "neither the links nor friction explain the torque of {}",
    NOTE: "in parts of time left out of the fit, friction explains the torque of {} as well as "
    "the links do: this recording hardly holds their inertial parameters",
}


def _finding_of(evidence: DiagnoseInput, joints: list[int], severity: str) -> Finding:
    names = tuple(evidence.joints[j] for j in joints)
    return Finding(
        name="unexplained",
        severity=severity,
        message=NOT_EXPLAINED[severity].format(", ".join(names)),
        joints=names,
        edit="move these joints faster or with a payload; check their torque columns",
        blind="motions that repeat, of which a left-out part is known",
    )


def _best_term(own: JointRows, j: int) -> Finding | None:
    start = np.column_stack([own.link_columns(j), own.friction(j)])
    if _has_armature(own.evidence):
        start = own.columns(j)
    before = own.left_out_error(start, j)
    if np.sqrt(before) < SMALL * own.evidence.rms[j]:
        return None
    errors = {
        name: own.left_out_error(np.column_stack([start, column]), j)
        for name, column in _candidates(own, j)
    }
    name = min(errors, key=lambda key: errors[key])
    share = 1.0 - errors[name] / before
    return _finding(own.evidence, j, name, share) if share >= WORTH else None


def _has_armature(evidence: DiagnoseInput) -> bool:
    """True if the terms of the manifest, or the default ones, hold the inertia of the rotors."""
    return "armature" in (evidence.robot.manifest.terms or DRIVE_TERMS)


def _candidates(own: JointRows, j: int) -> Iterator[tuple[str, Array]]:
    m = own.motion
    q, v = m.q[:, j], m.v[:, j]
    if not _has_armature(own.evidence):
        yield "armature", m.a[:, j]
    yield "spring", q
    model = np.linalg.lstsq(own.link_columns(j), own.torque[:, j], rcond=None)[0]
    yield "load-dependent friction", np.abs(own.link_columns(j) @ model) * np.sign(v)
    play = Play(WIDTH)
    yield "play", play.values(q, v, (float(q.min()), float(q.max())))
    yield "tanh", np.tanh(v / SMOOTH)


EDITS: Final = {
    "armature": "--terms viscous,coulomb,offset,armature",
    "spring": "--terms viscous,coulomb,offset,spring",
    "play": "--choose play",
    "tanh": "--choose tanh",
    "load-dependent friction": "a feature of your own (--choose file:mine.py:Feature)",
}


def _finding(evidence: DiagnoseInput, j: int, term: str, share: float) -> Finding:
    return Finding(
        name="terms",
        severity=NOTE,
        message=(
            f"{term} would explain {100 * share:.0f} % of the residual of {evidence.joints[j]} "
            "(parts of time left out of the fit)"
        ),
        joints=(evidence.joints[j],),
        explains=round(share, 3),
        confidence=0.5,
        blind="terms overlap: ranked, not summed",
        edit=EDITS[term],
    )
