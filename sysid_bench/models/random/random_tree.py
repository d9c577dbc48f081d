"""Random kinematic trees: an MJCF text from a seed, so that only the seed has to be stored."""

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.types import Array

SEVERAL = (
    ("hinge", "hinge"),
    ("slide", "hinge"),
    ("slide", "slide", "hinge"),
    ("hinge", "slide", "hinge"),
    ("slide", "ball"),
)
"""Joints of one body in combinations that MuJoCo compiles: a ball comes last, with three rotations
at most."""

_REACH: Final = {"hinge": 1.0, "slide": 0.2}
"""Scale of random ranges: rad, m."""


@dataclass(frozen=True)
class RandomRobot:
    """Settings of random robots. Ranges are [least, most]; shares are probabilities 0 to 1, per
    body (`branch` to `unnamed`), per joint (`anchored` to `spring`) or per robot (the last)."""

    bodies: tuple[int, int] = (3, 12)
    roots: tuple[int, int] = (1, 2)
    branch: float = 0.25  # the parent is any earlier body, not the last one
    free_root: float = 0.25
    welded: float = 0.15
    ball: float = 0.08
    slide: float = 0.2
    several: float = 0.15  # joints on one body
    shape: float = 0.15  # inertia from a geom
    weightless: float = 0.3  # of welded bodies: frames without mass
    unnamed: float = 0.1
    anchored: float = 0.3  # joint anchor away from the body's origin
    tilted: float = 0.5  # axis along no principal direction
    reference: float = 0.25
    limited: float = 0.3
    armature: float = 0.3
    damping: float = 0.3
    friction: float = 0.2
    spring: float = 0.2
    any_gravity: float = 0.3
    no_gravity: float = 0.05

    def __post_init__(self) -> None:
        for field in fields(self):
            check = _check_range if field.name in ("bodies", "roots") else _check_share
            check(field.name, getattr(self, field.name))


def _check_range(name: str, value: tuple[int, int]) -> None:
    if not 1 <= value[0] <= value[1]:
        raise UsageError(f"{name} must be [least, most], 1 or more; got {value}.")


def _check_share(name: str, value: float) -> None:
    if not 0 <= value <= 1:
        raise UsageError(f"{name} must be a share from 0 to 1; got {value!r}.")


def random_robot(seed: int, settings: RandomRobot = RandomRobot()) -> str:
    """Return the MJCF text of a random tree; the same for the same seed and settings.

    Every inertia is that of a cloud of point masses, every moving body has mass, and at least one
    joint moves. SI units, radians. Raises UsageError for a negative seed.
    """
    if seed < 0:
        raise UsageError(f"A random robot's seed must be 0 or more; got {seed}.")
    return _Draw(np.random.default_rng(seed), settings).text(f"random {seed}")


@dataclass(frozen=True)
class _Body:
    parent: int  # -1: the world
    joints: tuple[str, ...]


