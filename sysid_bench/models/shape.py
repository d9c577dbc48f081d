"""Visual shapes of URDF links and MuJoCo geoms, for pictures alone."""

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

import mujoco
import numpy as np

from sysid_bench.input_files import is_file
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.xml_file import parse_xml, read_file
from sysid_bench.spatial import urdf_quaternion
from sysid_bench.types import Array, Shape, ShapeKind

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
        name = str(link.get("name"))
        if name in bodies:
            for element in link.findall(tag):
                yield from _element_shapes(element, bodies[name], path)


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


def _element_shapes(element: ET.Element, body: int, model: Path) -> Iterator[Shape]:
    origin = element.find("origin")
    with suppress(ValueError):  # a picture without this shape is better than none
        position = _numbers(origin, "xyz", 3)
        quaternion = urdf_quaternion(_numbers(origin, "rpy", 3))
        for geometry in element.findall("geometry[1]/*"):
            file = _mesh_file(geometry, model)
            if geometry.tag in _URDF_SIZES and file is not None:
                kind, size = _URDF_SIZES[geometry.tag]
                yield Shape(body, kind, size(geometry), position, quaternion, file)


def _mesh_scale(mesh: ET.Element) -> tuple[float, ...]:
    return tuple(_numbers(mesh, "scale", 3, default=1.0))


def _half_lengths(box: ET.Element) -> tuple[float, ...]:
    return tuple(0.5 * x for x in _numbers(box, "size", 3))


def _radius(sphere: ET.Element) -> tuple[float, ...]:
    return (float(sphere.get("radius", 0)),)


def _radius_and_half_length(cylinder: ET.Element) -> tuple[float, ...]:
    # URDF states full lengths, MuJoCo and `Shape` half of them.
    return (float(cylinder.get("radius", 0)), 0.5 * float(cylinder.get("length", 0)))


_URDF_SIZES: Final[dict[str, tuple[ShapeKind, Callable[[ET.Element], tuple[float, ...]]]]] = {
    "mesh": ("mesh", _mesh_scale),
    "box": ("box", _half_lengths),
    "sphere": ("sphere", _radius),
    "cylinder": ("cylinder", _radius_and_half_length),
    "capsule": ("capsule", _radius_and_half_length),
}
"""Kind of each URDF geometry, and the reader of its size."""


def _mesh_file(geometry: ET.Element, model: Path) -> str | None:
    """The file of a mesh, written as package://NAME/..., file://... or a relative path; None where
    it does not exist, empty for other geometries."""
    if geometry.tag != "mesh":
        return ""
    written = str(geometry.get("filename", ""))
    files = _candidates(written, model) if written.lower().endswith(_MESHES) else []
    return next((str(file) for file in files if is_file(file)), None)


def _candidates(written: str, model: Path) -> list[Path]:
    if not written.startswith("package://"):
        return [model.parent / written.removeprefix("file://")]
    # The folder of the package is searched above the model, with its name and without.
    rest = Path(written.removeprefix("package://"))
    parts = (rest, Path(*rest.parts[1:]))
    return [parent / part for parent in model.parents for part in parts]


def _numbers(element: ET.Element | None, key: str, count: int, default: float = 0.0) -> Array:
    text = "" if element is None else element.get(key, "")
    values = np.array([float(word) for word in text.split()]) if text else np.full(count, default)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(text)
    return values
