"""Joint terms of a robot: written from the manifest into MuJoCo's spec, read from its model.

The linear terms are viscous and Coulomb friction, torque offset, armature and spring
(`robot.JointTerms`); MuJoCo knows neither offsets nor viscous coupling between joints.
"""

from collections.abc import Iterator, Mapping
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, unknown_name
from sysid_bench.models.manifest import JointTerms as StatedTerms
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.robot import TYPE_NAMES, Joint, JointTerms

_SCALAR: Final = ("hinge", "slide")


def apply_joint_terms(spec: mujoco.MjSpec, manifest: Manifest) -> None:
    """Write the joint terms of a manifest into the hinges and slides of a spec; those of a single
    joint override those of `all`."""
    for joint in spec.joints:
        if TYPE_NAMES[int(joint.type)] in _SCALAR:
            for terms in _stated(manifest, joint.name):
                _apply(joint, terms)


def model_joint_terms(
    mj: mujoco.MjModel, manifest: Manifest, joints: tuple[Joint, ...]
) -> JointTerms:
    """Return the joint terms (nv,) of a compiled model, with offsets and couplings of its manifest.

    Raises ModelError where a viscous coupling names an unknown joint.
    """
    viscous = np.array(mj.dof_damping, dtype=float)
    offset, spring, reference = (np.zeros(mj.nv) for _ in range(3))
    coupling = np.zeros((mj.nv, mj.nv))
    dofs = {joint.name: joint.vadr for joint in joints if joint.kind in _SCALAR}
    for j, joint in enumerate(joints):
        if joint.kind not in _SCALAR:
            continue
        spring[joint.vadr] = float(np.ravel(mj.jnt_stiffness[j])[0])
        reference[joint.vadr] = mj.qpos_spring[joint.qadr]
        for terms in _stated(manifest, joint.name):
            if terms.offset is not None:
                offset[joint.vadr] = terms.offset
            for other, value in terms.viscous_coupling.items():
                coupling[joint.vadr, _other_dof(manifest, joint.name, other, dofs)] = value
    return JointTerms(
        # MuJoCo 4 keeps polynomials of the speed; the linear coefficient comes first.
        viscous=viscous if viscous.ndim == 1 else viscous[:, 0],
        coulomb=np.array(mj.dof_frictionloss, dtype=float),
        offset=offset,
        armature=np.array(mj.dof_armature, dtype=float),
        spring=spring,
        spring_reference=reference,
        viscous_coupling=coupling,
    )


def _stated(manifest: Manifest, joint: str) -> Iterator[StatedTerms]:
    for name in ("all", joint):
        if name in manifest.joints:
            yield manifest.joints[name]


def _apply(joint: mujoco.MjsJoint, terms: StatedTerms) -> None:
    if terms.viscous is not None:
        joint.damping = _linear_polynomial(joint.damping, terms.viscous)
    if terms.coulomb is not None:
        joint.frictionloss = terms.coulomb
    if terms.armature is not None:
        joint.armature = terms.armature
    if terms.spring is not None:
        joint.stiffness = _linear_polynomial(joint.stiffness, terms.spring)
    if terms.spring_reference is not None:
        joint.springref = terms.spring_reference


def _linear_polynomial(like: Any, value: float) -> Any:
    """The value in the form of `like`: MuJoCo 4 keeps polynomials of damping and stiffness, whose
    first coefficient is the linear one; earlier versions keep one number."""
    if np.ndim(like) == 0:
        return value
    coefficients = np.zeros_like(np.asarray(like, dtype=float))
    coefficients[0] = value
    return coefficients


def _other_dof(manifest: Manifest, joint: str, other: str, dofs: Mapping[str, int]) -> int:
    if other not in dofs or other == joint:
        known = [name for name in dofs if name != joint]
        raise ModelError(
            f"{manifest.name}: joints.{joint}.viscous_coupling: "
            f"{unknown_name('other hinge or slide', other, known)}"
        )
    return dofs[other]
