"""Conformance laws of force laws with internal states, and of elastic transmissions.

A force law with states has `start(q, v) -> states` and `step(states, h, t, q, v, load) -> (torque,
states)`, see `simulation/plant.py`.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.effect_cases import EffectMotion, Law
from sysid_bench.apps.conformance.findings import data_hash, first_error, shape_error
from sysid_bench.errors import UnsupportedError
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import Fourier
from sysid_bench.simulation.compiled_steps import KINDS, compiled_torque
from sysid_bench.simulation.inverse import joint_positions, rigid_torque
from sysid_bench.simulation.plant import StateLaw, plant_of
from sysid_bench.simulation.tracking_control import TrackingControl
from sysid_bench.types import Array, Trajectory

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


def _is_finite(effect: Any, case: EffectMotion, law: StateLaw) -> str | None:
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


def _is_deterministic(effect: Any, case: EffectMotion, law: StateLaw) -> str | None:
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


def _vanishes_at_rest(effect: Any, case: EffectMotion, law: StateLaw) -> str | None:
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


STATE_LAWS: Final[dict[str, Law]] = {
    "gives finite torques": _is_finite,
    "keeps no state of its own": _keeps_no_state_of_its_own,
    "is deterministic": _is_deterministic,
    "is compiled as in Python": _is_compiled_as_in_python,
    "vanishes at rest where declared": _vanishes_at_rest,
}


def _tracked(effect: Any, case: EffectMotion) -> Array | None:
    """Torque (N, n) of a tenth of a second in closed loop; None for robots without one."""
    problem = design_problem(case.robot, 1000.0)
    whole = Fourier(period=2.0, cycles=1).design(problem, np.random.default_rng(1))
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


TRANSMISSION_LAWS: Final[dict[str, Law]] = {"moves alike twice in closed loop": _moves_alike_twice}
