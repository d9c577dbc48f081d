"""Tool frame of a robot, and payloads mounted there."""

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, unknown_name
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.payload import Payload
from sysid_bench.spatial import inertia_matrix, quaternion_of_matrix
from sysid_bench.types import Array

Pose = tuple[Array, Array]
"""Position (3,) in m and quaternion (4,), w first, in the frame of a body."""


def tool_frame(
    mj: mujoco.MjModel, manifest: Manifest, body_names: tuple[str, ...]
) -> tuple[int, Pose]:
    """Return the index of the body that carries payloads, and the pose of the tool frame in it: the
    manifest's body or site, else the end of the longest chain.

    Raises ModelError for an unknown name.
    """
    at_body = (np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    if manifest.tool is None:
        return _end_of_longest_chain(mj), at_body
    if manifest.tool in body_names:
        return body_names.index(manifest.tool), at_body
    return _tool_site(mj, manifest, body_names)


def _tool_site(
    mj: mujoco.MjModel, manifest: Manifest, body_names: tuple[str, ...]
) -> tuple[int, Pose]:
    """The body that a site is fixed to, and the pose of the site in it; not one of the world."""
    sites = {mj.site(s).name: s for s in range(mj.nsite)}
    site = sites.get(str(manifest.tool), -1)
    if site < 0 or mj.site_bodyid[site] == 0:
        known, name = [*body_names, *sites], str(manifest.tool)
        raise ModelError(f"{manifest.name}: {unknown_name('tool body or site', name, known)}")
    pose = (np.array(mj.site_pos[site]), np.array(mj.site_quat[site]))
    return int(mj.site_bodyid[site]) - 1, pose


def add_payload(spec: mujoco.MjSpec, body: int, pose: Pose, payload: Payload, name: str) -> None:
    """Add a body with the inertia of a payload at `pose` in the body with this id of a spec."""
    parent = next(b for b in spec.bodies if b.id == body)
    load = parent.add_body(name=name, pos=pose[0], quat=pose[1])
    load.explicitinertial = True
    load.mass = payload.mass
    load.ipos = payload.com
    # Principal moments, since MuJoCo refuses a full inertia with a zero eigenvalue (points, rods).
    moments, axes = np.linalg.eigh(inertia_matrix(np.array(payload.inertia)))
    moments = np.maximum(moments, 0.0)
    moments[2] = min(moments[2], moments[0] + moments[1])  # a lamina lies on the border
    load.inertia = moments
    load.iquat = quaternion_of_matrix(axes * np.sign(np.linalg.det(axes)))


def _end_of_longest_chain(mj: mujoco.MjModel) -> int:
    """The body with the most joints above it; of equals the deepest, of these the first."""
    # Ties are frequent: bodies welded to the last link have as many joints above them as it has.
    joints = np.zeros(mj.nbody, dtype=int)
    depth = np.zeros(mj.nbody, dtype=int)
    for b in range(1, mj.nbody):
        p = int(mj.body_parentid[b])
        joints[b] = joints[p] + int(mj.body_jntnum[b])
        depth[b] = depth[p] + 1
    return max(range(1, mj.nbody), key=lambda b: (joints[b], depth[b], -b)) - 1
