"""Joint terms of a robot: written from the manifest into MuJoCo's spec, read from its model.

The linear terms are viscous and Coulomb friction, torque offset, armature and spring
(`robot.JointTerms`); MuJoCo knows neither offsets nor viscous coupling between joints.
"""

from collections.abc import Iterator, Mapping
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, unknown_name
from sysid_bench.models.manifest import JointTerms as ManifestTerms
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.robot import TYPE_NAMES, Joint, JointTerms
from sysid_bench.types import Array

_SCALAR: Final = ("hinge", "slide")
_ATTRIBUTES: Final = {
    "viscous": "damping",
    "coulomb": "frictionloss",
    "armature": "armature",
    "spring": "stiffness",
    "spring_reference": "springref",
}
"""Attribute of a joint in MuJoCo's spec that holds a joint term."""


def apply_joint_terms(spec: mujoco.MjSpec, manifest: Manifest) -> None:
    """Write the joint terms of a manifest into the hinges and slides of a spec; those of a single
    joint override those of `all`."""
    scalar = [joint for joint in spec.joints if TYPE_NAMES[int(joint.type)] in _SCALAR]
    for joint in scalar:
        for terms in _manifest_terms(manifest, joint.name):
            _apply(joint, terms)


def model_joint_terms(
    mj: mujoco.MjModel, manifest: Manifest, joints: tuple[Joint, ...]
) -> JointTerms:
    """Return the joint terms (nv,) of a compiled model, with offsets and couplings of its manifest.

    Raises ModelError where a viscous coupling names an unknown joint.
    """
    viscous = np.array(mj.dof_damping, dtype=float)
    spring, reference = np.zeros(mj.nv), np.zeros(mj.nv)
    for j, joint in enumerate(joints):
        if joint.kind in _SCALAR:
            spring[joint.vadr] = float(np.ravel(mj.jnt_stiffness[j])[0])
            # A position q, as all of qpos; not a displacement from qpos0.
            reference[joint.vadr] = mj.qpos_spring[joint.qadr]
    offset, coupling = _offsets_and_couplings(manifest, joints, mj.nv)
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


def _offsets_and_couplings(
    manifest: Manifest, joints: tuple[Joint, ...], nv: int
) -> tuple[Array, Array]:
    """Torque offsets (nv,) and viscous couplings (nv, nv), which only a manifest can state."""
    offset, coupling = np.zeros(nv), np.zeros((nv, nv))
    dofs = {joint.name: joint.vadr for joint in joints if joint.kind in _SCALAR}
    stated = [(name, terms) for name in dofs for terms in _manifest_terms(manifest, name)]
    for name, terms in stated:
        if terms.offset is not None:
            offset[dofs[name]] = terms.offset
        for other, value in terms.viscous_coupling.items():
            coupling[dofs[name], _other_dof(manifest, name, other, dofs)] = value
    return offset, coupling


def _manifest_terms(manifest: Manifest, joint: str) -> Iterator[ManifestTerms]:
    """Terms of a joint in the manifest, in the order in which they override each other."""
    for name in ("all", joint):
        if name in manifest.joints:
            yield manifest.joints[name]


def _apply(joint: mujoco.MjsJoint, terms: ManifestTerms) -> None:
    for term, attribute in _ATTRIBUTES.items():
        value = getattr(terms, term)
        if value is not None:
            like = getattr(joint, attribute)
            setattr(joint, attribute, _linear_polynomial(like, value))


def _linear_polynomial(like: Any, value: float) -> Any:
    """The value in the form of `like`: MuJoCo 4 keeps polynomials of damping and stiffness, whose
    first coefficient is the linear one; earlier versions keep one number."""
    if np.ndim(like) == 0:
        return value
    coefficients = np.zeros_like(np.asarray(like, dtype=float))
    coefficients[0] = value
    return coefficients


def _other_dof(manifest: Manifest, joint: str, other: str, dofs: Mapping[str, int]) -> int:
    known = [name for name in dofs if name != joint]
    if other not in known:
        raise ModelError(
            f"{manifest.name}: joints.{joint}.viscous_coupling: "
            f"{unknown_name('other hinge or slide', other, known)}"
        )
    return dofs[other]
