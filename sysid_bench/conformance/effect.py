"""Conformance kit of plant effects: `prepare(robot)` gives a force law or None.

A force law is a function (t, q, v) -> torque (..., nv) that the motors supply on top of the rigid
body dynamics. The closed loop calls it sample by sample, the inverse simulation on whole motions.
An effect with the class attribute `vanishes_at_rest = True` declares zero torque at v = 0.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np

from sysid_bench.conformance.findings import (
    UNCHANGED,
    Finding,
    data_hash,
    finding_of_error,
    findings_of,
    first_error,
    shape_error,
)
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.fourier import Fourier
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, Trajectory

PREPARED: Final = "prepares a force law"

ForceLaw = Callable[[Array, Array, Array], Array]


@dataclass(frozen=True, eq=False)
class EffectCase:
    """A robot and a motion to evaluate force laws along."""

    name: str
    robot: RobotModel
    motion: Trajectory


Law = Callable[[Any, EffectCase, ForceLaw], str | None]
"""(effect, case, its force law) -> description of the violation, or None."""


@cache
def effect_cases() -> tuple[EffectCase, ...]:
    """An arm and a random tree, along Fourier series."""
    cases = []
    for name in ("ur5", "random:7"):
        robot = loaded_robot(name, "none", None, None).robot
        motion = Fourier(period=2.0, cycles=1).design(
            design_problem(robot, 50.0), np.random.default_rng(1)
        )
        cases.append(EffectCase(name, robot, motion))
    return tuple(cases)


def check_effect(effect: Any, cases: Sequence[EffectCase] | None = None) -> list[Finding]:
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


def _findings_on(effect: Any, case: EffectCase) -> list[Finding]:
    try:
        law = effect.prepare(case.robot)
    except Exception as error:
        return [finding_of_error(error, PREPARED, case.name)]
    if law is None:
        return [Finding(PREPARED, case.name, True)]
    if not callable(law):
        return [Finding(PREPARED, case.name, False, f"it is a {type(law).__name__}")]
    findings = findings_of(LAWS, case.name, effect, case, law)
    return [Finding(PREPARED, case.name, True), *findings]


def _state(case: EffectCase) -> str:
    model = case.robot.mj
    arrays = (model.body_mass, model.body_inertia, model.dof_damping, model.dof_frictionloss)
    return data_hash((case.motion, case.robot.phi, case.robot.joint_terms, *map(np.array, arrays)))


def _torque(law: ForceLaw, motion: Trajectory) -> Array:
    return np.asarray(law(motion.t, motion.q.copy(), motion.v.copy()))


def _is_finite(effect: Any, case: EffectCase, law: ForceLaw) -> str | None:
    """Torque (N, nv) of a motion, and (nv,) of one sample, finite."""
    motion, expected = case.motion, case.motion.v.shape
    one = np.asarray(law(motion.t[0], motion.q[0], motion.v[0]))
    torques = ((_torque(law, motion), expected), (one, expected[1:]))
    return first_error(shape_error("its torque", torque, shape) for torque, shape in torques)


def _is_the_same_sample_by_sample(effect: Any, case: EffectCase, law: ForceLaw) -> str | None:
    motion, whole = case.motion, _torque(law, case.motion)
    # A call for one sample costs nearly as much as for the whole motion.
    for k in range(0, len(motion), 10):
        one = np.asarray(law(motion.t[k], motion.q[k], motion.v[k]))
        # Not bit by bit: sums over a whole array are rounded in another order.
        if np.abs(one - whole[k]).max() > 1e-9 * np.abs(whole).max():
            return f"sample {k} alone gives another torque than within the whole motion"
    return None


def _is_deterministic(effect: Any, case: EffectCase, law: ForceLaw) -> str | None:
    """The law called twice, and the law prepared twice, give the same torque."""
    torque = _torque(law, case.motion)
    if not np.array_equal(torque, _torque(law, case.motion)):
        return "the same motion gives another torque in the next call: a force law has no memory"
    if not np.array_equal(torque, _torque(effect.prepare(case.robot), case.motion)):
        return "prepared twice it gives two torques: draw random numbers from a seed of its own"
    return None


def _vanishes_at_rest(effect: Any, case: EffectCase, law: ForceLaw) -> str | None:
    """Zero torque at v = 0 where the effect declares it."""
    if not getattr(effect, "vanishes_at_rest", False):
        return None
    motion = case.motion
    torque = np.asarray(law(motion.t, motion.q, np.zeros_like(motion.v)))
    largest = float(np.abs(torque).max())
    return None if largest == 0.0 else f"its torque at rest is up to {largest:.3g} N m or N"


LAWS: Final[dict[str, Law]] = {
    "gives finite torques": _is_finite,
    "is the same sample by sample": _is_the_same_sample_by_sample,
    "is deterministic": _is_deterministic,
    "vanishes at rest where declared": _vanishes_at_rest,
}
