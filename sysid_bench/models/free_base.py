"""Floating bases: a free joint on the root body, and mass where that body has none."""

import mujoco
import numpy as np

from sysid_bench.errors import ModelError
from sysid_bench.models.checks.mujoco_warnings import recorded_warnings
from sysid_bench.models.element_names import free_name
from sysid_bench.models.tree import FREE
from sysid_bench.models.urdf.inertia_repair import MASSLESS, TINY_MASS, TINY_MOMENT


def add_free_base(spec: mujoco.MjSpec, robot: str) -> tuple[str, ...]:
    """Give the root body a free joint, and mass where it has none; return the repairs in words.

    Raises ModelError, with the name of the `robot`, for several root bodies and for a root body
    that has other joints.
    """
    root = _root_body(spec, robot)
    kinds = {int(joint.type) for joint in root.joints}
    if FREE in kinds:
        return ()
    if kinds:
        raise ModelError(
            f"{robot}: the root body already has joints; a free joint cannot be added to it."
        )
    repairs = _give_mass(spec, root)
    names = tuple(joint.name for joint in spec.joints)
    root.add_freejoint(name=free_name("root", names))
    return repairs


def _root_body(spec: mujoco.MjSpec, robot: str) -> mujoco.MjsBody:
    roots = list(spec.worldbody.bodies)
    if len(roots) != 1:
        raise ModelError(f"{robot}: a free base needs one root body; there are {len(roots)}.")
    return roots[0]


def _give_mass(spec: mujoco.MjSpec, root: mujoco.MjsBody) -> tuple[str, ...]:
    """Give a massless floating base a small mass; a fixed base needs none.

    MuJoCo refuses a moving body without mass, of its own or of a body that is welded to it.
    """
    try:
        with recorded_warnings():
            mj = spec.compile()
    except (ValueError, mujoco.FatalError):
        return ()  # reported where the whole model is compiled
    if mj.body_mass[_welded_bodies(mj, root.id)].sum() >= MASSLESS:
        return ()
    root.explicitinertial, root.mass, root.inertia = True, TINY_MASS, np.full(3, TINY_MOMENT)
    root.ipos, root.iquat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    # NaN means "not given" to MuJoCo; another orientation in the text would win over iquat.
    root.fullinertia, root.ialt.type = np.full(6, np.nan), mujoco.mjtOrientation.mjORIENTATION_QUAT
    return (f"massless root body {root.name!r} given {TINY_MASS:.0e} kg",)


def _welded_bodies(mj: mujoco.MjModel, root: int) -> list[int]:
    """A body and all that move with it: no joint lies between."""
    welded = {root}
    for b in range(root + 1, mj.nbody):  # parents come before their children
        if int(mj.body_parentid[b]) in welded and mj.body_jntnum[b] == 0:
            welded.add(b)
    return list(welded)
