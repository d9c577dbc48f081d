"""Visual shapes of URDF links and MuJoCo geoms, for pictures alone."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import mujoco
import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.models.xml_file import parse_xml
from sysid_bench.spatial.rotation import product
from sysid_bench.types import Array, Shape, ShapeKind

_MESHES: Final = (".stl", ".obj", ".glb", ".gltf", ".dae")
_GEOMS: Final[dict[int, tuple[ShapeKind, int]]] = {
    2: ("sphere", 1), 3: ("capsule", 2), 4: ("ellipsoid", 3), 5: ("cylinder", 2), 6: ("box", 3)
}  # fmt: skip
"""MuJoCo's geom types, and the number of sizes that each uses."""


def shapes_of(robot: RobotModel) -> tuple[Shape, ...]:
    """Return the shapes of the bodies of a robot; empty where its file has none that can be
    read."""
    if robot.format == "mjcf":
        return tuple(_geoms(robot))
    bodies = {name: i for i, name in enumerate(robot.body_names)}
    root = parse_xml(robot.manifest.path.read_bytes(), robot.manifest.path.name)
    for tag in ("collision", "visual"):  # collision shapes come first: their files are small
        shapes = [
            shape
            for link in root.findall("link")
            if str(link.get("name")) in bodies
            for element in link.findall(tag)
            for shape in _shape(element, bodies[str(link.get("name"))], robot.manifest.path)
        ]
        if shapes:
            return tuple(shapes)
    return ()


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
        body = int(mj.geom_bodyid[g]) - 1
        if body >= 0 and int(mj.geom_type[g]) in _GEOMS:
            kind, count = _GEOMS[int(mj.geom_type[g])]
            size = tuple(float(x) for x in mj.geom_size[g][:count])
            yield Shape(body, kind, size, np.array(mj.geom_pos[g]), np.array(mj.geom_quat[g]))


def _shape(element: ET.Element, body: int, model: Path) -> Iterator[Shape]:
    geometry = element.find("geometry")
    if geometry is None:
        return
    origin = element.find("origin")
    try:
        position = _numbers(origin, "xyz", 3)
        quaternion = _quaternion_of_rpy(_numbers(origin, "rpy", 3))
        for kind in geometry:
            if kind.tag == "mesh":
                file = _mesh(str(kind.get("filename", "")), model)
                if file is not None:
                    scale = tuple(_numbers(kind, "scale", 3, default=1.0))
                    yield Shape(body, "mesh", scale, position, quaternion, str(file))
            elif kind.tag == "box":
                half = tuple(0.5 * x for x in _numbers(kind, "size", 3))
                yield Shape(body, "box", half, position, quaternion)
            elif kind.tag == "sphere":
                yield Shape(body, "sphere", (float(kind.get("radius", 0)),), position, quaternion)
            elif kind.tag in ("cylinder", "capsule"):
                size = (float(kind.get("radius", 0)), 0.5 * float(kind.get("length", 0)))
                shape: ShapeKind = "cylinder" if kind.tag == "cylinder" else "capsule"
                yield Shape(body, shape, size, position, quaternion)
    except ValueError:  # a picture without this shape is better than none
        return


def _mesh(written: str, model: Path) -> Path | None:
    """The file of package://NAME/..., file://... or a relative path; None where it does not
    exist."""
    if not written.lower().endswith(_MESHES):
        return None
    if written.startswith("package://"):
        rest = Path(written.removeprefix("package://"))
        candidates = [
            parent / part for parent in model.parents for part in (rest, Path(*rest.parts[1:]))
        ]
    else:
        candidates = [model.parent / written.removeprefix("file://")]
    return next((file for file in candidates if file.is_file()), None)


def _numbers(element: ET.Element | None, key: str, count: int, default: float = 0.0) -> Array:
    text = None if element is None else element.get(key)
    values = np.array([float(word) for word in text.split()]) if text else np.full(count, default)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(text)
    return values


def _quaternion_of_rpy(rpy: Array) -> Array:
    """Quaternion (4,) of roll, pitch, yaw about fixed axes, as in URDF."""
    total = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in enumerate(rpy):
        turn = np.zeros(4)
        turn[0], turn[1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
        total = product(turn, total)
    return total
