"""Simulated plant: a robot with its joint terms, and force laws of effects that its model lacks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import mujoco
import numpy as np

from sysid_bench.errors import EstimationError, SimulationError
from sysid_bench.models.model_checks import recorded_warnings
from sysid_bench.models.robot import JointTerms, RobotModel
from sysid_bench.simulation.elastic_drives import ElasticDrives
from sysid_bench.spatial import body_mass_inertia
from sysid_bench.types import Array


class Effect(Protocol):
    """Unmodelled effect: torque of a plant that the identified model does not contain.

    `prepare(robot)` returns the effect's force law on this robot: the torque that
    the motors supply in addition (None: no effect). A law with an attribute `replaces` takes over
    these joint terms of the plant, as ("coulomb",). An elastic `ElasticDrives` is returned instead
    of a law. Random draws come from a seed of its own.
    """

    def prepare(self, robot: RobotModel) -> Any:
        """Return the force law of the effect on this robot, or None."""
        ...


@dataclass(frozen=True, eq=False)
class Plant:
    """A robot with joint terms and the force laws of effects; `phi` (nb, 10), if given, replaces
    the robot's inertial parameters."""

    robot: RobotModel
    terms: JointTerms  # without those that laws or the transmission take over
    laws: tuple[Any, ...] = ()
    phi: Array | None = None
    transmission: ElasticDrives | None = None

    @cached_property
    def robot_without_effects(self) -> "Plant":
        """The robot with its own joint terms and no effects, which controllers are designed for."""
        if self.phi is None:
            return plant_of(self.robot)
        # A candidate has no effects; a sealed plant has the inertias of its own robot.
        return replace(plant_of(self.robot), phi=self.phi) if self.phi is self.robot.phi else self

    @cached_property
    def contact_free_model(self) -> mujoco.MjModel:
        """Compiled model of the plant without contacts, joint limits and equality constraints."""
        return self.compiled(self.robot.spec.copy())

    def compiled(self, spec: mujoco.MjSpec) -> mujoco.MjModel:
        """Compile a spec of this robot with the plant's inertias and joint terms and
        `contact_free` applied; raises EstimationError if they cannot be simulated."""
        if self.phi is not None:
            for body in spec.bodies:
                body.simple = 0  # MuJoCo assumes that the centre of mass of a simple body is fixed
        with recorded_warnings():
            mj = contact_free(spec.compile())
        if self.phi is not None:
            set_inertia(mj, self.phi)
        if self.phi is not None or self.terms is not self.robot.joint_terms:
            terms = self.terms
            for j, joint in enumerate(self.robot.joints):
                if joint.kind not in ("hinge", "slide"):
                    continue
                dof = joint.vadr
                mj.dof_damping[dof] = _not_negative("viscous", terms.viscous[dof], joint.name)
                mj.dof_frictionloss[dof] = _not_negative("coulomb", terms.coulomb[dof], joint.name)
                mj.dof_armature[dof] = _not_negative("armature", terms.armature[dof], joint.name)
                mj.jnt_stiffness[j] = terms.spring[dof]
            # Quantities that MuJoCo derives from inertias, such as the weights of constraints.
            mujoco.mj_setConst(mj, mujoco.MjData(mj))
        return mj

    def check_terms(self) -> None:
        """Raise EstimationError for negative joint terms, which cannot be simulated."""
        for joint in self.robot.joints:
            if joint.kind in ("hinge", "slide"):
                for term in ("viscous", "coulomb", "armature"):
                    _not_negative(term, getattr(self.terms, term)[joint.vadr], joint.name)


def plant_of(robot: RobotModel, effects: Sequence[Effect] = ()) -> Plant:
    """Return the plant of a robot with the given effects and its own joint terms."""
    prepared = [effect.prepare(robot) for effect in effects]
    laws = tuple(x for x in prepared if x is not None and not isinstance(x, ElasticDrives))
    elastic = next((x for x in prepared if isinstance(x, ElasticDrives)), None)
    taken = {term for law in laws for term in getattr(law, "replaces", ())}
    if elastic is not None:
        taken.add("armature")  # which belongs to the rotors behind the transmission
    terms = robot.joint_terms
    if taken:  # else the very object, for which compiled models keep the terms of the file
        terms = replace(terms, **{term: np.zeros(robot.nv) for term in taken})
    return Plant(robot, terms, laws + coupling_law(terms), transmission=elastic)


def coupling_law(terms: JointTerms) -> tuple[Any, ...]:
    """Return the force law of viscous friction between joints, if there is any; MuJoCo has no
    passive element with an unsymmetric damping matrix."""
    return (_ViscousCoupling(terms.viscous_coupling),) if terms.viscous_coupling.any() else ()


@dataclass(frozen=True, eq=False)
class _ViscousCoupling:
    """Viscous friction between joints: tau = D v, with D = `numbers` (nv, nv)."""

    numbers: Array
    kind: str = "coupled"

    def __call__(self, t: Array, q: Array, v: Array) -> Array:
        """Return the torque (..., nv) at v (..., nv)."""
        return np.asarray(v @ self.numbers.T)


