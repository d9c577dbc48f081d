"""Limits per degree of freedom: the manifest first, then the model, then what is usual."""

from typing import TYPE_CHECKING, Final

import numpy as np

from sysid_bench.models.manifest import Limits, Manifest
from sysid_bench.models.robot import Joint, JointLimits
from sysid_bench.types import Array

if TYPE_CHECKING:
    import mujoco

# Where neither manifest nor model says anything: a careful arm. rad, rad/s, rad/s^2; m, m/s, m/s^2.
USUAL: Final = {"hinge": (np.pi, 2.0, 10.0), "slide": (0.2, 0.5, 2.5)}
# Faster than this no robot joint moves: such a figure in a model file is a placeholder.
PLACEHOLDER: Final = {"hinge": 30.0, "slide": 10.0}
# Wider than this no joint turns or slides: such a range is a placeholder as well. rad; m.
UNLIMITED: Final = {"hinge": 1e3, "slide": 1e2}
FLOATING: Final = (1.0, 5.0)  # velocity, acceleration of free and ball joints


def limits_of(
    mj: "mujoco.MjModel",
    joints: tuple[Joint, ...],
    manifest: Manifest,
    velocities: dict[str, float],
) -> JointLimits:
    """The limits of every degree of freedom; `velocities`: those that the model's text states."""
    low, high = np.full(mj.nv, -np.inf), np.full(mj.nv, np.inf)
    v, a, tau = np.full(mj.nv, FLOATING[0]), np.full(mj.nv, FLOATING[1]), np.full(mj.nv, np.inf)
    for j, joint in enumerate(joints):
        if joint.kind not in USUAL:
            continue
        reach, usual_v, usual_a = USUAL[joint.kind]
        told = _told(manifest, joint.name)
        dof, centre = joint.vadr, mj.qpos0[joint.qadr]
        span = (centre - reach, centre + reach)
        if mj.jnt_limited[j] and np.ptp(mj.jnt_range[j]) <= UNLIMITED[joint.kind]:
            span = mj.jnt_range[j]
        low[dof], high[dof] = told.q if told.q is not None else span
        written = velocities.get(joint.name, np.inf)
        v[dof] = told.v or (written if written <= PLACEHOLDER[joint.kind] else usual_v)
        a[dof] = told.a or usual_a
        if told.tau is not None:
            tau[dof] = told.tau
        elif mj.jnt_actfrclimited[j]:
            tau[dof] = np.abs(mj.jnt_actfrcrange[j]).min() or np.inf
    return JointLimits(low, high, v, a, tau)


def stated_limits(
    mj: "mujoco.MjModel",
    joints: tuple[Joint, ...],
    manifest: Manifest,
    velocities: dict[str, float],
) -> tuple[Array, Array, Array, Array]:
    """(lowest q, highest q, v, a) (nv,) where the manifest, for that joint, or the model states
    them; infinite elsewhere: what is usual binds no joint that follows another one."""
    low, (high, v, a) = np.full(mj.nv, -np.inf), np.full((3, mj.nv), np.inf)
    for j, joint in enumerate(joints):
        if joint.kind not in USUAL:
            continue
        told, dof = manifest.limits.get(joint.name, Limits()), joint.vadr
        if told.q is not None:
            low[dof], high[dof] = told.q
        elif mj.jnt_limited[j] and np.ptp(mj.jnt_range[j]) <= UNLIMITED[joint.kind]:
            low[dof], high[dof] = mj.jnt_range[j]
        written = velocities.get(joint.name, np.inf)
        v[dof] = told.v or (written if written <= PLACEHOLDER[joint.kind] else np.inf)
        a[dof] = told.a or np.inf
    return low, high, v, a


def _told(manifest: Manifest, joint: str) -> Limits:
    everywhere, own = manifest.limits.get("all", Limits()), manifest.limits.get(joint, Limits())
    return everywhere.model_copy(update=own.model_dump(exclude_none=True))
