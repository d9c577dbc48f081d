"""The plant: the robot that moves, with the joint terms it has and effects the model lacks."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import mujoco
import numpy as np

from sysid_bench.errors import SimulationError
from sysid_bench.models.robot import JointTerms, RobotModel
from sysid_bench.types import Array


class Effect(Protocol):
    """Something that a plant does beyond the identified model.

    `prepare(robot)` settles what the effect is on this robot (random draws come from its own seed);
    it returns a force law `(t, q, v) -> torque`, t (), q (..., nq), v (..., nv), torque (..., nv):
    what the motors must supply on top. A law sees single samples (closed loop) or whole motions.
    """

    def prepare(self, robot: RobotModel) -> Any: ...


@dataclass(frozen=True, eq=False)
class Plant:
    """A robot with its joint terms and the force laws of effects on top."""

    robot: RobotModel
    terms: JointTerms
    laws: tuple[Any, ...] = ()

    @cached_property
    def bench(self) -> mujoco.MjModel:
        """The robot's model with `bench_flags`."""
        return bench_flags(self.robot.spec.copy().compile())

    def extra(self, t: Array, q: Array, v: Array) -> Array:
        """Torque (..., nv) of the effects."""
        total = np.zeros_like(v)
        for law in self.laws:
            total = total + law(t, q, v)
        return total


def plant_of(robot: RobotModel, effects: Sequence[Effect] = ()) -> Plant:
    """The plant of a robot; an effect that prepares None adds nothing."""
    laws = [effect.prepare(robot) for effect in effects]
    return Plant(robot, robot.joint_terms, tuple(law for law in laws if law is not None))


def bench_flags(mj: mujoco.MjModel) -> mujoco.MjModel:
    """Contacts, joint limits and equality constraints off: a robot on an identification bench
    moves freely, and coupled joints are actuated one by one."""
    bits = mujoco.mjtDisableBit
    for bit in (bits.mjDSBL_CONTACT, bits.mjDSBL_LIMIT, bits.mjDSBL_EQUALITY):
        mj.opt.disableflags |= int(bit)
    return mj


def check_finite(name: str, array: Array, what: str) -> Array:
    """The array, or SimulationError naming the first sample that is not a number."""
    bad = ~np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        raise SimulationError(f"{name}: {what} is not finite from sample {first} of {len(array)} on.")
    return array
