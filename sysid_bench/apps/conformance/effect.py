"""Conformance kit of plant effects: `prepare(robot)` gives a force law, a transmission or None.

A force law is a function (t, q, v) -> torque (..., nv) that the motors supply on top of the rigid
body dynamics, called sample by sample in closed loop and on whole motions in playback, or a law
with internal states (`simulation/plant.py`). Class attributes declare laws: `vanishes_at_rest =
True` zero torque at v = 0, `dissipates = True` that the plant's friction with the effect takes
energy from every joint over a closed cycle, `sizes` the settings that are zero without the effect.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.findings import (
    Finding,
    Kit,
    Law,
    RobotMotion,
    data_hash,
    first_error,
    motion_of_kit,
    robots_in_motion,
    shape_error,
    without_error,
)
from sysid_bench.errors import UnsupportedError
from sysid_bench.simulation.compiled_steps import KINDS, compiled_torque
from sysid_bench.simulation.elastic_drives import ElasticDrives
from sysid_bench.simulation.inverse import joint_positions, rigid_torque
from sysid_bench.simulation.plant import StateLaw, plant_of
from sysid_bench.simulation.tracking_control import TrackingControl
from sysid_bench.types import Array, Trajectory

STEPS: Final = 4
"""Steps per sample of a motion."""

COMPILED: Final = 1e-12
"""Largest difference of a compiled law from the same in Python, over its largest torque."""

INJECTED: Final = 1e-3
"""Largest energy that friction may give a joint over a cycle, over the sum of |tau v|: the error of
sums over samples."""


def effect_cases() -> tuple[RobotMotion, ...]:
    """An arm and a random tree, along Fourier series."""
    return robots_in_motion(("ur5", "none"), ("random:7", "none"))


def check_effect(effect: Any) -> list[Finding]:
    """Findings of all laws on `effect_cases`; an effect that prepares None adds no torque and has
    no law to keep."""
    return _EffectKit.check(effect, effect_cases())


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


def _signals(case: RobotMotion) -> tuple[Array, Array, Array]:
    """Positions, rates and load (N, nv) along the case's motion."""
    motion, armature = case.motion, case.robot.joint_terms.armature
    load = rigid_torque(plant_of(case.robot).contact_free_model, motion) - armature * motion.a
    return joint_positions(case.robot, motion), motion.v.copy(), load


def _torque(case: RobotMotion, law: Any) -> Array:
    """Torque (N, nv) of a law along the motion of a case."""
    motion = case.motion
    if isinstance(law, StateLaw):
        return compiled_torque([law], motion.t, *_signals(case), STEPS)
    return np.asarray(law(motion.t, motion.q.copy(), motion.v.copy()))


def _friction(case: RobotMotion, effects: Sequence[Any]) -> Array:
    """Torque (N, nv) of the friction terms and force laws of a plant along a motion."""
    plant, v = plant_of(case.robot, effects), case.motion.v
    total = plant.terms.viscous * v + plant.terms.coulomb * np.sign(v)
    return np.asarray(sum((_torque(case, law) for law in plant.laws), start=total))


