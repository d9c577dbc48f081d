"""Recognition of placeholder inertias: numbers that a file holds because its format wants some."""

from typing import TYPE_CHECKING, Final

import numpy as np

from sysid_bench.spatial import body_mass_inertia, gyration
from sysid_bench.types import Array

if TYPE_CHECKING:
    from sysid_bench.models.robot import RobotModel

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
    phi, lengths = _moving(robot)
    if len(phi) == 0:
        return "none of its moving links has a mass"
    same = _largest_group(phi)
    many = same.sum() >= max(REPEATED, MOST * len(phi))
    if many and _differ(lengths[same]):
        return (
            f"{same.sum()} of {len(phi)} moving links have the same mass and moments of inertia, "
            "though their lengths differ"
        )
    reach = length(robot)
    wide = sum(gyration(one) > reach for one in phi)
    if wide:
        return f"{wide} of {len(phi)} moving links have inertia for a size beyond the whole robot"
    return ""


def _moving(robot: "RobotModel") -> tuple[Array, Array]:
    """phi (k, 10) of the links that move and have a mass, welded bodies added to their links, and
    the distances (k,) to their farthest child; 0 of a link without children."""
    own = robot.phi.copy()
    if robot.payload_body is not None:
        own[robot.payload_body] = 0.0
    own[[name in robot.manifest.massless for name in robot.body_names]] = 0.0
    links = robot.tree.link_parameters(own)
    lengths = np.zeros(len(links))
    mj = robot.mj
    for child in range(1, mj.nbody):
        parent = int(mj.body_parentid[child]) - 1  # MuJoCo counts the world as body 0
        link = robot.tree.carrier[parent] if parent >= 0 else -1  # -1: the world
        if link >= 0:
            lengths[link] = max(lengths[link], float(np.linalg.norm(mj.body_pos[child])))
    heavy = links[:, 0] > LIGHTEST
    return links[heavy], lengths[heavy]


def _largest_group(phi: Array) -> Array:
    """Mask (k,) of the largest group with equal masses and principal moments."""
    numbers = np.array([_numbers(one) for one in phi])
    scale = np.abs(numbers).max(axis=1)
    apart = np.abs(numbers[:, None] - numbers[None]).max(axis=2)
    alike = apart <= ALIKE * scale
    return np.asarray(alike[alike.sum(axis=1).argmax()])


def _differ(lengths: Array) -> bool:
    """True if some links with children differ in length."""
    known = lengths[lengths > 0]
    return len(known) > 1 and bool(known.max() > UNEQUAL * known.min())


def _numbers(phi: Array) -> Array:
    """Mass and principal moments of inertia about the centre of mass (4,)."""
    mass, _, inertia = body_mass_inertia(phi)
    return np.append(np.linalg.eigvalsh(inertia), mass)


def length(robot: "RobotModel") -> float:
    """Sum of the distances (m) from body to body: no point of a chain is farther out."""
    offsets = np.linalg.norm(np.asarray(robot.mj.body_pos)[1:], axis=1)
    return float(max(offsets.sum(), LEAST_REACH))
