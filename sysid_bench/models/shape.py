"""Shapes of bodies for pictures, and the boxes that bound their centres of mass."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

import mujoco
import numpy as np

from sysid_bench.input_files import is_file
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.xml_file import parse_xml, read_file
from sysid_bench.spatial import matrix_of_quaternion, urdf_quaternion
from sysid_bench.types import Array, BodyExtents, Shape, ShapeKind

_MESHES: Final = (".stl", ".obj", ".glb", ".gltf", ".dae")
_GEOMS: Final[dict[int, tuple[ShapeKind, int]]] = {
    2: ("sphere", 1), 3: ("capsule", 2), 4: ("ellipsoid", 3), 5: ("cylinder", 2), 6: ("box", 3)
}  # fmt: skip
"""MuJoCo's geom types, and the number of sizes that each uses."""


def body_shape(robot: RobotModel) -> tuple[Shape, ...]:
    """Return the shapes of the bodies of a robot; empty where its file has none that can be
    read."""
    if robot.format == "mjcf":
        return tuple(_geoms(robot))
    # Collision shapes come first: their files are small.
    return tuple(_urdf_shapes(robot, "collision")) or tuple(_urdf_shapes(robot, "visual"))


def _urdf_shapes(robot: RobotModel, tag: str) -> Iterator[Shape]:
    """Shapes of the <collision> or <visual> elements of all bodies."""
    path = robot.manifest.path
    bodies = {name: i for i, name in enumerate(robot.body_names)}
    for link in parse_xml(read_file(path), path.name).findall("link"):
        body = bodies.get(str(link.get("name")))
        for element in link.findall(tag) if body is not None else ():
            origin = element.find("origin")
            with suppress(ValueError):  # a picture without this shape is better than none
                position = _numbers(origin, "xyz", 3)
                quaternion = urdf_quaternion(_numbers(origin, "rpy", 3))
                for geometry in element.findall("geometry[1]/*"):
                    found = _urdf_geometry(geometry, path)
                    if body is not None and found is not None:
                        kind, size, file = found
                        yield Shape(body, kind, size, position, quaternion, file)


def _urdf_geometry(
    geometry: ET.Element, model: Path
) -> tuple[ShapeKind, tuple[float, ...], str] | None:
    """Kind, size and file of a geometry; None for others, and for a mesh that does not exist."""
    match geometry.tag:
        case "mesh":
            file = _mesh_file(str(geometry.get("filename", "")), model)
            scale = tuple(_numbers(geometry, "scale", 3, default=1.0)) if file else ()
            return None if file is None else ("mesh", scale, file)
        case "box":
            return "box", tuple(0.5 * x for x in _numbers(geometry, "size", 3)), ""
        case "sphere":
            return "sphere", (float(geometry.get("radius", 0)),), ""
        case "cylinder" | "capsule" as kind:
            # URDF states full lengths, MuJoCo and `Shape` half of them.
            half = 0.5 * float(geometry.get("length", 0))
            return kind, (float(geometry.get("radius", 0)), half), ""
    return None


def _mesh_file(written: str, model: Path) -> str | None:
    """Readable file of a mesh that is written as package://NAME/..., file://... or relative."""
    files = [model.parent / written.removeprefix("file://")]
    if written.startswith("package://"):
        # The folder of the package is searched above the model, with its name and without.
        rest = Path(written.removeprefix("package://"))
        parts = (rest, Path(*rest.parts[1:]))
        files = [parent / part for parent in model.parents for part in parts]
    readable = files if written.lower().endswith(_MESHES) else []
    return next((str(file) for file in readable if is_file(file)), None)


def body_frames(robot: RobotModel, q: Array) -> tuple[Array, Array]:
    """Return positions (N, nb, 3) in m and quaternions (N, nb, 4), w first, of all bodies in the
    world, at q (N, nq)."""
    data = mujoco.MjData(robot.mj)
    positions = np.empty((len(q), len(robot.body_names), 3))
    quaternions = np.empty((len(q), len(robot.body_names), 4))
    for k, configuration in enumerate(q):
        data.qpos[:] = configuration
        mujoco.mj_kinematics(robot.mj, data)
        positions[k], quaternions[k] = data.xpos[1:], data.xquat[1:]
    return positions, quaternions


def _geoms(robot: RobotModel) -> Iterator[Shape]:
    mj = robot.mj
    for g in range(mj.ngeom):
        body, type_ = int(mj.geom_bodyid[g]) - 1, int(mj.geom_type[g])
        if body >= 0 and type_ in _GEOMS:
            kind, count = _GEOMS[type_]
            size = tuple(mj.geom_size[g][:count].tolist())
            yield Shape(body, kind, size, np.array(mj.geom_pos[g]), np.array(mj.geom_quat[g]))


def _numbers(element: ET.Element | None, key: str, count: int, default: float = 0.0) -> Array:
    text = "" if element is None else element.get(key, "")
    values = np.array([float(word) for word in text.split()]) if text else np.full(count, default)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(text)
    return values


MARGIN: Final = 0.2
"""m; margin around a body: housings, motors and tools reach beyond the joints that they hold."""

LAST: Final = 0.4
"""m; margin of a body that carries no other, such as a torso without a head: its extent is unknown.
"""

SHARE: Final = 0.5
"""Margin as a share of the diagonal: links bow out from the line between their joints."""

HOUSING: Final = 0.1
"""m around the joints; little mass lies further out."""


def body_extents(robot: RobotModel) -> Mapping[str, BodyExtents]:
    """Return the bounding box of each body (m, body frame): around its frame, joints, shapes
    (MJCF), the frames of its children and all that is welded to it, widened by margins.

    Generous: it only excludes centres of mass that are impossible. A payload, of which nothing is
    known, has none.
    """
    mj, extents = robot.mj, {}
    for i, name in enumerate(robot.body_names):
        if i == robot.payload_body:
            continue
        points = _points(mj, i + 1)  # MuJoCo counts the world
        low, high = points.min(axis=0), points.max(axis=0)
        margin = MARGIN if (mj.body_parentid[1:] == i + 1).any() else LAST
        reach = margin + SHARE * float(np.linalg.norm(high - low))
        volume = float(np.prod(high - low + 2 * HOUSING))
        extents[name] = BodyExtents(low - reach, high + reach, volume)
    return extents


def _points(mj: "mujoco.MjModel", body: int) -> Array:
    """Points (k, 3) of a body in its frame: the origins of its children are some, and all points
    of those that are welded to it."""
    points = [np.zeros(3)]
    points += [np.array(mj.jnt_pos[j]) for j in np.flatnonzero(mj.jnt_bodyid == body)]
    for g in np.flatnonzero(mj.geom_bodyid == body):
        # MuJoCo's box is aligned with the axes of the geom, not with those of the body.
        centre, half = np.split(np.array(mj.geom_aabb[g]), 2)
        corners = centre + half * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
        R = matrix_of_quaternion(np.array(mj.geom_quat[g]))
        points += list(np.array(mj.geom_pos[g]) + corners @ R.T)
    for child in np.flatnonzero(mj.body_parentid == body):
        origin = np.array(mj.body_pos[child])
        points.append(origin)
        if mj.body_jntnum[child] == 0:
            R = matrix_of_quaternion(np.array(mj.body_quat[child]))
            points += list(origin + _points(mj, int(child)) @ R.T)
    return np.array(points)
