"""Candidate model of methods that simulate: kinematics, a plant of their estimates, a simulator."""

import itertools
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Final

import mujoco
import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.coupling.equalities import closure_frames, coupled_terms
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.models.robot import SUFFIX, JointTerms, RobotModel
from sysid_bench.simulation.effects.presliding import StribeckLaw
from sysid_bench.simulation.plant import Plant, coupling_law, plant_of
from sysid_bench.simulation.plant_batch import uncovered
from sysid_bench.simulation.tracking_control import TrackingControl
from sysid_bench.simulation.tracking_model import INTEGRATORS
from sysid_bench.spatial import quaternion_of_matrix
from sysid_bench.types import Array, Body

SMOOTHING: Final = 0.01
"""v0 (rad/s, m/s) of smooth Coulomb friction tanh(v / v0)."""


@dataclass(frozen=True)
class Candidate:
    """Simulator of candidate models: `step` (s; None: the control period), `integrator`, and
    Coulomb `friction` that sticks ("sticking") or "smooth" friction tanh(v / v0).

    It is declared apart from that of the plant: where both are equal, methods that simulate are
    given the very process that made the data (inverse crime).
    """

    step: float | None = None
    integrator: str = "auto"
    friction: str = "sticking"

    def control(self, rate: float) -> TrackingControl:
        """Return the closed loop of a controller at `rate` (Hz).

        Raises UsageError for a step that does not divide the control period.
        """
        ratio = 1.0 if self.step is None else 1.0 / (rate * self.step)
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio:
            raise UsageError(
                f"The step of the candidate, {self.step} s, does not divide the control period "
                f"of {1 / rate:g} s."
            )
        return TrackingControl(rate=rate, substeps=round(ratio), integrator=self.integrator)

    def plant(self, plant: Plant) -> Plant:
        """Return a candidate model with this kind of Coulomb friction."""
        if self.friction == "sticking" or not plant.terms.coulomb.any():
            return plant
        coulomb = plant.terms.coulomb
        same = np.full(len(coulomb), np.inf), np.full(len(coulomb), SMOOTHING)
        law = StribeckLaw(np.concatenate([coulomb, *same]))
        terms = replace(plant.terms, coulomb=np.zeros_like(coulomb))
        return replace(plant, terms=terms, laws=(law, *plant.laws))

    def simulator(self, robot: RobotModel) -> str:
        """Return what simulates candidates of a robot: "lanes", or "mujoco" with the reason."""
        # "auto" is one of two that are covered.
        name = "euler" if self.integrator == "auto" else self.integrator
        reason = uncovered(plant_of(robot), robot.mj, int(INTEGRATORS[name]))
        return f"mujoco: {reason}" if reason else "lanes"

    def has_steps_of(self, simulation: TrackingControl, step: float) -> bool:
        """Return True where a plant with the time step `step` (s) under `simulation` may have the
        integrator of the candidate, and has its step, or has its simulator."""
        if simulation.simulator == "lanes":
            return True
        own = self.control(simulation.rate)
        names = {own.integrator, simulation.integrator}
        one_step = abs(step * own.substeps * own.rate - 1.0) < 1e-6
        return one_step and (len(names) == 1 or "auto" in names)


def kinematics_of(robot: RobotModel) -> RobotModel:
    """Return a robot with the kinematics, names, limits and spring references of another, and
    nothing else.

    Bodies have unit mass and inertia and joints no friction; source text, manifest and payload are
    removed. An identification method cannot read the true parameters from it.
    """
    # Bodies, joints and equalities of a compiled model; no shapes, inertias or joint terms
    spec, mj = mujoco.MjSpec(), robot.mj
    spec.compiler.degree = False
    bodies = [spec.worldbody]
    for b in range(1, mj.nbody):
        body = bodies[mj.body_parentid[b]].add_body(
            name=mj.body(b).name, pos=mj.body_pos[b], quat=mj.body_quat[b]
        )
        body.explicitinertial, body.mass, body.inertia = True, 1.0, np.ones(3)
        # Unless set, these are NaN, which the compiler replaces by the body's pose.
        body.ipos, body.iquat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
        for k in range(mj.body_jntnum[b]):
            _add_joint(body, mj, int(mj.body_jntadr[b]) + k)
        bodies.append(body)
    for e in range(mj.neq):
        _add_equality(spec, bodies, mj, e)
    spec.option = robot.spec.option
    terms = {field.name: np.zeros(robot.nv) for field in fields(JointTerms)}
    terms["viscous_coupling"] = np.zeros((robot.nv, robot.nv))
    terms["spring_reference"] = robot.joint_terms.spring_reference
    return replace(
        robot,
        manifest=Manifest(robot.name, Path()),
        payload=PAYLOADS["none"],
        mj=spec.compile(),
        spec=spec,
        phi=np.zeros_like(robot.phi),
        joint_terms=JointTerms(**terms),
        text=b"",
    )


