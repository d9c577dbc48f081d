"""Robots for laws: the named ones, every jointed URDF of example-robot-data, random MJCF trees."""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

from sysid_bench import package_folders
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.payload import PAYLOADS, Payload
from sysid_bench.models.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, Trajectory

NAMED = tuple(
    sorted(
        path.parent.name for path in package_folders.package_folder("robots").glob("*/robot.toml")
    )
)
"""Robots of `robots/`: a new one runs through all laws by being there."""

MOTIONLESS = ("quadrotor_base.urdf", "iris_simple.urdf")
"""Files of example-robot-data without a joint that moves."""

EMPTY = "ur_description/urdf/ur3.urdf"
"""A file of example-robot-data without any link."""

BODY_JOINTS = (
    ("hinge",),
    ("hinge",),
    ("slide",),
    ("ball",),
    ("hinge", "hinge"),
    ("hinge", "slide", "hinge"),
    ("slide", "slide", "hinge"),
    ("slide", "ball"),
    (),
)
"""Joints of one body, in the mixtures that MuJoCo compiles; () is welded to its parent."""


def urdf_files() -> list[str]:
    """Every URDF of example-robot-data that has a joint, relative to `places`' folder."""
    folder = package_folders.robot_data_folder()
    found = (str(file.relative_to(folder)) for file in sorted(folder.rglob("*.urdf")))
    return [file for file in found if file != EMPTY and not file.endswith(MOTIONLESS)]


def urdf_robot(file: str, free_base: bool = False) -> RobotModel:
    """The robot of a file named by `urdf_files`."""
    return load_robot(package_folders.robot_data_folder() / file, free_base=free_base)


@cache
def named_robot(name: str, payload: str = "none") -> RobotModel:
    """A robot of `robots/`, loaded once for all tests: its arrays are not to be written to."""
    return load_robot(name, PAYLOADS[payload])


def robot_of(
    text: str, payload: Payload = PAYLOADS["none"], free_base: bool = False, tool: str | None = None
) -> RobotModel:
    """The robot of an MJCF or URDF text."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "robot.xml"
        file.write_text(text, encoding="utf-8")
        return load_robot(Manifest("robot", file, tool=tool), payload, free_base)


def states(robot: RobotModel, count: int = 20, seed: int = 0) -> Trajectory:
    """Random states for tests: lively, so that no term is small."""
    return random_states(robot, count, np.random.default_rng(seed))


def relative_gap(ours: Array, theirs: Array) -> float:
    """max |ours - theirs| / max |theirs|; shapes must agree, and NaN stays NaN."""
    assert ours.shape == theirs.shape
    largest = float(np.abs(theirs).max(initial=0.0))
    return float(np.abs(ours - theirs).max(initial=0.0)) / (largest or 1.0)


def random_rotation(rng: np.random.Generator) -> Array:
    """A rotation matrix (3, 3), uniform, made without the package's own quaternions."""
    Q, R = np.linalg.qr(rng.normal(size=(3, 3)))
    Q = Q * np.sign(np.diag(R))
    return Q if np.linalg.det(Q) > 0 else -Q


def random_phi(rng: np.random.Generator, *leading: int) -> Array:
    """Ten numbers (..., 10) of bodies that exist: clouds of eight point masses."""
    masses = rng.uniform(0.1, 2.0, (*leading, 8))
    return cloud_phi(masses, rng.normal(size=(*leading, 8, 3)))


def cloud_phi(masses: Array, points: Array) -> Array:
    """phi (..., 10) of point masses (..., k) at points (..., k, 3), by the definitions alone."""
    x, y, z = np.moveaxis(points, -1, 0)
    moments = [1, x, y, z, y * y + z * z, -x * y, -x * z, x * x + z * z, -y * z, x * x + y * y]
    return np.stack([(masses * moment).sum(axis=-1) for moment in moments], axis=-1)


