"""Unit of positions: degrees for radians and millimetres for metres, or the reverse."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.hypothesis import Candidate, Hypothesis
from sysid_bench.signals.log_units import UNITS
from sysid_bench.types import Array

TRIED: Final = {"hinge": ("rad", "deg"), "slide": ("m", "mm")}
MOST: Final = 1.5
"""Range and speed of the motion in another unit, relative to the limits of the joint, above which
it is none."""
BLIND: Final = "balanced joints; slides parallel to gravity and vertical axes that move slowly"


def position_unit(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates with the positions of all hinges, or of all slides, in another unit.

    A log with a transmission gets none: its units are those of motors.
    """
    e = before.evidence
    if e.log.description.transmission is not None:
        return
    stated = _units(e)
    for kind, units in TRIED.items():
        for unit in units:
            joints = [j for j in range(e.count) if e.kinds[j] == kind and stated[j] != unit]
            if joints:
                yield from _restated(before, joints, stated, unit)


def _units(e: DiagnoseInput) -> list[str]:
    """Stated units (n,) of the positions; the first one of its kind where there is none."""
    log = e.log.description
    given = log.q.unit or tuple(TRIED[kind][0] for kind in e.kinds)
    if len(given) == 1:
        return list(given) * e.count
    return list(given) if log.q.unit is None else [given[k] for k in e.columns]


def _restated(
    before: Hypothesis, joints: list[int], stated: list[str], unit: str
) -> Iterator[Candidate]:
    e = before.evidence
    log, motion = e.log.description, before.motion
    factors = np.ones(e.count)
    for j in joints:
        scale = UNITS["q"][e.kinds[j]]
        factors[j] = scale[unit] / scale[stated[j]]
    offset = log.joint_values("q.offset", log.q.offset)[e.columns]
    restated = motion.scaled(factors).with_offset((1 - factors) * offset)
    if not _possible(e, restated.q[:, joints], restated.v[:, joints], joints):
        return
    names = ", ".join(e.joints[j] for j in joints)
    was = " or ".join(dict.fromkeys(stated[j] for j in joints))
    yield Candidate(
        name="units",
        joints=tuple(joints),
        hypothesis=before.with_motion(restated),
        message=f"positions of {names} fit {unit}, not {was}",
        edit="; ".join(_edit(e, joints, unit)),
        blind=BLIND,
    )


def _possible(e: DiagnoseInput, q: Array, v: Array, joints: list[int]) -> bool:
    """True where positions and rates (N, k) of some joints lie in the reach of the robot."""
    limits, dofs = e.robot.limits, e.dofs[joints]
    reach = limits.q_high[dofs] - limits.q_low[dofs]
    within = np.ptp(q, axis=0) <= MOST * reach
    return bool((within & (np.abs(v).max(axis=0) <= MOST * limits.v[dofs])).all())


def _edit(e: DiagnoseInput, joints: list[int], unit: str) -> Iterator[str]:
    """Yield the edits of q, and of v where the log has it."""
    log = e.log.description
    for name, text in (("q", unit), ("v", f"{unit}/s")):
        if name not in log.signals:
            continue
        if len(joints) == len(log.joints):
            yield f'{name} = {{ unit = "{text}" }}'
        else:
            yield f'{name}.unit of {", ".join(e.joints[j] for j in joints)}: "{text}"'