@dataclass(frozen=True)
class _Draw:
    """One robot being drawn: every number comes from `rng`, in the order of the text."""

    rng: np.random.Generator
    settings: RandomRobot

    def text(self, name: str) -> str:
        bodies = self.tree()
        return (
            f'<mujoco model="{name}"><compiler angle="radian" autolimits="true"/>'
            f"{self.option()}<worldbody>{''.join(self.below(-1, bodies))}</worldbody></mujoco>"
        )

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def between(self, limits: tuple[int, int]) -> int:
        return int(self.rng.integers(limits[0], limits[1] + 1))

    def tree(self) -> list[_Body]:
        """Parents before children; the first bodies are the roots."""
        count = self.between(self.settings.bodies)
        roots = min(self.between(self.settings.roots), count)
        bodies: list[_Body] = []
        for b in range(count):
            parent = -1 if b < roots else self.parent(b)
            bodies.append(_Body(parent, self.joints(parent < 0)))
        if not any(body.joints for body in bodies):
            bodies[-1] = _Body(bodies[-1].parent, ("hinge",))
        return bodies

    def parent(self, b: int) -> int:
        return int(self.rng.integers(b)) if self.chance(self.settings.branch) else b - 1

    def joints(self, root: bool) -> tuple[str, ...]:
        s = self.settings
        if root and self.chance(s.free_root):
            return ("free",)
        if self.chance(s.welded):
            return ()
        if self.chance(s.several):
            return SEVERAL[int(self.rng.integers(len(SEVERAL)))]
        return (self.kind(),)

    def kind(self) -> str:
        """The type of the only joint of a body."""
        if self.chance(self.settings.ball):
            return "ball"
        return "slide" if self.chance(self.settings.slide) else "hinge"

    def option(self) -> str:
        gravity = np.array([0.0, 0.0, -9.81])
        if self.chance(self.settings.any_gravity):
            gravity = self.rng.normal(size=3) * 6.0
        flag = '<flag gravity="disable"/>' if self.chance(self.settings.no_gravity) else ""
        return f'<option gravity="{_words(gravity)}">{flag}</option>'

    def below(self, parent: int, bodies: list[_Body]) -> Iterator[str]:
        """The elements of the children of a body, and all below them."""
        for b, body in enumerate(bodies):
            if body.parent == parent:
                yield from self.body(b, body)
                yield from self.below(b, bodies)
                yield "</body>"

    def body(self, b: int, body: _Body) -> Iterator[str]:
        """The elements of a body, without its children and its end."""
        name = "" if self.chance(self.settings.unnamed) else f' name="b{b + 1}"'
        yield f'<body{name} pos="{_words(self.rng.normal(size=3) * 0.3)}"{self.turn()}>'
        # Different directions: parallel slides on one body would make the mass matrix singular.
        directions = np.eye(3)[self.rng.permutation(3)]
        for k, kind in enumerate(body.joints):
            name = f"j{b + 1}{'abc'[k] if len(body.joints) > 1 else ''}"
            yield self.joint(kind, name, directions[k])
        yield self.inertia(bool(body.joints))

    def turn(self) -> str:
        """No rotation, a quarter turn about an axis, or a random rotation."""
        choice = self.rng.integers(3)
        if choice == 0:
            return ""
        if choice == 1:
            quarter = np.zeros(4)
            quarter[[0, 1 + int(self.rng.integers(3))]] = 1.0
            return f' quat="{_words(quarter)}"'
        return f' quat="{_words(self.rng.normal(size=4))}"'

    def joint(self, kind: str, name: str, axis: Array) -> str:
        s = self.settings
        words = [] if self.chance(s.unnamed) else [f'name="{name}"']
        words.append(f'type="{kind}"')
        if kind != "free" and self.chance(s.anchored):
            words.append(f'pos="{_words(self.rng.normal(size=3) * 0.2)}"')
        if kind in ("hinge", "slide"):
            words += self.scalar(kind, axis)
        return f"<joint {' '.join([*words, *self.losses()])}/>"

    def losses(self) -> Iterator[str]:
        s = self.settings
        shares = {"armature": s.armature, "damping": s.damping, "frictionloss": s.friction}
        for key, share in shares.items():
            if self.chance(share):
                yield f'{key}="{self.rng.uniform(0.01, 0.4)!r}"'

    def scalar(self, kind: str, axis: Array) -> Iterator[str]:
        s = self.settings
        yield f'axis="{_words(self.rng.normal(size=3) if self.chance(s.tilted) else axis)}"'
        reference = float(self.rng.normal() * 0.3) if self.chance(s.reference) else 0.0
        if reference:  # qpos0 differs from zero: q - qpos0 has to be used
            yield f'ref="{reference!r}"'
        if self.chance(s.limited):
            reach = self.rng.uniform(0.5, 2.5, 2) * _REACH[kind]
            yield f'range="{_words(reference + np.array([-1.0, 1.0]) * reach)}"'
        yield from self.spring()

    def spring(self) -> Iterator[str]:
        if self.chance(self.settings.spring):
            yield f'stiffness="{self.rng.uniform(0.1, 5)!r}"'
            yield f'springref="{self.rng.normal() * 0.3!r}"'

    def inertia(self, moving: bool) -> str:
        s = self.settings
        if not moving and self.chance(s.weightless):
            return ""
        if self.chance(s.shape):
            kind = ("box", "capsule", "ellipsoid", "sphere")[int(self.rng.integers(4))]
            size = _words(self.rng.uniform(0.03, 0.12, 3))
            pose = f'pos="{_words(self.rng.normal(size=3) * 0.1)}"{self.turn()}'
            return f'<geom type="{kind}" size="{size}" {pose}/>'
        # Second moments of a mass distribution: all positive ones are possible, thin plates too.
        x, y, z = 0.01 * np.exp(self.rng.normal(size=3))
        mass = float(0.2 * 25 ** self.rng.random())
        moments = mass * np.array([y + z, x + z, x + y])
        com = _words(self.rng.normal(size=3) * 0.1)
        quat = _words(self.rng.normal(size=4))
        return (
            f'<inertial pos="{com}" quat="{quat}" mass="{mass!r}" diaginertia="{_words(moments)}"/>'
        )


def _words(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)