@dataclass
class _Writer:
    """Writes one random MJCF; mutable, since a tree is drawn while it is written."""

    rng: np.random.Generator
    bodies_left: int
    moving: int = 0
    lines: list[str] = field(default_factory=list)

    def numbers(self, values: Array) -> str:
        return " ".join(repr(float(value)) for value in np.atleast_1d(values))

    def chance(self, p: float) -> bool:
        return bool(self.rng.random() < p)

    def body(self, depth: int) -> None:
        self.bodies_left -= 1
        name = "" if self.chance(0.2) else f'name="b{self.bodies_left}" '
        pose = f'pos="{self.numbers(self.rng.normal(size=3) * 0.4)}"'
        quat = f'quat="{self.numbers(self.rng.normal(size=4))}"'
        self.lines.append(f"<body {name}{pose} {quat}>")
        self.inertial()
        for kind in self.kinds(depth):
            self.joint(kind)
        while self.bodies_left > 0 and self.chance(0.75):
            self.body(depth + 1)
        self.lines.append("</body>")

    def kinds(self, depth: int) -> tuple[str, ...]:
        if depth == 0 and self.chance(0.3):
            return ("free",)
        last = self.bodies_left == 0 and self.moving == 0
        choices = BODY_JOINTS[:1] if last else BODY_JOINTS
        return choices[self.rng.integers(len(choices))]

    def inertial(self) -> None:
        if self.chance(0.1):  # nothing but a frame, or a body that weighs nothing
            self.lines.append('<inertial pos="0 0 0" mass="1e-3" diaginertia="1e-6 1e-6 1e-6"/>')
            return
        x, y, z = self.rng.uniform(0.05, 0.5, 3)
        mass = self.rng.uniform(0.2, 5.0)
        moments = mass * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
        com = self.numbers(self.rng.normal(size=3) * 0.2)
        if self.chance(0.5):
            R = random_rotation(self.rng)
            full = R @ np.diag(moments) @ R.T
            i, j = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)  # MuJoCo's order: xx yy zz xy xz yz
            inertia = f'fullinertia="{self.numbers(full[i, j])}"'
        else:
            quat = self.numbers(self.rng.normal(size=4))
            inertia = f'diaginertia="{self.numbers(moments)}" quat="{quat}"'
        self.lines.append(f'<inertial pos="{com}" mass="{mass!r}" {inertia}/>')

    def joint(self, kind: str) -> None:
        name = "" if self.chance(0.2) else f'name="j{self.moving}" '
        self.moving += 1
        if kind == "free":
            armature = self.rng.uniform(0, 0.5) if self.chance(0.3) else 0.0
            self.lines.append(f'<joint {name}type="free" armature="{armature!r}"/>')
            return
        words = [f'type="{kind}"', f'pos="{self.numbers(self.rng.normal(size=3) * 0.3)}"']
        if kind != "ball":
            words.append(f'axis="{self.numbers(self.rng.normal(size=3))}"')
            words.append(f'ref="{self.rng.normal() * 0.5 * self.chance(0.5)!r}"')
            words.append(f'stiffness="{self.rng.uniform(0, 5) * self.chance(0.3)!r}"')
            words.append(f'springref="{self.rng.normal() * self.chance(0.3)!r}"')
        for key in ("armature", "damping", "frictionloss"):
            words.append(f'{key}="{self.rng.uniform(0, 0.4) * self.chance(0.5)!r}"')
        self.lines.append(f"<joint {name}{' '.join(words)}/>")


def random_mjcf(seed: int, bodies: int = 7) -> str:
    """A random MJCF: hinges, slides, balls, free roots, several joints per body with anchors and
    references, welded bodies between moving ones, several roots, any gravity, some unnamed."""
    rng = np.random.default_rng(seed)
    writer = _Writer(rng, bodies)
    while writer.bodies_left > 0:
        writer.body(0)
    gravity = writer.numbers(rng.normal(size=3) * 6.0)
    flag = '<flag gravity="disable"/>' if writer.chance(0.1) else ""
    return (
        '<mujoco><compiler angle="radian" autolimits="true"/>'
        f'<option gravity="{gravity}">{flag}</option>'
        f"<worldbody>{''.join(writer.lines)}</worldbody></mujoco>"
    )


def random_robot(seed: int, bodies: int = 7) -> RobotModel:
    """The robot of `random_mjcf`."""
    return robot_of(random_mjcf(seed, bodies))


def revolute_tree(seed: int, joints: int) -> RobotModel:
    """A free base with `joints` hinged bodies hung on random bodies of it: one hinge each."""
    rng = np.random.default_rng(seed)
    children: dict[int, list[int]] = {}
    for body in range(1, joints + 1):
        children.setdefault(int(rng.integers(body)), []).append(body)
    return robot_of(f"<mujoco><worldbody>{''.join(_hinged(0, children, rng))}</worldbody></mujoco>")


def _hinged(body: int, children: dict[int, list[int]], rng: np.random.Generator) -> Iterator[str]:
    place = " ".join(map(repr, rng.normal(size=3).tolist()))
    axis = " ".join(map(repr, rng.normal(size=3).tolist()))
    yield f'<body pos="{place}">'
    yield "<freejoint/>" if body == 0 else f'<joint axis="{axis}"/>'
    yield '<inertial pos="0.1 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>'
    for child in children.get(body, []):
        yield from _hinged(child, children, rng)
    yield "</body>"


SCARA = """<mujoco><worldbody><body><joint axis="0 0 1"/>
  <inertial pos="0.2 0 0" mass="2" diaginertia="0.1 0.1 0.1"/>
  <body pos="0.4 0 0"><joint axis="0 0 1"/>
    <inertial pos="0.1 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
    <body pos="0.3 0 0"><joint type="slide" axis="0 0 1"/>
      <inertial pos="0.1 0.1 0" mass="1" diaginertia="0.1 0.1 0.1"/>
      <body><joint axis="0 0 1"/>
        <inertial pos="0.1 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
</body></body></body></body></worldbody></mujoco>"""
"""Two vertical hinges, a vertical slide, a vertical hinge: the shoulder shows its moment, each of
the two next hinges two first moments and a moment, the slide one mass."""
