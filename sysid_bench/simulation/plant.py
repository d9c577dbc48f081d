"""Simulated plant: a robot with its joint terms, and effects that its model does not
contain."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

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

    `prepare(robot)` returns the effect's force law on this robot (`force_laws.py`): the torque that
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
        if self.phi is not None:
            return self
        return plant_of(self.robot)

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
            _set_joint_terms(mj, self)
            # Quantities that MuJoCo derives from inertias, such as the weights of constraints.
            mujoco.mj_setConst(mj, mujoco.MjData(mj))
        return mj


def plant_of(robot: RobotModel, effects: Sequence[Effect] = ()) -> Plant:
    """Return the plant of a robot with the given effects and its own joint terms."""
    prepared = [effect.prepare(robot) for effect in effects]
    laws = tuple(x for x in prepared if x is not None and not isinstance(x, ElasticDrives))
    elastic = next((x for x in prepared if isinstance(x, ElasticDrives)), None)
    terms = _remaining_terms(robot, laws, elastic)
    return Plant(robot, terms, laws + coupling_law(terms), transmission=elastic)


def _remaining_terms(
    robot: RobotModel, laws: Sequence[Any], elastic: ElasticDrives | None
) -> JointTerms:
    """Joint terms without those that laws replace, and without armature, which belongs to the
    rotors behind an elastic transmission."""
    taken = {term for law in laws for term in getattr(law, "replaces", ())}
    if elastic is not None:
        taken.add("armature")
    if not taken:
        return robot.joint_terms
    return replace(robot.joint_terms, **{term: np.zeros(robot.nv) for term in taken})


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


def _set_joint_terms(mj: mujoco.MjModel, plant: "Plant") -> None:
    """Write viscous and Coulomb friction, armature and springs of hinges and slides."""
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
