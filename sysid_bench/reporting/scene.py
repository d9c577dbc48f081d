"""The robot of a recording: bodies that move, their shapes, sticks where a body has none."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import rerun as rr

from sysid_bench.errors import first_names
from sysid_bench.types import CellData, Shape

MESH_BUDGET: Final = 5_000_000  # bytes of all meshes of one recording
_MESH_SUFFIXES: Final = (".stl", ".obj", ".glb", ".gltf", ".dae")
_XYZW: Final = (1, 2, 3, 0)  # MuJoCo writes w first, Rerun last
_BODY, _STICK, _JOINT, _PAYLOAD = (
    (148, 163, 184), (100, 116, 139), (37, 99, 235), (234, 120, 30),
)  # fmt: skip
_SHORTEST_STICK = 1e-6  # m


@dataclass(frozen=True, eq=False)
class RecordingScene:
    """Drawable shapes of a cell, and the reasons why others cannot be drawn."""

    cell: CellData
    shapes: tuple[Shape, ...]
    complaints: tuple[str, ...]

    @property
    def bodies_without_shape(self) -> list[int]:
        """Bodies that have nothing to draw: they become joints and sticks."""
        dressed = {shape.body for shape in self.shapes}
        return [i for i in range(len(self.cell.bodies)) if i not in dressed]


def scene_of(cell: CellData) -> RecordingScene:
    """Meshes count only where all of them exist, can be read and fit into `MESH_BUDGET` bytes."""
    complaints = tuple(_complaints([Path(s.file) for s in cell.shapes if s.kind == "mesh"]))
    # A robot that is half drawn misleads more than sticks do: one bad mesh drops all of them.
    drawn = [shape for shape in cell.shapes if shape.kind != "mesh" or not complaints]
    return RecordingScene(cell, tuple(drawn), complaints)


def _complaints(files: Sequence[Path]) -> Iterator[str]:
    """Reasons why mesh files cannot be drawn."""
    unreadable = [file.name for file in files if file.suffix.lower() not in _MESH_SUFFIXES]
    if unreadable:
        yield f"{first_names(unreadable)}: no format that the viewer reads."
    lost = [one.name for one in files if one.name not in unreadable and not one.is_file()]
    if lost:
        yield f"{first_names(lost)}: no such file."
    size = sum(file.stat().st_size for file in files if file.is_file())
    if size > MESH_BUDGET:
        yield f"The meshes have {size / 1e6:.1f} MB, above {MESH_BUDGET / 1e6:g} MB."


def log_scene(
    stream: rr.RecordingStream, scene: RecordingScene, picked: np.ndarray, times: rr.TimeColumn
) -> None:
    """Logs the samples `picked` of the robot: `robot/<body>` and, for bare bodies, `sticks`."""
    cell = scene.cell
    if cell.positions is None or cell.quaternions is None:
        return
    stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    positions = cell.positions[picked]
    quaternions = cell.quaternions[picked][..., _XYZW]
    # Poses move over time; shapes hang on them and are logged once.
    for i, path in enumerate(_body_paths(cell.bodies)):
        pose = rr.Transform3D.columns(translation=positions[:, i], quaternion=quaternions[:, i])
        stream.send_columns(path, indexes=[times], columns=pose)
    for number, shape in enumerate(scene.shapes):
        _log_shape(stream, cell, shape, number)
    _log_sticks(stream, scene, positions, times)


def _body_paths(bodies: Sequence[str]) -> list[str]:
    """Entity paths of the bodies; names may hold spaces, slashes and dots."""
    return [rr.new_entity_path(["robot", name or f"body{i}"]) for i, name in enumerate(bodies)]


def _log_shape(stream: rr.RecordingStream, cell: CellData, shape: Shape, number: int) -> None:
    path = f"{_body_paths(cell.bodies)[shape.body]}/shape{number}"
    scale = shape.size if shape.kind == "mesh" else None
    colour = _PAYLOAD if "payload" in cell.bodies[shape.body].lower() else _BODY
    pose = rr.Transform3D(
        translation=shape.position,
        quaternion=rr.Quaternion(xyzw=np.asarray(shape.quaternion)[[*_XYZW]]),
        scale=scale,
    )
    stream.log(path, pose, _geometry(shape, colour), static=True)


def _geometry(shape: Shape, colour: tuple[int, int, int]) -> rr.AsComponents:
    size, solid = shape.size, rr.components.FillMode.Solid
    if shape.kind == "mesh":
        return rr.Asset3D(path=shape.file, albedo_factor=colour)
    if shape.kind == "box":
        return rr.Boxes3D(half_sizes=[size], colors=[colour], fill_mode=solid)
    if shape.kind == "cylinder":
        length = 2 * size[1]
        return rr.Cylinders3D(lengths=[length], radii=[size[0]], colors=[colour], fill_mode=solid)
    if shape.kind == "capsule":
        # Rerun's capsule starts at the origin and grows along +z; ours is centred.
        return rr.Capsules3D(
            lengths=[2 * size[1]], radii=[size[0]], colors=[colour], fill_mode=solid,
            translations=[(0, 0, -size[1])],
        )  # fmt: skip
    half = size if shape.kind == "ellipsoid" else (size[0],) * 3
    return rr.Ellipsoids3D(half_sizes=[half], colors=[colour], fill_mode=solid)


def _log_sticks(
    stream: rr.RecordingStream, scene: RecordingScene, positions: np.ndarray, times: rr.TimeColumn
) -> None:
    """Thick lines between the origins of bare bodies and their neighbours, balls at the joints."""
    # A fortieth of the robot's reach: visible for a finger and for a crane.
    first = positions[0]
    reach = float(np.linalg.norm(first - first.mean(axis=0), axis=1).max()) if len(first) else 0.0
    radius = max(reach, 0.05) / 40
    for i in scene.bodies_without_shape:
        ball = rr.Points3D([(0, 0, 0)], radii=[1.6 * radius], colors=[_JOINT])
        stream.log(f"{_body_paths(scene.cell.bodies)[i]}/joint", ball, static=True)
    bare = set(scene.bodies_without_shape)
    moved = np.ptp(positions, axis=0).max(axis=-1, initial=0.0)
    # A root that stands still is joined to the world (-1); a floating base is not.
    pairs = [
        (child, parent)
        for child, parent in enumerate(scene.cell.parents)
        if bare & {child, parent} and (parent >= 0 or moved[child] < _SHORTEST_STICK)
    ]
    if not pairs:
        return
    at = np.insert(positions, 0, 0.0, axis=1)  # the world comes first
    ends = np.stack([at[:, [parent + 1, child + 1]] for child, parent in pairs], axis=1)
    style = rr.LineStrips3D.from_fields(radii=[radius], colors=[_STICK])
    stream.log("sticks", style, static=True)
    strips = rr.LineStrips3D.columns(strips=ends.reshape(-1, 2, 3))
    stream.send_columns(
        "sticks", indexes=[times], columns=strips.partition([len(pairs)] * len(positions))
    )
