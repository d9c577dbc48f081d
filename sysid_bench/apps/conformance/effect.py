"""Conformance kit of plant effects: `prepare(robot)` gives a force law, a transmission or None.

A force law is a function (t, q, v) -> torque (..., nv) that the motors supply on top of the rigid
body dynamics, called sample by sample in closed loop and on whole motions in playback, or a law
with internal states (`simulation/plant.py`). Class attributes declare laws: `vanishes_at_rest =
True` zero torque at v = 0, `dissipates = True` that the plant's friction with the effect takes
energy from every joint over a closed cycle, `sizes` the settings that are zero without the effect.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.findings import (
    Finding,
    Kit,
    Laws,
    data_hash,
    first_error,
    motion_of_kit,
    robot_of_kit,
    shape_error,
    without_error,
)
from sysid_bench.errors import UnsupportedError
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.compiled_steps import KINDS, compiled_torque
from sysid_bench.simulation.elastic_drives import ElasticDrives
from sysid_bench.simulation.inverse import joint_positions, rigid_torque
from sysid_bench.simulation.plant import StateLaw, plant_of
from sysid_bench.simulation.tracking_control import TrackingControl
from sysid_bench.types import Array, Trajectory


@dataclass(frozen=True, eq=False)
class EffectMotion:
    """A robot and a periodic motion to evaluate force laws along."""

    name: str
    robot: RobotModel
    motion: Trajectory


@cache
def effect_cases() -> tuple[EffectMotion, ...]:
    """An arm and a random tree, along Fourier series."""
    cases = []
    for name in ("ur5", "random:7"):
        robot = robot_of_kit(name)
        cases.append(EffectMotion(name, robot, motion_of_kit(robot, 50.0)))
    return tuple(cases)


STEPS: Final = 4
"""Steps per sample of a motion."""

COMPILED: Final = 1e-12
"""Largest difference of a compiled law from the same in Python, over its largest torque."""


@dataclass(frozen=True, eq=False)
class _InPython:
    """A law without the `kind` by which it is compiled."""

    law: StateLaw

    def start(self, q: Array, v: Array) -> Array:
        return self.law.start(q, v)

    def step(
        self, state: Array, h: float, t: float, q: Array, v: Array, load: Array
    ) -> tuple[Array, Array]:
        return self.law.step(state, h, t, q, v, load)


def _signals(case: EffectMotion) -> tuple[Array, Array, Array]:
    """Positions, rates and load (N, nv) along the case's motion."""
    motion, armature = case.motion, case.robot.joint_terms.armature
    load = rigid_torque(plant_of(case.robot).contact_free_model, motion) - armature * motion.a
    return joint_positions(case.robot, motion), motion.v.copy(), load


def torque_along(case: EffectMotion, law: StateLaw) -> Array:
    """Return the torque (N, nv) of a law along the motion of a case."""
    return compiled_torque([law], case.motion.t, *_signals(case), STEPS)


def _steps_are_finite(effect: Any, case: EffectMotion, law: StateLaw) -> str | None:
    """Torque (nv,) and states of the length at the start of a step, finite along a motion."""
    q, v, load = (x[0] for x in _signals(case))
    start = np.asarray(law.start(q, v))
    torque, state = law.step(start.copy(), 1e-3, 0.0, q, v, load)
    one_step = (
        ("its torque", np.asarray(torque), v.shape), ("its states", np.asarray(state), start.shape),
    )  # fmt: skip
    wrong = first_error(shape_error(*one) for one in one_step)
    if wrong is not None:
        return wrong
    return shape_error("its torque", torque_along(case, _InPython(law)), case.motion.v.shape)


