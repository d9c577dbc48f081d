"""Checks of a model: finite numbers, units of a URDF, MuJoCo's warnings, placeholder inertias."""

import math
import warnings
import xml.etree.ElementTree as ET
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, first_names
from sysid_bench.models.tree import FREE, HINGE
from sysid_bench.spatial import body_mass_inertia, gyration
from sysid_bench.types import Array

if TYPE_CHECKING:
    from sysid_bench.models.robot import RobotModel


BEFORE_3_14: Final = tuple(map(int, mujoco.__version__.split(".")[:2])) < (3, 14)
"""MuJoCo that finds the principal axes of a full inertia to 1e-7 only, turns them by the rotation
of a URDF's inertial frame in the wrong order (20 % of the moments; measured with 3.11 to 3.13), and
is silent about singular mass matrices."""

LARGEST: Final = 1e9
"""SI units. No robot is heavier or larger; squares and products of it stay far from overflow."""

LARGEST_TREE: Final = 100_000
"""Bodies times degrees of freedom; Y of 50 states then takes 400 MB."""

LARGEST_TERM: Final = 1e13
"""N m s/rad and the like: public models hold joints still with a damping of 1e11."""

_OF_BODIES: Final = (
    "body_pos", "body_quat", "body_mass", "body_ipos", "body_iquat", "body_inertia"
)  # fmt: skip
_OF_JOINTS: Final = ("jnt_pos", "jnt_axis")
_OF_THE_MODEL: Final = {
    "qpos0": LARGEST, "qpos_spring": LARGEST, "dof_armature": LARGEST, "dof_damping": LARGEST_TERM,
    "dof_frictionloss": LARGEST_TERM, "jnt_stiffness": LARGEST_TERM,
}  # fmt: skip


def check_finite_model(mj: "mujoco.MjModel", name: str) -> None:
    """Raise ModelError, naming the first body or joint, for numbers that are not finite, beyond
    `LARGEST`, or negative where that is impossible."""
    for key in _OF_BODIES:
        _check(mj, key, _wrong(getattr(mj, key)), name)
    for key in _OF_JOINTS:
        _check(mj, key, _wrong(getattr(mj, key)), name)
    for key in ("body_quat", "body_iquat"):
        # A quaternion that overflows when MuJoCo normalises it becomes zero.
        lengths = np.linalg.norm(getattr(mj, key), axis=1)
        _check(mj, key, np.flatnonzero(np.abs(lengths - 1) > 1e-6).tolist(), name)
    for key, largest in _OF_THE_MODEL.items():
        _check(mj, key, _wrong(getattr(mj, key), largest), name, largest)
    for key in ("dof_armature", "dof_damping", "dof_frictionloss"):
        values = np.ravel(getattr(mj, key))
        for i in np.flatnonzero(values < 0).tolist():
            joint = mj.joint(int(mj.dof_jntid[i % mj.nv])).name
            raise ModelError(
                f"{name}: {key.removeprefix('dof_')} of joint {joint!r} is {values[i]:.3g}; it "
                "must not be negative: correct the file."
            )
    if _wrong(mj.opt.gravity[None]):
        raise _error(name, "the model", "gravity", mj.opt.gravity)


def _wrong(values: np.ndarray, largest: float = LARGEST) -> list[int]:
    """Indices of rows with a number that is not finite or too large; NaN compares false."""
    good = np.abs(values.reshape(len(values), -1)) <= largest
    return [int(i) for i in np.flatnonzero(~good.all(axis=1))]


def _check(
    mj: "mujoco.MjModel", key: str, wrong: list[int], name: str, largest: float = LARGEST
) -> None:
    """Raise ModelError for the first of the elements with a wrong value."""
    for i in wrong:
        element, label = "the model", f"{key}[{i}]"
        if key in _OF_BODIES:
            element, label = f"body {mj.body(i).name or i!r}", key
        elif key in _OF_JOINTS:
            element, label = f"joint {mj.joint(i).name or i!r}", key
        raise _error(name, element, label, getattr(mj, key)[i], largest)


