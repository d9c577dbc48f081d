"""Random robots: trees of every kind of joint, and couplings of every kind between them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.spatial import quaternion_of_matrix
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
            value = getattr(self, field.name)
            if field.name not in ("bodies", "roots"):
                if not 0 <= value <= 1:
                    raise UsageError(f"{field.name} must be a share from 0 to 1; got {value!r}.")
            elif not 1 <= value[0] <= value[1]:
                raise UsageError(f"{field.name} must be [least, most], 1 or more; got {value}.")


def random_robot(seed: int, settings: RandomRobot = RandomRobot()) -> str:
    """Return the MJCF text of a random tree; the same for the same seed and settings.

    Every inertia is that of a cloud of point masses, every moving body has mass, and at least one
    joint moves. SI units, radians. Raises UsageError for a negative seed.
    """
    if seed < 0:
        raise UsageError(f"A random robot's seed must be 0 or more; got {seed}.")
    return _Draw(np.random.default_rng(seed), settings).text(f"random {seed}")


@dataclass(frozen=True)
class _Draw:
    """One robot being drawn: every number comes from `rng`, in the order of the text."""

    rng: np.random.Generator
    settings: RandomRobot

    def text(self, name: str) -> str:
        bodies, s = self.tree(), self.settings
        gravity = np.array([0.0, 0.0, -9.81])
        if self.chance(s.any_gravity):
            gravity = self.rng.normal(size=3) * 6.0
        flag = '<flag gravity="disable"/>' if self.chance(s.no_gravity) else ""
        return (
            f'<mujoco model="{name}"><compiler angle="radian" autolimits="true"/>'
            f'<option gravity="{_words(gravity)}">{flag}</option>'
            f"<worldbody>{''.join(self.below(-1, bodies))}</worldbody></mujoco>"
        )

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def tree(self) -> list[tuple[int, tuple[str, ...]]]:
        """Parent (-1: the world) and joints of each body, parents before children; the first
        bodies are the roots."""
        s, rng = self.settings, self.rng
        count = int(rng.integers(s.bodies[0], s.bodies[1] + 1))
        roots = min(int(rng.integers(s.roots[0], s.roots[1] + 1)), count)
        bodies: list[tuple[int, tuple[str, ...]]] = []
        for b in range(count):
            parent = -1
            if b >= roots:
                parent = int(rng.integers(b)) if self.chance(s.branch) else b - 1
            bodies.append((parent, self.joints(parent < 0)))
        if not any(joints for _, joints in bodies):
            bodies[-1] = (bodies[-1][0], ("hinge",))
        return bodies

    def joints(self, root: bool) -> tuple[str, ...]:
        s = self.settings
        if root and self.chance(s.free_root):
            return ("free",)
        if self.chance(s.welded):
            return ()
        if self.chance(s.several):
            return SEVERAL[int(self.rng.integers(len(SEVERAL)))]
        if self.chance(s.ball):
            return ("ball",)
        return ("slide" if self.chance(s.slide) else "hinge",)

    def below(self, parent: int, bodies: list[tuple[int, tuple[str, ...]]]) -> Iterator[str]:
        """The elements of the children of a body, and all below them."""
        for b, (above, joints) in enumerate(bodies):
            if above != parent:
                continue
            name = "" if self.chance(self.settings.unnamed) else f' name="b{b + 1}"'
            yield f'<body{name} pos="{_words(self.rng.normal(size=3) * 0.3)}"{self.turn()}>'
            # Different directions: parallel slides on one body would make the mass matrix singular.
            directions = np.eye(3)[self.rng.permutation(3)]
            for k, kind in enumerate(joints):
                name = f"j{b + 1}{'abc'[k] if len(joints) > 1 else ''}"
                yield f"<joint {' '.join(self.joint(kind, name, directions[k]))}/>"
            yield self.inertia(bool(joints))
            yield from self.below(b, bodies)
            yield "</body>"

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

    def joint(self, kind: str, name: str, axis: Array) -> Iterator[str]:
        s, rng = self.settings, self.rng
        if not self.chance(s.unnamed):
            yield f'name="{name}"'
        yield f'type="{kind}"'
        if kind != "free" and self.chance(s.anchored):
            yield f'pos="{_words(rng.normal(size=3) * 0.2)}"'
        if kind in ("hinge", "slide"):
            yield f'axis="{_words(rng.normal(size=3) if self.chance(s.tilted) else axis)}"'
            reference = float(rng.normal() * 0.3) if self.chance(s.reference) else 0.0
            if reference:  # qpos0 differs from zero: q - qpos0 has to be used
                yield f'ref="{reference!r}"'
            if self.chance(s.limited):
                reach = rng.uniform(0.5, 2.5, 2) * _REACH[kind]
                yield f'range="{_words(reference + np.array([-1.0, 1.0]) * reach)}"'
            if self.chance(s.spring):
                yield f'stiffness="{rng.uniform(0.1, 5)!r}"'
                yield f'springref="{rng.normal() * 0.3!r}"'
        shares = {"armature": s.armature, "damping": s.damping, "frictionloss": s.friction}
        for key, share in shares.items():
            if self.chance(share):
                yield f'{key}="{rng.uniform(0.01, 0.4)!r}"'

    def inertia(self, moving: bool) -> str:
        s, rng = self.settings, self.rng
        if not moving and self.chance(s.weightless):
            return ""
        if self.chance(s.shape):
            kind = ("box", "capsule", "ellipsoid", "sphere")[int(rng.integers(4))]
            size = _words(rng.uniform(0.03, 0.12, 3))
            pose = f'pos="{_words(rng.normal(size=3) * 0.1)}"{self.turn()}'
            return f'<geom type="{kind}" size="{size}" {pose}/>'
        second = 0.01 * np.exp(rng.normal(size=3))
        return _inertial(rng, second, float(0.2 * 25 ** rng.random()), 0.1)


def _inertial(rng: np.random.Generator, second: Array, mass: float, reach: float) -> str:
    """Element of a body of this mass (kg) with second moments (3,) per mass (m^2): all positive
    ones are possible, thin plates too. Its centre is some `reach` (m) from the frame."""
    x, y, z = second
    moments = _words(mass * np.array([y + z, x + z, x + y]))
    com, quat = _words(rng.normal(size=3) * reach), _words(rng.normal(size=4))
    return f'<inertial pos="{com}" quat="{quat}" mass="{mass!r}" diaginertia="{moments}"/>'


def _words(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)


_HINGE_AXIS: Final = (0.0, 1.0, 0.0)
"""Axis of the hinges of a mechanism, which lies in the x-z plane of its mount."""


@dataclass(frozen=True, eq=False)
class _Part:
    """A body of a mechanism, with its joint to the parent (None: the mount). `p` and `axis` (3,)
    are in the frame of the mount at the reference posture."""

    name: str
    parent: str | None
    p: Array
    kind: str = "hinge"
    axis: tuple[float, ...] | Array = _HINGE_AXIS
    range: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class _Mechanism:
    """Parts, their couplings (MJCF below <tendon> and <equality>), and the joint with the motor.
    `closures`: (kind, one part, other part, common point), written once the frames are drawn."""

    parts: tuple[_Part, ...]
    motor: str
    equality: str = ""
    tendon: str = ""
    closures: tuple[tuple[str, str, str, Array], ...] = ()


def random_coupled_robot(kind: str, seed: int) -> str:
    """Return the MJCF text of a random robot with a mechanism of this kind; SI units, radians.

    There is no Coulomb friction. Raises UsageError for an unknown kind or a negative seed.
    """
    if kind not in MECHANISMS:
        raise unknown_name("kind of coupled random robot", kind, MECHANISMS)
    if seed < 0:
        raise UsageError(f"A random robot's seed must be 0 or more; got {seed}.")
    rng = np.random.default_rng([seed, list(MECHANISMS).index(kind)])
    mechanism = MECHANISMS[kind](rng)
    # Body frames are turned at random, so that no axis of a joint is one of a frame.
    frames = {part.name: (_rotation(rng), part.p) for part in mechanism.parts}
    # Up to two hinged bodies that carry the mount, with the mechanism inside.
    load = "".join(_children(rng, None, mechanism, frames))
    body = f'<body name="mount" {_pose(_rotation(rng), rng.normal(size=3) * 0.2)}>'
    body += f"{_part_inertial(rng)}{load}</body>"
    for k in range(int(rng.integers(3)), 0, -1):
        joint = f'<joint name="arm{k}" axis="{_words(_direction(rng))}"{_losses(rng)}/>'
        pose = _pose(_rotation(rng), rng.normal(size=3) * 0.2)
        body = f'<body name="arm{k}" {pose}>{joint}{_part_inertial(rng)}{body}</body>'
    equality = mechanism.equality
    for closure, one, other, point in mechanism.closures:
        # MuJoCo wants the common point of a connect in the frame of the first body.
        R, p = frames[one]
        anchor = f' anchor="{_words(R.T @ (point - p))}"' if closure == "connect" else ""
        equality += f'<{closure} body1="{one}" body2="{other}"{anchor}/>'
    return (
        f'<mujoco model="{kind} {seed}"><compiler angle="radian" autolimits="true"/>'
        f"<worldbody>{body}</worldbody><tendon>{mechanism.tendon}</tendon>"
        f"<equality>{equality}</equality>"
        f'<actuator><motor joint="{mechanism.motor}"/></actuator></mujoco>'
    )


def _four_bar(rng: np.random.Generator) -> _Mechanism:
    a, b, c, d = _corners(rng)
    parts = (_Part("crank", None, a), _Part("coupler", "crank", b), _Part("rocker", None, d))
    return _Mechanism(parts, "crank", closures=(("connect", "coupler", "rocker", c),))


def _parallelogram(rng: np.random.Generator) -> _Mechanism:
    """Closed by a weld distal to a fourth hinge: six rows, of which three are redundant in the
    plane."""
    a, b, _, d = _corners(rng)
    c = b + d - a
    parts = (
        _Part("crank", None, a),
        _Part("coupler", "crank", b),
        _Part("rocker", None, d),
        _Part("knuckle", "rocker", c),
    )
    return _Mechanism(parts, "crank", closures=(("weld", "coupler", "knuckle", c),))


def _slider_crank(rng: np.random.Generator) -> _Mechanism:
    a, b = np.zeros(3), _plane(rng.normal(0, 0.02), rng.uniform(0.08, 0.15))
    c = _plane(rng.uniform(0.3, 0.5), rng.normal(0, 0.02))
    parts = (
        _Part("crank", None, a),
        _Part("rod", "crank", b),
        _Part("slider", None, c, "slide", np.array([1.0, 0.0, 0.0])),
    )
    return _Mechanism(parts, "crank", closures=(("connect", "rod", "slider", c),))


def _geared_pair(rng: np.random.Generator) -> _Mechanism:
    drive = _Part("drive", None, rng.normal(size=3) * 0.1, "hinge", _direction(rng))
    mount = "drive" if rng.random() < 0.5 else None
    driven = _Part("driven", mount, rng.normal(size=3) * 0.1, "hinge", _direction(rng))
    ratio = rng.uniform(0.4, 2.5) * rng.choice([-1.0, 1.0])
    bend = float(rng.choice([0.0, 0.2]))
    return _Mechanism((drive, driven), "drive", _joints("driven", "drive", (0.0, ratio, bend)))


def _mimic_gripper(rng: np.random.Generator) -> _Mechanism:
    axis, reach = _direction(rng), float(rng.uniform(0.03, 0.08))
    parts = (
        _Part("left", None, np.array([0.0, 0.02, 0.1]), "slide", axis, (0.0, reach)),
        _Part("right", None, np.array([0.0, -0.02, 0.1]), "slide", -axis, (0.0, reach)),
    )
    return _Mechanism(parts, "left", _joints("right", "left", (0.0, 1.0)))


def _tendon(rng: np.random.Generator) -> _Mechanism:
    """A third joint that follows a sum of two others, as in cable-driven parallelograms."""
    parts = (
        _Part("first", None, rng.normal(size=3) * 0.1),
        _Part("second", "first", rng.normal(size=3) * 0.2),
        _Part("third", None, rng.normal(size=3) * 0.1),
    )
    pulls = rng.uniform(0.4, 1.2, 2)
    tendon = (
        f'<fixed name="pull"><joint joint="first" coef="{float(pulls[0])!r}"/>'
        f'<joint joint="second" coef="{float(pulls[1])!r}"/></fixed>'
        '<fixed name="load"><joint joint="third" coef="1"/></fixed>'
    )
    equality = '<tendon tendon1="load" tendon2="pull" polycoef="0 1 0 0 0"/>'
    return _Mechanism(parts, "first", equality, tendon)


MECHANISMS: Final[dict[str, Callable[[np.random.Generator], _Mechanism]]] = {
    "four-bar": _four_bar,
    "parallelogram": _parallelogram,
    "slider-crank": _slider_crank,
    "geared-pair": _geared_pair,
    "mimic-gripper": _mimic_gripper,
    "tendon": _tendon,
}


def _corners(rng: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    """Corners of a four-bar linkage far from its singular, flat postures."""
    size, jitter = rng.uniform(0.6, 1.5), rng.uniform(-0.03, 0.03, (4, 2))
    points = np.array([[0.0, 0.0], [0.0, 0.18], [0.3, 0.33], [0.38, 0.0]]) + jitter
    a, b, c, d = (_plane(*(size * point)) for point in points)
    return a, b, c, d


def _plane(x: float, z: float) -> Array:
    return np.array([x, 0.0, z])


def _direction(rng: np.random.Generator) -> Array:
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def _rotation(rng: np.random.Generator) -> Array:
    # With a positive diagonal of R, Q is uniform among orthogonal matrices; times its determinant
    # it is a proper rotation.
    Q, R = np.linalg.qr(rng.normal(size=(3, 3)))
    Q = Q * np.sign(np.diag(R))
    R_proper: Array = Q * np.linalg.det(Q)
    return R_proper


def _children(
    rng: np.random.Generator,
    parent: str | None,
    mechanism: _Mechanism,
    frames: dict[str, tuple[Array, Array]],
) -> list[str]:
    R_p, p_p = frames[parent] if parent else (np.eye(3), np.zeros(3))
    texts = []
    for part in mechanism.parts:
        if part.parent != parent:
            continue
        R, p = frames[part.name]
        # At qpos0 = ref the model is drawn: displacements from it must be used, not q itself.
        reference = float(rng.choice([0.0, 0.4]))
        limits = ""
        if part.range is not None:
            limits = f' range="{_words(np.array(part.range) + reference)}"'
        axis = _words(R.T @ np.array(part.axis))
        joint = (
            f'<joint name="{part.name}" type="{part.kind}" axis="{axis}" '
            f'ref="{reference}"{limits}{_losses(rng)}/>'
        )
        inside = "".join(_children(rng, part.name, mechanism, frames))
        pose = _pose(R_p.T @ R, R_p.T @ (p - p_p))
        texts.append(f'<body name="{part.name}" {pose}>{joint}{_part_inertial(rng)}{inside}</body>')
    return texts


def _joints(follower: str, driver: str, polynomial: tuple[float, ...]) -> str:
    coefficients = _words(np.array([*polynomial, 0.0, 0.0, 0.0, 0.0])[:5])
    return f'<joint joint1="{follower}" joint2="{driver}" polycoef="{coefficients}"/>'


def _losses(rng: np.random.Generator) -> str:
    damping = rng.choice([0.0, 0.1]) * rng.uniform(0.5, 1.5)
    armature = rng.choice([0.0, 0.01]) * rng.uniform(0.5, 1.5)
    return f' damping="{float(damping)!r}" armature="{float(armature)!r}"'


def _part_inertial(rng: np.random.Generator) -> str:
    second = 0.004 * np.exp(0.5 * rng.normal(size=3))
    return _inertial(rng, second, float(rng.uniform(0.3, 2.0)), 0.08)


def _pose(R: Array, p: Array) -> str:
    return f'pos="{_words(p)}" quat="{_words(quaternion_of_matrix(R))}"'
