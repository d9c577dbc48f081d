"""Joint terms of a robot: written from the manifest into MuJoCo's spec, read from its model.

The linear terms are viscous and Coulomb friction, torque offset, armature and spring
(`robot.JointTerms`); MuJoCo knows neither offsets nor viscous coupling between joints.
"""

from collections.abc import Iterator
from typing import Any, Final, TypeVar

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, first_names, unknown_name
from sysid_bench.models.manifest import JointTerms as ManifestTerms
from sysid_bench.models.manifest import Limits, Manifest
from sysid_bench.models.robot import TYPE_NAMES, Joint, JointLimits, JointTerms
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
            for term, attribute in _ATTRIBUTES.items():
                value = getattr(terms, term)
                if value is not None:
                    like = getattr(joint, attribute)
                    setattr(joint, attribute, linear_polynomial(like, value))


def overridden_terms(spec: mujoco.MjSpec, manifest: Manifest) -> Iterator[str]:
    """Yield, in words, the terms of a model file in whose place a manifest has other values."""
    for term, attribute in list(_ATTRIBUTES.items())[:4]:
        texts = []
        for joint in spec.joints:
            stated = [getattr(terms, term) for terms in _manifest_terms(manifest, joint.name)]
            value = next((x for x in reversed(stated) if x is not None), None)
            own = float(np.ravel(getattr(joint, attribute))[0])
            # A written model and its manifest have the same value, with other digits.
            if value is not None and own and abs(value - own) > 1e-6 * abs(own):
                texts.append(f"{joint.name} {value:.4g} (file: {own:.4g})")
        if texts:
            yield (
                f"{attribute} of {manifest.path.name} replaced by the {term} of "
                f"{(manifest.manifest_file or manifest.path).name}: {first_names(texts)}"
            )


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
    # Torque offsets and viscous couplings (nv, nv) have no place in a model file.
    offset, coupling = np.zeros(mj.nv), np.zeros((mj.nv, mj.nv))
    dofs = {joint.name: joint.vadr for joint in joints if joint.kind in _SCALAR}
    stated = [(name, terms) for name in dofs for terms in _manifest_terms(manifest, name)]
    for name, terms in stated:
        if terms.offset is not None:
            offset[dofs[name]] = terms.offset
        for other, value in terms.viscous_coupling.items():
            known = [one for one in dofs if one != name]
            if other not in known:
                raise ModelError(
                    f"{manifest.name}: joints.{name}.viscous_coupling: "
                    f"{unknown_name('other hinge or slide', other, known)}"
                )
            coupling[dofs[name], dofs[other]] = value
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


def _manifest_terms(manifest: Manifest, joint: str) -> Iterator[ManifestTerms]:
    """Terms of a joint in the manifest, in the order in which they override each other."""
    for name in ("all", joint):
        if name in manifest.joints:
            yield manifest.joints[name]


def linear_polynomial(like: Any, value: float) -> Any:
    """Return the value in the form of `like`: MuJoCo 4 keeps polynomials of damping and stiffness,
    whose first coefficient is the linear one; earlier versions keep one number."""
    if np.ndim(like) == 0:
        return value
    coefficients = np.zeros_like(np.asarray(like, dtype=float))
    coefficients[0] = value
    return coefficients


Value = TypeVar("Value")

# Half range, speed, acceleration of a careful arm where neither manifest nor model states them:
# rad, rad/s, rad/s^2; m, m/s, m/s^2.
USUAL: Final = {"hinge": (np.pi, 2.0, 10.0), "slide": (0.2, 0.5, 2.5)}
# rad/s, m/s; no robot joint moves faster: such a value in a model file is a placeholder.
PLACEHOLDER: Final = {"hinge": 30.0, "slide": 10.0}
# rad, m; no joint has a wider range: such a range is a placeholder, too.
UNLIMITED: Final = {"hinge": 1e3, "slide": 1e2}
FLOATING: Final = (1.0, 5.0)  # velocity, acceleration of free and ball joints


def limits_of(
    mj: "mujoco.MjModel",
    joints: tuple[Joint, ...],
    manifest: Manifest,
    velocities: dict[str, float],
) -> JointLimits:
    """Return the limits (nv,) of every degree of freedom; `velocities`: limits by joint that the
    text of the model states (rad/s, m/s), which MuJoCo does not keep."""
    low, high = np.full(mj.nv, -np.inf), np.full(mj.nv, np.inf)
    v, a, tau = np.full(mj.nv, FLOATING[0]), np.full(mj.nv, FLOATING[1]), np.full(mj.nv, np.inf)
    for j, joint, q_model, v_model in _stated(mj, joints, velocities):
        reach, usual_v, usual_a = USUAL[joint.kind]
        # Limits of the joint itself come before those of "all".
        common, single = (manifest.limits.get(name, Limits()) for name in ("all", joint.name))
        written = common.model_copy(update=single.model_dump(exclude_none=True))
        dof, centre = joint.vadr, mj.qpos0[joint.qadr]
        low[dof], high[dof] = _first_given(written.q, q_model, (centre - reach, centre + reach))
        v[dof] = _first_given(written.v, v_model, usual_v)
        a[dof] = _first_given(written.a, usual_a)
        # A range [-a, b] holds for either sign only up to the smaller one; zero means none.
        largest = float(np.abs(mj.jnt_actfrcrange[j]).min()) if mj.jnt_actfrclimited[j] else 0.0
        tau[dof] = _first_given(written.tau, largest or np.inf)
    return JointLimits(low, high, v, a, tau)


def known_limits(
    mj: "mujoco.MjModel",
    joints: tuple[Joint, ...],
    manifest: Manifest,
    velocities: dict[str, float],
) -> tuple[Array, Array, Array, Array]:
    """Return (lowest q, highest q, v, a) (nv,) where the manifest, for that joint, or the model
    states them; infinite elsewhere: usual values do not bind a joint that follows another one."""
    low, (high, v, a) = np.full(mj.nv, -np.inf), np.full((3, mj.nv), np.inf)
    for _, joint, q_model, v_model in _stated(mj, joints, velocities):
        # Not those of "all": they are meant for the joints that motions command.
        written, dof = manifest.limits.get(joint.name, Limits()), joint.vadr
        low[dof], high[dof] = _first_given(written.q, q_model, (-np.inf, np.inf))
        v[dof] = _first_given(written.v, v_model, np.inf)
        a[dof] = _first_given(written.a, np.inf)
    return low, high, v, a


def _stated(
    mj: "mujoco.MjModel", joints: tuple[Joint, ...], velocities: dict[str, float]
) -> Iterator[tuple[int, Joint, tuple[float, float] | None, float | None]]:
    """Each hinge and slide with its index, and its range and velocity limit in the text of the
    model; None where it has none or only a placeholder."""
    for j, joint in enumerate(joints):
        if joint.kind in USUAL:
            low, high = mj.jnt_range[j]
            limited = mj.jnt_limited[j] and high - low <= UNLIMITED[joint.kind]
            v = velocities.get(joint.name, np.inf)
            fast = v > PLACEHOLDER[joint.kind]
            yield j, joint, (low, high) if limited else None, None if fast else v


def _first_given(*values: Value | None) -> Value:
    """The first value that is not None: sources are listed in the order of their authority."""
    return next(value for value in values if value is not None)
