"""Limits per degree of freedom: from the manifest, else from the model, else usual values."""

from typing import TYPE_CHECKING, Final

import numpy as np

from sysid_bench.models.manifest import Limits, Manifest
from sysid_bench.models.robot import Joint, JointLimits
from sysid_bench.types import Array

if TYPE_CHECKING:
    import mujoco

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
    for j, joint in enumerate(joints):
        if joint.kind not in USUAL:
            continue
        reach, usual_v, usual_a = USUAL[joint.kind]
        stated = _stated(manifest, joint.name)
        dof, centre = joint.vadr, mj.qpos0[joint.qadr]
        span = (centre - reach, centre + reach)
        if mj.jnt_limited[j] and np.ptp(mj.jnt_range[j]) <= UNLIMITED[joint.kind]:
            span = mj.jnt_range[j]
        low[dof], high[dof] = stated.q if stated.q is not None else span
        written = velocities.get(joint.name, np.inf)
        v[dof] = stated.v or (written if written <= PLACEHOLDER[joint.kind] else usual_v)
        a[dof] = stated.a or usual_a
        if stated.tau is not None:
            tau[dof] = stated.tau
        elif mj.jnt_actfrclimited[j]:
            # A range [-a, b] holds for either sign only up to the smaller one; zero means none.
            tau[dof] = np.abs(mj.jnt_actfrcrange[j]).min() or np.inf
    return JointLimits(low, high, v, a, tau)


def stated_limits(
    mj: "mujoco.MjModel",
    joints: tuple[Joint, ...],
    manifest: Manifest,
    velocities: dict[str, float],
) -> tuple[Array, Array, Array, Array]:
    """Return (lowest q, highest q, v, a) (nv,) where the manifest, for that joint, or the model
    states them; infinite elsewhere: usual values do not bind a joint that follows another one."""
    low, (high, v, a) = np.full(mj.nv, -np.inf), np.full((3, mj.nv), np.inf)
    for j, joint in enumerate(joints):
        if joint.kind not in USUAL:
            continue
        stated, dof = manifest.limits.get(joint.name, Limits()), joint.vadr
        if stated.q is not None:
            low[dof], high[dof] = stated.q
        elif mj.jnt_limited[j] and np.ptp(mj.jnt_range[j]) <= UNLIMITED[joint.kind]:
            low[dof], high[dof] = mj.jnt_range[j]
        written = velocities.get(joint.name, np.inf)
        v[dof] = stated.v or (written if written <= PLACEHOLDER[joint.kind] else np.inf)
        a[dof] = stated.a or np.inf
    return low, high, v, a


def _stated(manifest: Manifest, joint: str) -> Limits:
    """Limits of a joint in the manifest, its own before those of all joints."""
    common, single = (manifest.limits.get(name, Limits()) for name in ("all", joint))
    return common.model_copy(update=single.model_dump(exclude_none=True))