def _keeps_no_state_of_its_own(effect: Any, case: EffectMotion, law: StateLaw) -> str | None:
    """A step from the same states gives the same torque, and leaves its arguments alone."""
    q, v, _ = (x[0] for x in _signals(case))
    state = np.array(law.start(q, v))
    signals = tuple(x[len(x) // 3] for x in _signals(case))
    before = data_hash((state, signals))
    first, again = (law.step(state, 1e-3, 0.0, *signals) for _ in range(2))
    if data_hash((state, signals)) != before:
        return "a step changed its arguments; return the next states"
    return None if data_hash(first) == data_hash(again) else "two steps from one state differ"


def _states_are_deterministic(effect: Any, case: EffectMotion, law: StateLaw) -> str | None:
    if np.array_equal(torque_along(case, law), torque_along(case, effect.prepare(case.robot))):
        return None
    return "prepared twice it gives two torques: draw random numbers from a seed of its own"


def _is_compiled_as_in_python(effect: Any, case: EffectMotion, law: StateLaw) -> str | None:
    if getattr(law, "kind", None) not in KINDS:
        return None
    python = torque_along(case, _InPython(law))
    error = float(np.abs(torque_along(case, law) - python).max())
    if error <= COMPILED * max(float(np.abs(python).max()), 1.0):
        return None
    return f"compiled and in Python its torques differ by {error:.3g} N m or N"


def _has_no_torque_at_rest(effect: Any, case: EffectMotion, law: StateLaw) -> str | None:
    """Zero torque of a joint that has not moved, where the effect declares it."""
    if not getattr(effect, "vanishes_at_rest", False):
        return None
    q, v, load = _signals(case)
    still = np.zeros_like(v)
    torque = compiled_torque(
        [law], case.motion.t, np.broadcast_to(q[0], q.shape), still, load, STEPS
    )
    largest = float(np.abs(torque).max())
    return None if largest == 0.0 else f"its torque at rest is up to {largest:.3g} N m or N"


STATE_LAWS: Final[Laws] = {
    "gives finite torques": _steps_are_finite,
    "keeps no state of its own": _keeps_no_state_of_its_own,
    "is deterministic": _states_are_deterministic,
    "is compiled as in Python": _is_compiled_as_in_python,
    "vanishes at rest where declared": _has_no_torque_at_rest,
}


def _tracked(effect: Any, case: EffectMotion) -> Array | None:
    """Torque (N, n) of a tenth of a second in closed loop; None for robots without one."""
    whole = motion_of_kit(case.robot, 1000.0)
    short = Trajectory(whole.t[:100], whole.q[:100], whole.v[:100], whole.a[:100])
    still = np.zeros((len(short), len(case.robot.torque_dofs)))
    try:
        return TrackingControl().run(plant_of(case.robot, [effect]), short, still)[0].tau
    except UnsupportedError:
        return None


def _moves_alike_twice(effect: Any, case: EffectMotion, law: Any) -> str | None:
    """Finite signals in closed loop, the same in the next call."""
    first, again = _tracked(effect, case), _tracked(effect, case)
    if first is None or again is None:
        return None
    if not np.array_equal(first, again):
        return "its torque in closed loop differs from call to call"
    return shape_error("its torque", first, (len(first), len(case.robot.torque_dofs)))


TRANSMISSION_LAWS: Final[Laws] = {"moves alike twice in closed loop": _moves_alike_twice}


PREPARED: Final = "prepares a force law"

INJECTED: Final = 1e-3
"""Largest energy that friction may give a joint over a cycle, over the sum of |tau v|: the error of
sums over samples."""

TorqueLaw = Callable[[Array, Array, Array], Array]


def check_effect(effect: Any) -> list[Finding]:
    """Findings of all laws on `effect_cases`; an effect that prepares None adds no torque and has
    no law to keep."""
    return _EFFECT_KIT.findings(effect, effect_cases())


def _effect_laws(case: EffectMotion, law: Any) -> Iterator[Laws]:
    """Laws for what an effect prepares."""
    yield {PREPARED: _is_a_law}
    if isinstance(law, ElasticDrives):
        yield TRANSMISSION_LAWS
    elif law is not None:
        yield {**(STATE_LAWS if isinstance(law, StateLaw) else FORCE_LAWS), **LAWS_OF_ALL}


def _is_a_law(effect: Any, case: EffectMotion, law: Any) -> str | None:
    known = law is None or isinstance(law, (ElasticDrives, StateLaw)) or callable(law)
    return None if known else f"it is a {type(law).__name__}"


def _effect_input(case: EffectMotion) -> Any:
    model = case.robot.mj
    arrays = (model.body_mass, model.body_inertia, model.dof_damping, model.dof_frictionloss)
    return case.motion, case.robot.phi, case.robot.joint_terms, arrays


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
    # The motion and its repetition; one period has no sample at its end.
    t = case.motion.t[:1] + (case.motion.t[1] - case.motion.t[0]) * np.arange(2 * len(case.motion))
    q, v, a = (np.concatenate([x, x]) for x in (case.motion.q, case.motion.v, case.motion.a))
    motion = Trajectory(t, q, v, a)
    power = (_friction(case, motion, [effect]) * motion.v)[len(case.motion) :]
    injected = -power.sum(axis=0) / np.maximum(np.abs(power).sum(axis=0), 1e-12)
    worst = int(np.argmax(injected))
    if injected[worst] <= INJECTED:
        return None
    return f"friction drives {case.robot.rows[worst]} over a closed cycle"


def _vanishes_at_size_zero(effect: Any, case: EffectMotion, law: Any) -> str | None:
    """Torques bit for bit those without the effect where its `sizes` are zero."""
    if not getattr(effect, "sizes", ()):
        return None
    without = _friction(case, case.motion, [without_error(effect)])
    if np.array_equal(without, _friction(case, case.motion, [])):
        return None
    return "with its sizes zero, torques are not bit for bit those without it"


FORCE_LAWS: Final[Laws] = {
    "gives finite torques": _is_finite,
    "is the same sample by sample": _is_the_same_sample_by_sample,
    "is deterministic": _is_deterministic,
    "vanishes at rest where declared": _vanishes_at_rest,
}

LAWS_OF_ALL: Final[Laws] = {
    "dissipates where declared": _dissipates,
    "vanishes at size zero": _vanishes_at_size_zero,
}
"""Laws of functions and of laws with states."""

_EFFECT_KIT: Final = Kit(
    runs=PREPARED,
    run=lambda effect, case: effect.prepare(case.robot),
    laws=_effect_laws,
    given=_effect_input,
    changed="it changed the robot or the motion",
)