def contact_free(mj: mujoco.MjModel) -> mujoco.MjModel:
    """Disable contacts, joint limits and equality constraints of a model, in place, and return it.

    Forces that are not joint terms are disabled as well: tendons, gravity compensation, fluid drag,
    non-linear springs and dampers. Coupled joints are then actuated one by one.
    """
    bits = mujoco.mjtDisableBit
    # With autoreset a diverged simulation would silently start again from its reference posture.
    for bit in (
        bits.mjDSBL_CONTACT,
        bits.mjDSBL_LIMIT,
        bits.mjDSBL_EQUALITY,
        bits.mjDSBL_AUTORESET,
    ):
        mj.opt.disableflags |= int(bit)
    # Inverse dynamics in continuous time, whatever the integrator.
    mj.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
    mj.opt.density = mj.opt.viscosity = 0.0
    mj.body_gravcomp[:] = 0.0
    mj.jnt_stiffnesspoly[:] = mj.dof_dampingpoly[:] = 0.0
    for force in (mj.tendon_stiffness, mj.tendon_stiffnesspoly, mj.tendon_damping):
        force[:] = 0.0
    for force in (mj.tendon_dampingpoly, mj.tendon_frictionloss, mj.tendon_armature):
        force[:] = 0.0
    return mj


def set_inertia(mj: mujoco.MjModel, phi: Array) -> None:
    """Write inertial parameters phi (nb, 10), in body axes, into a compiled model.

    Raises EstimationError for a body with negative mass or principal moments.
    """
    for b, body_phi in enumerate(phi, start=1):
        mass, com, inertia = body_mass_inertia(body_phi)
        moments, axes = np.linalg.eigh(inertia)
        if mass < 0 or moments[0] < -1e-9 * max(moments[-1], 1e-12):
            raise EstimationError(
                f"Body {mj.body(b).name!r} cannot be simulated with mass {mass:.3g} kg and "
                f"principal moments {', '.join(f'{m:.3g}' for m in moments)} kg m^2."
            )
        if np.linalg.det(axes) < 0:  # a rotation matrix is needed for the quaternion
            axes[:, 0] *= -1
        mj.body_mass[b], mj.body_ipos[b] = mass, com
        mujoco.mju_mat2Quat(mj.body_iquat[b], np.ascontiguousarray(axes).ravel())
        mj.body_inertia[b] = np.maximum(moments, 0.0)


def _not_negative(term: str, value: float, joint: str) -> float:
    """The value, or zero if it is negative by rounding only; else EstimationError."""
    if value < -1e-9:
        raise EstimationError(
            f"Joint {joint!r} cannot be simulated with {term} = {value:.3g}: it is negative."
        )
    return max(float(value), 0.0)


def check_finite(name: str, array: Array, what: str) -> Array:
    """Return the array (N, ...); raises SimulationError with the first sample that is not
    finite."""
    bad = ~np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        raise SimulationError(
            f"{name}: {what} is not finite from sample {first} of {len(array)} on."
        )
    return array


@runtime_checkable
class StateLaw(Protocol):
    """Torque that depends on internal states, which advance with the simulation: deflections of
    bristles, play, temperatures."""

    def start(self, q: Array, v: Array) -> Array:
        """Return the states (s,) at the start, at q (nv,) and v (nv,)."""
        ...

    def step(
        self, state: Array, h: float, t: float, q: Array, v: Array, load: Array
    ) -> tuple[Array, Array]:
        """Return the torque (nv,) over a step of h (s) from t (s) on, and the states (s,) after it.

        q and v (nv,) are positions and rates of hinges and slides, by degree of freedom; `load`
        (nv,) is the torque on the links, M a + bias without armature, at the step before.
        """
        ...


@dataclass(frozen=True, eq=False)
class LawStates:
    """Force laws with the present states of each, as a simulation advances them."""

    laws: tuple[Any, ...]
    states: tuple[Array, ...]

    def step(
        self, h: float, t: float, q: Array, v: Array, load: Array
    ) -> tuple[Array, "LawStates"]:
        """Return the torque (nv,) of all laws over a step, and the laws after it."""
        total, states = np.zeros_like(v), []
        for law, state in zip(self.laws, self.states, strict=True):
            if isinstance(law, StateLaw):
                torque, state = law.step(state, h, t, q, v, load)
            else:
                torque = law(np.asarray(t), q, v)
            total = total + torque
            states.append(state)
        return total, LawStates(self.laws, tuple(states))


def start_states(laws: Sequence[Any], q: Array, v: Array) -> LawStates:
    """Return laws with their states at the start, at q (nv,) and v (nv,)."""
    states = [
        np.array(law.start(q, v), dtype=float) if isinstance(law, StateLaw) else np.zeros(0)
        for law in laws
    ]
    return LawStates(tuple(laws), tuple(states))


def law_values(laws: Sequence[Any], name: str, nv: int) -> Array:
    """Return the sum of the laws' internal springs ("stiffness", N m/rad or N/m) or dampers
    ("damping", N m s/rad or N s/m) of each degree of freedom (nv,)."""
    values = [np.asarray(getattr(law, name, np.zeros(nv))) for law in laws]
    return np.asarray(np.sum([np.zeros(nv), *values], axis=0))


@dataclass(frozen=True)
class Matched:
    """No unmodelled effect: the identified model can represent the plant exactly."""

    def prepare(self, robot: RobotModel) -> None:
        """Return no force law."""
