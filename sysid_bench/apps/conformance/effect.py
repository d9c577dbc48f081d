"""Conformance kit of plant effects: `prepare(robot)` gives a force law, a transmission or None.

A force law is a function (t, q, v) -> torque (..., nv) that the motors supply on top of the rigid
body dynamics, called sample by sample in closed loop and on whole motions in playback, or a law
with internal states (`state_law_checks.py`). Class attributes declare laws: `vanishes_at_rest =
True` zero torque at v = 0, `dissipates = True` that the plant's friction with the effect takes
energy from every joint over a closed cycle, `sizes` the settings that are zero without the effect.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.effect_cases import EffectMotion, Law, effect_cases
from sysid_bench.apps.conformance.findings import (
    UNCHANGED,
    Finding,
    data_hash,
    finding_of_error,
    findings_of,
    first_error,
    shape_error,
)
from sysid_bench.apps.conformance.state_law_checks import (
    STATE_LAWS,
    TRANSMISSION_LAWS,
    torque_along,
)
from sysid_bench.apps.conformance.without_error import without_error
from sysid_bench.simulation.elastic_drives import ElasticDrives
from sysid_bench.simulation.plant import StateLaw, plant_of
from sysid_bench.types import Array, Trajectory

PREPARED: Final = "prepares a force law"

INJECTED: Final = 1e-3
"""Largest energy that friction may give a joint over a cycle, over the sum of |tau v|: the error of
sums over samples."""

TorqueLaw = Callable[[Array, Array, Array], Array]


def check_effect(effect: Any, cases: Sequence[EffectMotion] | None = None) -> list[Finding]:
    """Findings of all laws on all cases (None: `effect_cases`); an effect that prepares None adds
    no torque and has no law to keep."""
    findings = []
    for case in effect_cases() if cases is None else cases:
        before = _state(case)
        findings += _findings_on(effect, case)
        if _state(case) != before:
            message = "it changed the robot or the motion"
            findings.append(Finding(UNCHANGED, case.name, False, message))
    return findings


def _findings_on(effect: Any, case: EffectMotion) -> list[Finding]:
    try:
        law = effect.prepare(case.robot)
    except Exception as error:
        return [finding_of_error(error, PREPARED, case.name)]
    if law is None:
        return [Finding(PREPARED, case.name, True)]
    laws = _laws_for(law)
    if laws is None:
        return [Finding(PREPARED, case.name, False, f"it is a {type(law).__name__}")]
    findings = findings_of(laws, case.name, effect, case, law)
    return [Finding(PREPARED, case.name, True), *findings]


def _laws_for(law: Any) -> Mapping[str, Law] | None:
    """Laws for what an effect prepares; None for something else."""
    if isinstance(law, ElasticDrives):
        return TRANSMISSION_LAWS
    if isinstance(law, StateLaw):
        return {**STATE_LAWS, **LAWS_OF_ALL}
    return {**LAWS, **LAWS_OF_ALL} if callable(law) else None


def _state(case: EffectMotion) -> str:
    model = case.robot.mj
    arrays = (model.body_mass, model.body_inertia, model.dof_damping, model.dof_frictionloss)
    return data_hash((case.motion, case.robot.phi, case.robot.joint_terms, *map(np.array, arrays)))


def _torque(law: TorqueLaw, motion: Trajectory) -> Array:
    return np.asarray(law(motion.t, motion.q.copy(), motion.v.copy()))


def _is_finite(effect: Any, case: EffectMotion, law: TorqueLaw) -> str | None:
    """Torque (N, nv) of a motion, and (nv,) of one sample, finite."""
    motion, expected = case.motion, case.motion.v.shape
    one = np.asarray(law(motion.t[0], motion.q[0], motion.v[0]))
    torques = ((_torque(law, motion), expected), (one, expected[1:]))
    return first_error(shape_error("its torque", torque, shape) for torque, shape in torques)


def _is_the_same_sample_by_sample(effect: Any, case: EffectMotion, law: TorqueLaw) -> str | None:
    motion, whole = case.motion, _torque(law, case.motion)
    # A call for one sample costs nearly as much as for the whole motion.
    for k in range(0, len(motion), 10):
        one = np.asarray(law(motion.t[k], motion.q[k], motion.v[k]))
        # Not bit by bit: sums over a whole array are rounded in another order.
        if np.abs(one - whole[k]).max() > 1e-9 * np.abs(whole).max():
            return f"sample {k} alone gives another torque than within the whole motion"
    return None


def _is_deterministic(effect: Any, case: EffectMotion, law: TorqueLaw) -> str | None:
    """The law called twice, and the law prepared twice, give the same torque."""
    torque = _torque(law, case.motion)
    if not np.array_equal(torque, _torque(law, case.motion)):
        return "the same motion gives another torque in the next call: a force law has no memory"
    if not np.array_equal(torque, _torque(effect.prepare(case.robot), case.motion)):
        return "prepared twice it gives two torques: draw random numbers from a seed of its own"
    return None


def _vanishes_at_rest(effect: Any, case: EffectMotion, law: TorqueLaw) -> str | None:
    """Zero torque at v = 0 where the effect declares it."""
    if not getattr(effect, "vanishes_at_rest", False):
        return None
    motion = case.motion
    torque = np.asarray(law(motion.t, motion.q, np.zeros_like(motion.v)))
    largest = float(np.abs(torque).max())
    return None if largest == 0.0 else f"its torque at rest is up to {largest:.3g} N m or N"


def _friction(case: EffectMotion, motion: Trajectory, effects: Sequence[Any]) -> Array:
    """Torque (N, nv) of the friction terms and force laws of a plant along a motion."""
    plant = plant_of(case.robot, effects)
    terms, v = plant.terms, motion.v
    total = terms.viscous * v + terms.coulomb * np.sign(v)
    for law in plant.laws:
        if isinstance(law, StateLaw):
            total = total + torque_along(replace(case, motion=motion), law)
        else:
            total = total + _torque(law, motion)
    return np.asarray(total)


def _dissipates(effect: Any, case: EffectMotion, law: Any) -> str | None:
    """Friction with the effect takes energy from each joint in the second of two cycles."""
    if not getattr(effect, "dissipates", False):
        return None
    motion = _twice(case.motion)
    power = (_friction(case, motion, [effect]) * motion.v)[len(case.motion) :]
    injected = -power.sum(axis=0) / np.maximum(np.abs(power).sum(axis=0), 1e-12)
    worst = int(np.argmax(injected))
    if injected[worst] <= INJECTED:
        return None
    return f"friction drives {case.robot.rows[worst]} over a closed cycle"


def _twice(motion: Trajectory) -> Trajectory:
    """The motion and its repetition; one period has no sample at its end."""
    t = motion.t[:1] + (motion.t[1] - motion.t[0]) * np.arange(2 * len(motion))
    q, v, a = (np.concatenate([x, x]) for x in (motion.q, motion.v, motion.a))
    return Trajectory(t, q, v, a)


def _vanishes_at_size_zero(effect: Any, case: EffectMotion, law: Any) -> str | None:
    """Torques bit for bit those without the effect where its `sizes` are zero."""
    if not getattr(effect, "sizes", ()):
        return None
    without = _friction(case, case.motion, [without_error(effect)])
    if np.array_equal(without, _friction(case, case.motion, [])):
        return None
    return "with its sizes zero, torques are not bit for bit those without it"


LAWS: Final[dict[str, Law]] = {
    "gives finite torques": _is_finite,
    "is the same sample by sample": _is_the_same_sample_by_sample,
    "is deterministic": _is_deterministic,
    "vanishes at rest where declared": _vanishes_at_rest,
}

LAWS_OF_ALL: Final[dict[str, Law]] = {
    "dissipates where declared": _dissipates,
    "vanishes at size zero": _vanishes_at_size_zero,
}
"""Laws of functions and of laws with states."""