class _EffectKit(Kit[RobotMotion]):
    runs = "prepares a force law"
    changed = "it changed the robot or the motion"

    def run(self) -> Any:
        return self.plugin.prepare(self.case.robot)

    def kind(self) -> str:
        if isinstance(self.result, ElasticDrives):
            return "transmission"
        if isinstance(self.result, StateLaw):
            return "states"
        return "function" if callable(self.result) else "other"

    def given(self) -> Any:
        robot, model = self.case.robot, self.case.robot.mj
        arrays = (model.body_mass, model.body_inertia, model.dof_damping, model.dof_frictionloss)
        return self.case.motion, robot.phi, robot.joint_terms, arrays

    @Law(runs, first=True)
    def is_law(self) -> str | None:
        known = self.result is None or self.kind() != "other"
        return None if known else f"it is a {type(self.result).__name__}"

    @Law("moves alike twice in closed loop", of=("transmission",))
    def moves(self) -> str | None:
        """Finite signals in closed loop, the same in the next call."""
        first, again = self._tracked(), self._tracked()
        # No controller for this robot: nothing to compare.
        if first is None or again is None:
            return None
        if not np.array_equal(first, again):
            return "its torque in closed loop differs from call to call"
        return shape_error("its torque", first, (len(first), len(self.case.robot.torque_dofs)))

    def _tracked(self) -> Array | None:
        """Torque (N, n) of a tenth of a second in closed loop; None for robots without one."""
        robot, whole = self.case.robot, motion_of_kit(self.case.robot, 1000.0)
        short = Trajectory(whole.t[:100], whole.q[:100], whole.v[:100], whole.a[:100])
        # Exact encoders: the law is about the plant.
        still = np.zeros((len(short), len(robot.torque_dofs)))
        try:
            return TrackingControl().run(plant_of(robot, [self.plugin]), short, still)[0].tau
        except UnsupportedError:
            return None

    @Law("gives finite torques", of=("function",))
    def finite(self) -> str | None:
        """Torque (N, nv) of a motion, and (nv,) of one sample, finite."""
        motion, shape = self.case.motion, self.case.motion.v.shape
        one = np.asarray(self.result(motion.t[0], motion.q[0], motion.v[0]))
        torques = ((_torque(self.case, self.result), shape), (one, shape[1:]))
        return first_error(shape_error("its torque", torque, shape) for torque, shape in torques)

    @Law("is the same sample by sample", of=("function",))
    def single_samples(self) -> str | None:
        motion, whole = self.case.motion, _torque(self.case, self.result)
        # A call for one sample costs nearly as much as for the whole motion.
        for k in range(0, len(motion), 10):
            one = np.asarray(self.result(motion.t[k], motion.q[k], motion.v[k]))
            # Not bit by bit: sums over a whole array are rounded in another order.
            if np.abs(one - whole[k]).max() > 1e-9 * np.abs(whole).max():
                return f"sample {k} alone gives another torque than within the whole motion"
        return None

    @Law("gives finite torques", of=("states",))
    def finite_steps(self) -> str | None:
        """Torque (nv,) and states of the length at the start of a step, finite along a motion."""
        law, (q, v, load) = self.result, (x[0] for x in _signals(self.case))
        start = np.asarray(law.start(q, v))
        torque, state = map(np.asarray, law.step(start.copy(), 1e-3, 0.0, q, v, load))
        one_step = (("its torque", torque, v.shape), ("its states", state, start.shape))
        wrong = first_error(shape_error(*one) for one in one_step)
        if wrong is not None:
            return wrong
        whole = _torque(self.case, _InPython(law))
        return shape_error("its torque", whole, self.case.motion.v.shape)

    @Law("keeps no state of its own", of=("states",))
    def memory(self) -> str | None:
        """A step from the same states gives the same torque, and leaves its arguments alone."""
        law, signals = self.result, _signals(self.case)
        state = np.array(law.start(signals[0][0], signals[1][0]))
        sample = tuple(x[len(x) // 3] for x in signals)
        before = data_hash((state, sample))
        first, again = (law.step(state, 1e-3, 0.0, *sample) for _ in range(2))
        if data_hash((state, sample)) != before:
            return "a step changed its arguments; return the next states"
        return None if data_hash(first) == data_hash(again) else "two steps from one state differ"

    @Law("is deterministic", of=("function", "states"))
    def repeats(self) -> str | None:
        """The law called twice, and the law prepared twice, give the same torque."""
        torque = _torque(self.case, self.result)
        if not np.array_equal(torque, _torque(self.case, self.result)):
            return (
                "the same motion gives another torque in the next call: a force law has no memory"
            )
        if not np.array_equal(torque, _torque(self.case, self.run())):
            return "prepared twice it gives two torques: draw random numbers from a seed of its own"
        return None

    @Law("is compiled as in Python", of=("states",))
    def compiled(self) -> str | None:
        if getattr(self.result, "kind", None) not in KINDS:
            return None
        python = _torque(self.case, _InPython(self.result))
        error = float(np.abs(_torque(self.case, self.result) - python).max())
        if error <= COMPILED * max(float(np.abs(python).max()), 1.0):
            return None
        return f"compiled and in Python its torques differ by {error:.3g} N m or N"

    @Law("vanishes at rest where declared", of=("function", "states"))
    def at_rest(self) -> str | None:
        """Zero torque at v = 0, of a law with states for a joint that has not moved."""
        if not getattr(self.plugin, "vanishes_at_rest", False):
            return None
        motion, law = self.case.motion, self.result
        if self.kind() == "function":
            torque = np.asarray(law(motion.t, motion.q, np.zeros_like(motion.v)))
        else:
            q, v, load = _signals(self.case)
            still = (np.broadcast_to(q[0], q.shape), np.zeros_like(v), load)
            torque = compiled_torque([law], motion.t, *still, STEPS)
        largest = float(np.abs(torque).max())
        return None if largest == 0.0 else f"its torque at rest is up to {largest:.3g} N m or N"

    @Law("dissipates where declared", of=("function", "states"))
    def dissipates(self) -> str | None:
        """Friction with the effect takes energy from each joint in the second of two cycles."""
        if not getattr(self.plugin, "dissipates", False):
            return None
        one = self.case.motion
        # The motion and its repetition; one period has no sample at its end.
        t = one.t[:1] + (one.t[1] - one.t[0]) * np.arange(2 * len(one))
        q, v, a = (np.concatenate([x, x]) for x in (one.q, one.v, one.a))
        twice = replace(self.case, motion=Trajectory(t, q, v, a))
        power = (_friction(twice, [self.plugin]) * v)[len(one) :]
        injected = -power.sum(axis=0) / np.maximum(np.abs(power).sum(axis=0), 1e-12)
        worst = int(np.argmax(injected))
        if injected[worst] <= INJECTED:
            return None
        return f"friction drives {self.case.robot.rows[worst]} over a closed cycle"

    @Law("vanishes at size zero", of=("function", "states"))
    def size_zero(self) -> str | None:
        """Torques bit for bit those without the effect where its `sizes` are zero."""
        if not getattr(self.plugin, "sizes", ()):
            return None
        without = _friction(self.case, [without_error(self.plugin)])
        if np.array_equal(without, _friction(self.case, [])):
            return None
        return "with its sizes zero, torques are not bit for bit those without it"
