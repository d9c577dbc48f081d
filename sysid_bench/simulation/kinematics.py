"""Kinematic model without dynamic parameters, for methods that simulate with their own
estimates."""

from dataclasses import fields, replace
from pathlib import Path

import mujoco
import numpy as np

from sysid_bench.models.coupling.equalities import closure_frames, coupled_terms
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.models.robot import JointTerms, RobotModel
from sysid_bench.spatial import quaternion_of_matrix


def kinematics_of(robot: RobotModel) -> RobotModel:
    """Return a robot with the kinematics, names, limits and spring references of another, and
    nothing else.

    Bodies have unit mass and inertia and joints no friction; source text, manifest and payload are
    removed. An identification method cannot read the true parameters from it.
    """
    spec = _kinematic_spec(robot.mj)
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


def _kinematic_spec(mj: mujoco.MjModel) -> mujoco.MjSpec:
    """Bodies, joints and equalities of a compiled model; no shapes, inertias or joint terms."""
    spec = mujoco.MjSpec()
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
    return spec


def _add_joint(body: mujoco.MjsBody, mj: mujoco.MjModel, j: int) -> None:
    kind, qadr = mujoco.mjtJoint(int(mj.jnt_type[j])), int(mj.jnt_qposadr[j])
    joint = body.add_joint(name=mj.joint(j).name, type=kind)
    if kind == mujoco.mjtJoint.mjJNT_FREE:
        return
    joint.pos, joint.axis = mj.jnt_pos[j], mj.jnt_axis[j]
    joint.actfrclimited, joint.actfrcrange = bool(mj.jnt_actfrclimited[j]), mj.jnt_actfrcrange[j]
    if kind != mujoco.mjtJoint.mjJNT_BALL:
        joint.ref, joint.springref = mj.qpos0[qadr], mj.qpos_spring[qadr]


def _add_equality(
    spec: mujoco.MjSpec, bodies: list[mujoco.MjsBody], mj: mujoco.MjModel, e: int
) -> None:
    """Add an equality of joints or tendons as one of fixed tendons, and one of bodies as one of
    sites, since MuJoCo computes anchors of bodies anew from their reference posture."""
    kind = mujoco.mjtEq(int(mj.eq_type[e]))
    loop = kind in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)
    names = _add_sites(bodies, mj, e) if loop else _add_tendons(spec, mj, e)
    equality = spec.add_equality(name=f"equality {e}")
    equality.type = kind if loop else mujoco.mjtEq.mjEQ_TENDON
    equality.objtype = mujoco.mjtObj.mjOBJ_SITE if loop else mujoco.mjtObj.mjOBJ_TENDON
    # An equality of one joint alone fixes it: there is no second tendon.
    equality.name1, equality.name2 = [*names, ""][:2]
    equality.data = np.array(mj.eq_data[e])


def _add_sites(bodies: list[mujoco.MjsBody], mj: mujoco.MjModel, e: int) -> list[str]:
    """Add a site at each end of a loop's closure; return their names."""
    names = [f"end {end} of equality {e}" for end in range(2)]
    for name, (body, p, R) in zip(names, closure_frames(mj, e), strict=True):
        bodies[body].add_site(name=name, pos=p, quat=quaternion_of_matrix(R))
    return names


def _add_tendons(spec: mujoco.MjSpec, mj: mujoco.MjModel, e: int) -> list[str]:
    """Add a fixed tendon for each side of an equality that has terms; return their names."""
    sides = {f"sum {side} of equality {e}": x for side, x in enumerate(coupled_terms(mj, e)) if x}
    for name, terms in sides.items():
        tendon = spec.add_tendon(name=name)
        for dof, coefficient in terms.items():
            tendon.wrap_joint(mj.joint(int(mj.dof_jntid[dof])).name, coefficient)
    return list(sides)