def _error(
    name: str, element: str, key: str, value: np.ndarray, largest: float = LARGEST
) -> ModelError:
    return ModelError(
        f"{name}: {key} of {element} is {np.ravel(value).tolist()}; numbers must be finite and at "
        f"most {largest:.0e} in SI units: correct the file."
    )


_RECORDED: deque[str] = deque(maxlen=100)


@contextmanager
def recorded_warnings() -> Iterator[None]:
    """Record, within the context, the warnings that the compiler gives to Python.

    They report mass matrices that are singular at the reference, as with z-x-z hinges on one body:
    not an error by itself.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    _RECORDED.extend(str(warning.message) for warning in caught)


def compile_spec(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel | None, str]:
    """Return the compiled model, its warnings recorded; None with MuJoCo's reason where it refuses
    the spec."""
    try:
        with recorded_warnings():
            return spec.compile(), ""
    except (ValueError, mujoco.FatalError) as error:
        return None, " ".join(str(error).split())


def warnings_from() -> tuple[str, ...]:
    """Return the warnings since the last call, each once."""
    texts = tuple(dict.fromkeys(" ".join(text.split()) for text in _RECORDED))
    _RECORDED.clear()
    return texts


# From now on; a handler that the user has set stays in place.
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(_RECORDED.append)


FAR: Final = 10.0  # m; distance of a centre of mass from its body's frame, or radius of gyration
LONG: Final = 50.0  # m; distance of a body's frame from its parent's
TURNS: Final = 4 * math.pi  # rad; limited hinges stop before
PLACEHOLDER: Final = 1e3  # rad; beyond it a limit means "none", in any unit


def unit_warnings(mj: "mujoco.MjModel") -> Iterator[str]:
    """Yield one warning for each kind of value that looks like millimetres, degrees or g mm^2."""

    def named(bodies: Array) -> str:
        return first_names(mj.body(int(b)).name or "(unnamed)" for b in bodies)

    # 1 / mjMINVAL is what a pivot of zero becomes; rounding may make it negative.
    if BEFORE_3_14 and np.any(~(mj.dof_invweight0 > 0) | (mj.dof_invweight0 > 1e14)):
        yield "the mass matrix is singular at the reference"
    distance = np.linalg.norm(mj.body_pos, axis=1)
    # MuJoCo puts a free body where its joint starts.
    distance[[0, *mj.jnt_bodyid[mj.jnt_type == FREE]]] = 0.0
    apart = np.flatnonzero(distance > LONG)
    if apart.size:
        yield f"{named(apart)} more than {LONG:.0f} m from the parent: is this in mm?"
    heavy = mj.body_mass > 0
    centre = np.where(heavy, np.linalg.norm(mj.body_ipos, axis=1), 0.0)
    away = np.flatnonzero(centre[1:] > FAR) + 1
    if away.size:
        yield (
            f"centre of mass of {named(away)} more than {FAR:.0f} m from the frame: is this in mm?"
        )
    # Radius of gyration sqrt(I / m): the distance of the mass if it were in one point.
    wide = np.flatnonzero((heavy & (mj.body_inertia.max(axis=1) > FAR**2 * mj.body_mass))[1:]) + 1
    if wide.size:
        yield (
            f"inertia of {named(wide)} has a radius of gyration above {FAR:.0f} m: is this in "
            "kg mm^2 or g mm^2?"
        )
    limits = np.abs(mj.jnt_range).max(axis=1, initial=0.0)
    hinges = (mj.jnt_type == HINGE) & (mj.jnt_limited == 1)
    far = np.flatnonzero(hinges & (limits > TURNS) & (limits <= PLACEHOLDER))
    if far.size:
        names = first_names(mj.joint(int(j)).name for j in far)
        yield f"limits of {names} beyond two turns: are they in degrees?"


def urdf_warnings(robot: ET.Element) -> Iterator[str]:
    """Return a warning for origins of a URDF with an angle beyond a turn; its numbers are checked
    before."""
    turned = []
    for part in (*robot.findall("link"), *robot.findall("joint")):
        for origin in (*part.findall("origin"), *part.findall("inertial/origin")):
            angles = map(float, origin.get("rpy", "0").split())
            if max(map(abs, angles)) > 2 * math.pi + 1e-3:
                turned.append(str(part.get("name")))
    if turned:
        yield f"rpy of {first_names(turned)} more than a turn: is this in degrees?"


LIGHTEST: Final = 1e-4
"""kg; a lighter body has no mass that was ever weighed."""

ALIKE: Final = 1e-6
"""Relative difference below which two bodies have the same mass and moments of inertia."""

LEAST_REACH: Final = 0.1
"""m; a single link has no distance between bodies."""

REPEATED, MOST = 3, 0.75
"""Least number and share of the links with the same numbers: limbs of equal modules have fewer."""

UNEQUAL: Final = 1.2
"""Ratio of two link lengths above which the links are not the same part."""


def placeholder_reason(robot: "RobotModel") -> str:
    """Return why the inertial parameters of a robot are not believed; empty where they may be.

    Placeholders are links without mass, the same mass and moments on most links though they differ
    in length, and radii of gyration beyond the reach of the whole robot. The payload and the bodies
    that the manifest calls massless do not count.
    """
    # phi of the links that move and have a mass, welded bodies added to their links.
    own = robot.phi.copy()
    if robot.payload_body is not None:
        own[robot.payload_body] = 0.0
    own[[name in robot.manifest.massless for name in robot.body_names]] = 0.0
    links = robot.tree.link_parameters(own)
    heavy = links[:, 0] > LIGHTEST
    phi, lengths = links[heavy], _link_lengths(robot, len(links))[heavy]
    if len(phi) == 0:
        return "none of its moving links has a mass"
    # The largest group with equal masses and principal moments.
    bodies = [body_mass_inertia(one) for one in phi]
    numbers = np.array([[*np.linalg.eigvalsh(inertia), mass] for mass, _, inertia in bodies])
    apart = np.abs(numbers[:, None] - numbers[None]).max(axis=2)
    alike = apart <= ALIKE * np.abs(numbers).max(axis=1)
    same = alike[alike.sum(axis=1).argmax()]
    many = same.sum() >= max(REPEATED, MOST * len(phi))
    known = lengths[same & (lengths > 0)]
    if many and len(known) > 1 and known.max() > UNEQUAL * known.min():
        return (
            f"{same.sum()} of {len(phi)} moving links have the same mass and moments of inertia, "
            "though their lengths differ"
        )
    # A link reaches at least as far beyond its joint as its centre of mass, the last one as well.
    reach = length(robot) + np.linalg.norm(phi[:, 1:4], axis=1) / phi[:, 0]
    wide = sum(gyration(one) > most for one, most in zip(phi, reach, strict=True))
    if wide:
        return f"{wide} of {len(phi)} moving links have inertia for a size beyond the whole robot"
    return ""


def _link_lengths(robot: "RobotModel", count: int) -> Array:
    """Distances (m) of links to their farthest child, 0 without children."""
    lengths, mj = np.zeros(count), robot.mj
    for child in range(1, mj.nbody):
        parent = int(mj.body_parentid[child]) - 1  # MuJoCo counts the world as body 0
        link = robot.tree.carrier[parent] if parent >= 0 else -1  # -1: the world
        if link >= 0:
            lengths[link] = max(lengths[link], float(np.linalg.norm(mj.body_pos[child])))
    return lengths


def length(robot: "RobotModel") -> float:
    """Sum of the distances (m) from body to body: no point of a chain is farther out."""
    offsets = np.linalg.norm(np.asarray(robot.mj.body_pos)[1:], axis=1)
    return float(max(offsets.sum(), LEAST_REACH))
