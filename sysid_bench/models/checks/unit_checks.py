"""Unit warnings: values that are possible but suggest a wrong unit. They are never changed."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Final

import numpy as np

from sysid_bench.errors import first_names
from sysid_bench.models.tree import FREE, HINGE

if TYPE_CHECKING:
    import mujoco

FAR: Final = 10.0  # m; distance of a centre of mass from its body's frame, or radius of gyration
LONG: Final = 50.0  # m; distance of a body's frame from its parent's
TURNS: Final = 4 * math.pi  # rad; limited hinges stop before
PLACEHOLDER: Final = 1e3  # rad; beyond it a limit means "none", in any unit


def unit_warnings(mj: "mujoco.MjModel") -> tuple[str, ...]:
    """Return one warning for each kind of value that looks like millimetres, degrees or g mm^2."""
    return (*_lengths(mj), *_inertias(mj), *_ranges(mj))


def _lengths(mj: "mujoco.MjModel") -> Iterator[str]:
    distance = np.linalg.norm(mj.body_pos, axis=1)
    distance[[0, *_free_bodies(mj)]] = 0.0  # MuJoCo puts a free body where its joint starts
    apart = np.flatnonzero(distance > LONG)
    if apart.size:
        yield f"{_named(mj, apart)} more than {LONG:.0f} m from the parent: is this in mm?"
    centre = np.where(mj.body_mass > 0, np.linalg.norm(mj.body_ipos, axis=1), 0.0)
    away = np.flatnonzero(centre[1:] > FAR) + 1
    if away.size:
        yield (
            f"centre of mass of {_named(mj, away)} more than {FAR:.0f} m from the frame: "
            "is this in mm?"
        )


def _free_bodies(mj: "mujoco.MjModel") -> list[int]:
    return list(mj.jnt_bodyid[mj.jnt_type == FREE])


def _inertias(mj: "mujoco.MjModel") -> Iterator[str]:
    """By the radius of gyration sqrt(I / m): the distance of the mass if it were in one point."""
    heavy = mj.body_mass > 0
    wide = np.flatnonzero((heavy & (mj.body_inertia.max(axis=1) > FAR**2 * mj.body_mass))[1:]) + 1
    if wide.size:
        yield (
            f"inertia of {_named(mj, wide)} has a radius of gyration above {FAR:.0f} m: is this in "
            "kg mm^2 or g mm^2?"
        )


def _ranges(mj: "mujoco.MjModel") -> Iterator[str]:
    limits = np.abs(mj.jnt_range).max(axis=1, initial=0.0)
    hinges = (mj.jnt_type == HINGE) & (mj.jnt_limited == 1)
    wide = np.flatnonzero(hinges & (limits > TURNS) & (limits <= PLACEHOLDER))
    if wide.size:
        names = first_names(mj.joint(int(j)).name for j in wide)
        yield f"limits of {names} beyond two turns: are they in degrees?"


def urdf_warnings(robot: ET.Element) -> Iterator[str]:
    """Return a warning for origins of a URDF with an angle beyond a turn; its numbers are checked
    before."""
    parts = (*robot.findall("link"), *robot.findall("joint"))
    turned = [str(part.get("name")) for part in parts for _ in _turned_origins(part)]
    if turned:
        yield f"rpy of {first_names(turned)} more than a turn: is this in degrees?"


def _turned_origins(part: ET.Element) -> Iterator[ET.Element]:
    """Origins of a link or joint with an angle of more than a turn."""
    for origin in (*part.findall("origin"), *part.findall("inertial/origin")):
        angles = map(float, origin.get("rpy", "0").split())
        if max(map(abs, angles)) > 2 * math.pi + 1e-3:
            yield origin


def _named(mj: "mujoco.MjModel", bodies: Iterable[int]) -> str:
    return first_names(mj.body(int(b)).name or "(unnamed)" for b in bodies)