def _add_joint(body: mujoco.MjsBody, mj: mujoco.MjModel, j: int) -> None:
    kind, qadr = mujoco.mjtJoint(int(mj.jnt_type[j])), int(mj.jnt_qposadr[j])
    joint = body.add_joint(name=mj.joint(j).name, type=kind)
    if kind == mujoco.mjtJoint.mjJNT_FREE:
        return
    joint.pos, joint.axis = mj.jnt_pos[j], mj.jnt_axis[j]
    joint.actfrclimited = bool(mj.jnt_actfrclimited[j])
    joint.actfrcrange = mj.jnt_actfrcrange[j]
    if kind != mujoco.mjtJoint.mjJNT_BALL:
        joint.ref, joint.springref = mj.qpos0[qadr], mj.qpos_spring[qadr]


def _add_equality(
    spec: mujoco.MjSpec, bodies: list[mujoco.MjsBody], mj: mujoco.MjModel, e: int
) -> None:
    """Add an equality of joints or tendons as one of fixed tendons, and one of bodies as one of
    sites, since MuJoCo computes anchors of bodies anew from their reference posture."""
    kind = mujoco.mjtEq(int(mj.eq_type[e]))
    loop = kind in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)
    names = [f"end {end} of equality {e}" for end in range(2)]
    if loop:
        for name, (body, p, R) in zip(names, closure_frames(mj, e), strict=True):
            bodies[body].add_site(name=name, pos=p, quat=quaternion_of_matrix(R))
    else:
        sums = dict(zip(names, coupled_terms(mj, e), strict=True))
        names = [name for name, terms in sums.items() if terms]
        for name in names:
            tendon = spec.add_tendon(name=name)
            for dof, coefficient in sums[name].items():
                tendon.wrap_joint(mj.joint(int(mj.dof_jntid[dof])).name, coefficient)
    equality = spec.add_equality(name=f"equality {e}")
    equality.type = kind if loop else mujoco.mjtEq.mjEQ_TENDON
    equality.objtype = mujoco.mjtObj.mjOBJ_SITE if loop else mujoco.mjtObj.mjOBJ_TENDON
    # An equality of one joint alone fixes it: there is no second tendon.
    equality.name1, equality.name2 = [*names, ""][:2]
    equality.data = np.array(mj.eq_data[e])


@dataclass(frozen=True, eq=False)
class KnownModel:
    """Model knowledge of an identification method: the kinematics `robot`, the names `parameters`
    (p,) of the unknowns, and what the task takes as known.

    `known_links` (n_links, 10) are inertial parameters, `known_terms` (nv,) joint terms by name,
    and `known_coupling` (nv, nv) viscous friction between joints. The true values of the unknowns
    cannot be reached from here.
    """

    robot: RobotModel
    parameters: tuple[str, ...]
    bodies: tuple[Body, ...]
    known_links: Array
    known_terms: dict[str, Array]
    known_coupling: Array


def plant_of_model(model: KnownModel, theta: Array) -> Plant:
    """Return the plant with the values theta (p,) of the unknowns and the known parameters."""
    robot = model.robot
    index = {name: i for i, name in enumerate(model.parameters)}
    phi = np.zeros_like(robot.phi)
    for link, known in zip(robot.tree.links, model.known_links, strict=True):
        phi[link.body] += known
    for body in model.bodies:
        b = robot.body_names.index(body.name)
        phi[b] += theta[[index[column] for column in body.columns]]
    values = {}
    for term, suffix in SUFFIX.items():
        known = model.known_terms.get(term)
        value = np.zeros(robot.nv) if known is None else known.copy()
        for dof in robot.scalar_dofs:
            i = index.get(f"{robot.rows[dof]}.{suffix}")
            if i is not None:
                value[dof] = theta[i]
        values[term] = value
    coupling = model.known_coupling.copy()
    # Friction of one joint by the speed of another: both directions are parameters of their own.
    for dof, other in itertools.permutations(robot.scalar_dofs, 2):
        i = index.get(f"{robot.rows[dof]}.fv.{robot.rows[other]}")
        if i is not None:
            coupling[dof, other] = theta[i]
    terms = replace(robot.joint_terms, **values, viscous_coupling=coupling)
    return Plant(robot, terms, coupling_law(terms), phi)
