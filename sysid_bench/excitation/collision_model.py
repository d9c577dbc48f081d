"""Distances between the shapes of a robot, and positions of its links, by MuJoCo.

A robot's file may hold no collision geometry (URDF without its meshes, MJCF stripped of them). Then
`CollisionModel.shapes` is zero, clearance cannot be kept, and the user is warned.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.models.shape import body_shape
from sysid_bench.types import Array

REACH: Final = 0.08
"""m; distances beyond it are not computed."""

_CLOSE: Final = 0.02
"""m; a pair nearer than this in the reference configuration is near by construction."""

WATCHED: Final = 4
"""Number of closest contacts of a sample in the search."""

_TYPES: Final = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "mesh": mujoco.mjtGeom.mjGEOM_MESH,
}


_POSTURES: Final = 20
"""Random configurations that separate contacts by construction from others of the reference."""


@dataclass(eq=False)
class CollisionModel:
    """Shapes of a robot, and a floor if given.

    Not watched are links that share a joint, and the pairs `ignored`: closer than 2 cm in the
    reference configuration, as hulls around wrists are. Pairs with the world, such as a floor, are
    ignored only where they also touch in 20 random configurations, as the base's shapes do.
    """

    mj: mujoco.MjModel
    shapes: int
    ignored: tuple[tuple[str, str], ...] = ()
    data: mujoco.MjData = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Set the distance at which contacts are found, and find the pairs to ignore."""
        self.mj.geom_margin[:] = REACH
        self.data = mujoco.MjData(self.mj)
        self._watched = np.ones((self.mj.nbody, self.mj.nbody), dtype=bool)
        for a, b in _neighbours(self.mj):
            self._watched[a, b] = False
        # Pairs that are near in the reference configuration are so by construction; those with the
        # world only if they are near in random ones, too.
        touching = self._near_pairs(self.mj.qpos0)
        always = touching.intersection(*map(self._near_pairs, self._postures()))
        touching = {pair for pair in touching if pair[0] > 0 or pair in always}
        for a, b in touching:
            self._watched[a, b] = False
        name = self.mj.body
        self.ignored = tuple((name(a).name or "world", name(b).name) for a, b in sorted(touching))

    def _near_pairs(self, q: Array) -> set[tuple[int, int]]:
        self.data.qpos[:] = q
        return {_pair(self.mj, contact) for contact in self._contacts(_CLOSE)}

    def _postures(self) -> Iterator[Array]:
        """Yield random configurations (nq,) over the ranges of hinges and slides."""
        rng, mj = np.random.default_rng(0), self.mj
        scalar = (mj.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) | (
            mj.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
        )
        limited = mj.jnt_limited.astype(bool)
        low = np.where(limited, mj.jnt_range[:, 0], -np.pi)
        high = np.where(limited, mj.jnt_range[:, 1], np.pi)
        for _ in range(_POSTURES):
            q = mj.qpos0.copy()
            q[mj.jnt_qposadr[scalar]] = rng.uniform(low, high)[scalar]
            yield q

    def contact_list(self, q: Array) -> list[tuple[float, str, Array]]:
        """Return the closest pairs of shapes at q (nq,), the closest first, none beyond REACH:
        (distance in m, "body - body", derivative by the degrees of freedom (nv,))."""
        self.data.qpos[:] = q
        found = []
        for contact in self._contacts(REACH)[:WATCHED]:
            slope = np.zeros(self.mj.nv)
            normal = contact.frame[:3]  # world frame, from the first shape to the second
            # The distance grows with the second shape's speed along the normal less the first's.
            for sign, geom in zip((-1.0, 1.0), contact.geom, strict=True):
                J, body = np.zeros((3, self.mj.nv)), int(self.mj.geom_bodyid[geom])
                mujoco.mj_jac(self.mj, self.data, J, None, contact.pos, body)
                slope += sign * normal @ J
            names = (self.mj.body(body).name or "world" for body in _pair(self.mj, contact))
            found.append((float(contact.dist), " - ".join(names), slope))
        return found

    def positions(self, q: Array, bodies: Sequence[int]) -> tuple[Array, Array]:
        """Return body origins (k, 3) in the world frame (m), and their Jacobians (k, 3, nv)."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.mj, self.data)
        mujoco.mj_comPos(self.mj, self.data)
        J = np.zeros((len(bodies), 3, self.mj.nv))
        for i, body in enumerate(bodies):
            mujoco.mj_jacBody(self.mj, self.data, J[i], None, body)
        return self.data.xpos[list(bodies)].copy(), J

    def _contacts(self, nearer: float) -> list[Any]:
        """Return the watched pairs nearer than a distance (m), the closest first."""
        mujoco.mj_kinematics(self.mj, self.data)
        mujoco.mj_comPos(self.mj, self.data)
        mujoco.mj_collision(self.mj, self.data)
        contact = self.data.contact
        a, b = np.sort(self.mj.geom_bodyid[contact.geom], axis=1).reshape(-1, 2).T
        found = np.flatnonzero((contact.dist < nearer) & self._watched[a, b])
        return [contact[int(i)] for i in found[np.argsort(contact.dist[found], kind="stable")]]


def collision_model(robot: RobotModel, floor: float | None = None) -> CollisionModel:
    """Return the collision model of a robot; `floor`: height (m) of a plane that is not touched."""
    spec = robot.spec.copy()
    if robot.format == "urdf":
        _add_shapes(spec, robot)
    if floor is not None:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE, size=[10.0, 10.0, 0.1], pos=[0.0, 0.0, floor]
        )
    mj = spec.compile()
    watched = (mj.geom_contype != 0) | (mj.geom_conaffinity != 0)
    return CollisionModel(mj, int(watched.sum()) - (floor is not None))


def _pair(mj: mujoco.MjModel, contact: Any) -> tuple[int, int]:
    a, b = (int(mj.geom_bodyid[geom]) for geom in contact.geom)
    return min(a, b), max(a, b)


def _neighbours(mj: mujoco.MjModel) -> Iterator[tuple[int, int]]:
    """Yield pairs of bodies whose links share a joint, welded bodies included; the first of a pair
    comes first in the tree. A floor belongs to the world and stays watched."""
    for b in range(1, mj.nbody):
        before = mj.body_weldid[mj.body_parentid[mj.body_weldid[b]]]
        for a in range(1, mj.nbody):
            if mj.body_weldid[a] == before and mj.body_weldid[b] != before:
                yield min(a, b), max(a, b)


def _add_shapes(spec: mujoco.MjSpec, robot: RobotModel) -> None:
    """Add the shapes of a URDF's links, which the canonical model text leaves out."""
    bodies = {body.name: body for body in spec.bodies}
    for k, shape in enumerate(body_shape(robot)):
        body = bodies.get(robot.body_names[shape.body])
        readable = shape.kind != "mesh" or Path(shape.file).suffix.lower() in (".stl", ".obj")
        if body is None or not readable:
            continue
        attributes: dict[str, Any] = {"pos": shape.position, "quat": shape.quaternion, "mass": 0.0}
        if shape.kind == "mesh":
            spec.add_mesh(name=f"shape{k}", file=shape.file, scale=list(shape.size))
            attributes["meshname"] = f"shape{k}"
        else:
            attributes["size"] = [*shape.size, 0.0, 0.0, 0.0][:3]
        body.add_geom(type=_TYPES[shape.kind], **attributes)
