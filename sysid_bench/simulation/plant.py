"""The plant: the robot that moves, with the joint terms it has and effects the model lacks."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import mujoco
import numpy as np

from sysid_bench.errors import EstimationError, SimulationError
from sysid_bench.models.checks.mujoco_warnings import recorded_warnings
from sysid_bench.models.robot import JointTerms, RobotModel
from sysid_bench.spatial.inertia import mass_com_inertia
from sysid_bench.types import Array


class Effect(Protocol):
    """Something that a plant does beyond the identified model.

    `prepare(robot)` settles what the effect is on this robot (random draws come from its own seed);
    it returns a force law `(t, q, v) -> torque`, t (), q (..., nq), v (..., nv), torque (..., nv):
    what the motors must supply on top. A law sees single samples (closed loop) or whole motions.
    One that carries a `kind` and `numbers` that steps.c knows is compiled.
    """

    def prepare(self, robot: RobotModel) -> Any: ...


@dataclass(frozen=True, eq=False)
class Plant:
    """A robot with its joint terms and the force laws of effects on top; `phi` (nb, 10) replaces
    the robot's own inertias where it is given."""

    robot: RobotModel
    terms: JointTerms
    laws: tuple[Any, ...] = ()
    phi: Array | None = None

    @cached_property
    def fixed_contact_free_model(self) -> mujoco.MjModel:
        """The plant's model on the bench."""
        return self.compiled(self.robot.spec.copy())

    def compiled(self, spec: mujoco.MjSpec) -> mujoco.MjModel:
        """A spec of this robot, compiled with the plant's inertias and terms and `bench_flags`."""
        if self.phi is not None:
            for body in spec.bodies:
                body.simple = 0  # a body flagged simple may not get another centre of mass
        with recorded_warnings():
            mj = contact_free_flags(spec.compile())
        if self.phi is not None:
            set_inertias(mj, self.phi)
            _set_joint_terms(mj, self)
            mujoco.mj_setConst(mj, mujoco.MjData(mj))
        return mj

    def extra(self, t: Array, q: Array, v: Array) -> Array:
        """Torque (..., nv) of the effects."""
        total = np.zeros_like(v)
        for law in self.laws:
            total = total + law(t, q, v)
        return total


def plant_of(robot: RobotModel, effects: Sequence[Effect] = ()) -> Plant:
    """The plant of a robot; an effect that prepares None adds nothing."""
    laws = [effect.prepare(robot) for effect in effects]
    own = tuple(law for law in laws if law is not None)
    return Plant(robot, robot.joint_terms, own + coupling_laws(robot.joint_terms))


def coupling_laws(terms: JointTerms) -> tuple[Any, ...]:
    """The law of viscous friction between joints, where there is any: no passive element of MuJoCo
    has an unsymmetric one."""
    return (Coupled(terms.viscous_coupling),) if terms.viscous_coupling.any() else ()


@dataclass(frozen=True, eq=False)
class Coupled:
    """Torque `numbers` (nv, nv) times v."""

    numbers: Array
    kind: str = "coupled"

    def __call__(self, t: Array, q: Array, v: Array) -> Array:
        """Torque (..., nv)."""
        return v @ self.numbers.T


def contact_free_flags(mj: mujoco.MjModel) -> mujoco.MjModel:
    """Contacts, joint limits and equality constraints off: a robot on an identification bench
    moves freely, and coupled joints are actuated one by one. Forces that are no joint terms are off
    as well: tendons, gravity compensation, the medium, non-linear springs and dampers."""
    bits = mujoco.mjtDisableBit
    # Autoreset would start a diverged simulation again from its reference, as if nothing happened.
    for bit in (
        bits.mjDSBL_CONTACT,
        bits.mjDSBL_LIMIT,
        bits.mjDSBL_EQUALITY,
        bits.mjDSBL_AUTORESET,
    ):
        mj.opt.disableflags |= int(bit)
    # Inverse dynamics of the continuous time, whatever the integrator.
    mj.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
    mj.opt.density = mj.opt.viscosity = 0.0
    mj.body_gravcomp[:] = 0.0
    mj.jnt_stiffnesspoly[:] = mj.dof_dampingpoly[:] = 0.0
    for force in (mj.tendon_stiffness, mj.tendon_stiffnesspoly, mj.tendon_damping):
        force[:] = 0.0
    for force in (mj.tendon_dampingpoly, mj.tendon_frictionloss, mj.tendon_armature):
        force[:] = 0.0
    return mj


def set_inertias(mj: mujoco.MjModel, phi: Array) -> None:
    """Writes phi (nb, 10) into a compiled model; EstimationError for a body that cannot exist."""
    for b, numbers in enumerate(phi, start=1):
        mass, com, inertia = mass_com_inertia(numbers)
        moments, axes = np.linalg.eigh(inertia)
        if mass < 0 or moments[0] < -1e-9 * max(moments[-1], 1e-12):
            raise EstimationError(
                f"Body {mj.body(b).name!r} cannot be simulated with mass {mass:.3g} kg and "
                f"principal moments {', '.join(f'{m:.3g}' for m in moments)} kg m^2."
            )
        if np.linalg.det(axes) < 0:
            axes[:, 0] *= -1
        mj.body_mass[b], mj.body_ipos[b] = mass, com
        mujoco.mju_mat2Quat(mj.body_iquat[b], np.ascontiguousarray(axes).ravel())
        mj.body_inertia[b] = np.maximum(moments, 0.0)


def _set_joint_terms(mj: mujoco.MjModel, plant: "Plant") -> None:
    """Writes viscous and Coulomb friction, armature and springs of hinges and slides."""
    terms = plant.terms
    for j, joint in enumerate(plant.robot.joints):
        if joint.kind not in ("hinge", "slide"):
            continue
        dof = joint.vadr
        mj.dof_damping[dof] = _not_negative("viscous", terms.viscous[dof], joint.name)
        mj.dof_frictionloss[dof] = _not_negative("coulomb", terms.coulomb[dof], joint.name)
        mj.dof_armature[dof] = _not_negative("armature", terms.armature[dof], joint.name)
        mj.jnt_stiffness[j] = terms.spring[dof]


def _not_negative(term: str, value: float, joint: str) -> float:
    """The value, zero where only rounding makes it negative; EstimationError where it is."""
    if value < -1e-9:
        raise EstimationError(
            f"Joint {joint!r} cannot be simulated with {term} = {value:.3g}: it is negative."
        )
    return max(float(value), 0.0)


def check_finite(name: str, array: Array, what: str) -> Array:
    """The array, or SimulationError naming the first sample that is not a number."""
    bad = ~np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        raise SimulationError(
            f"{name}: {what} is not finite from sample {first} of {len(array)} on."
        )
    return array
