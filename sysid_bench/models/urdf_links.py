"""Links of a URDF: their tree, checked, and inertias that no body can have, repaired."""

import math
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.errors import ModelError
from sysid_bench.spatial import inertia_matrix, inertia_values
from sysid_bench.types import Array


@dataclass(frozen=True)
class LinkTree:
    """Links by name, the joints below each link as (child, joint type), and the root link."""

    links: dict[str, ET.Element]
    below: dict[str, list[tuple[str, str]]]
    root: str

    def below_of(self, start: str, rigid: bool = False) -> set[str]:
        """Return a link and all links below it, or those that are fixed to it (`rigid`)."""
        found, pending = {start}, [start]
        while pending:
            below = self.below.get(pending.pop(), [])
            new = {child for child, kind in below if kind == "fixed" or not rigid} - found
            found |= new
            pending += new
        return found


def free_name(name: str, taken: Collection[str]) -> str:
    """The name with as many underscores behind it as make it differ from those taken."""
    while name in taken:
        name += "_"
    return name


def link_tree(robot: ET.Element, name: str) -> LinkTree:
    """Return the tree of a <robot> element.

    Raises ModelError, with the file's `name`, for absent or repeated names, several parents,
    several roots and cycles.
    """
    _check_names(robot, name)
    links = {str(link.get("name")): link for link in robot.findall("link")}
    below: dict[str, list[tuple[str, str]]] = {}
    parents: dict[str, str] = {}
    for joint in robot.findall("joint"):
        parent, child = (_known_link(joint, end, links, name) for end in ("parent", "child"))
        if child in parents:
            raise ModelError(
                f"{name}: link {child!r} has two parents, {parents[child]!r} and {parent!r}."
            )
        parents[child] = parent
        below.setdefault(parent, []).append((child, str(joint.get("type"))))
    if not links:
        raise ModelError(f"{name} has no <link>; a robot needs at least two and a joint.")
    roots = [link for link in links if link not in parents]
    if len(roots) != 1:
        several = f"{len(roots)} root links ({', '.join(roots[:5])})"
        number = several if roots else "no root link: a cycle"
        raise ModelError(f"{name} has {number}; a URDF tree has exactly one.")
    tree = LinkTree(links, below, roots[0])
    # Links that the root does not reach have one parent each, so that they form cycles.
    lost = sorted(set(links) - tree.below_of(tree.root))
    if lost:
        raise ModelError(
            f"{name}: the links {', '.join(lost[:5])} form a cycle apart from {tree.root!r}."
        )
    return tree


def _check_names(robot: ET.Element, name: str) -> None:
    for tag in ("link", "joint"):
        counts = Counter(element.get("name") for element in robot.findall(tag))
        for key, count in counts.items():
            if key is None:
                raise ModelError(f"{name}: a <{tag}> has no name; give it one.")
            if count > 1:
                raise ModelError(
                    f"{name}: {count} <{tag}> elements are called {key!r}; names must differ."
                )


def link_at(joint: ET.Element, end: str) -> str | None:
    """Return the name of the link at an end ("parent" or "child") of a joint, None without one."""
    element = joint.find(end)
    return None if element is None else element.get("link")


def _known_link(joint: ET.Element, end: str, links: dict[str, ET.Element], name: str) -> str:
    link = link_at(joint, end)
    if link is None or link not in links:
        advice = f'add <link name="{link}"/>, or correct the name' if link else f"give it a <{end}>"
        raise ModelError(
            f"{name}: the {end} of joint {joint.get('name')!r} is {link!r}, which is not one of "
            f"its links, so that ROS, MuJoCo and Pinocchio refuse the file: {advice}."
        )
    return link


def finite_value(element: ET.Element, key: str, label: str, default: float | None = None) -> float:
    """The number of an attribute, `default` where it is absent; raises ModelError, with `label`,
    for anything that is not a finite number."""
    text = element.get(key)
    if text is None and default is not None:
        return default
    (value,) = _parsed([text or ""])
    if not math.isfinite(value):
        raise ModelError(f"{label}: {key} is {text!r}; it must be a finite number.")
    return value


def check_numbers(element: ET.Element, key: str, label: str, default: str = "0 0 0") -> None:
    """Raise ModelError, with `label`, for an attribute that is not three finite numbers."""
    text = element.get(key, default)
    numbers = _parsed(text.split())
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise ModelError(
            f"{label}: the {key} of an <{element.tag}> is {text!r}; write three finite numbers."
        )


def _parsed(words: Sequence[str]) -> list[float]:
    """The numbers of words; NaN alone where one of them is not a number."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return [math.nan]


MASSLESS: Final = 1e-9
"""kg; a moving link below it is massless."""

TINY_MASS: Final = 1e-6
"""kg; mass of a massless link that moves, after the repair."""

TINY_MOMENT: Final = 1e-9
"""kg m^2; its principal moments."""

_KEYS: Final = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_SMALLEST: Final = 1.5e-14  # kg m^2; MuJoCo rejects moments below 1e-14
_ROUNDING: Final = 1e-14  # of the largest moment
_UNREPORTED: Final = 1e-12  # of an inertia: a change this small is rounding, not a repair
_LAMINA: Final = 1e-13  # of the largest moment; thickness given to a body without thickness
_MARGIN: Final = 1e-6  # of the largest moment; thickness given to an impossible body


def repair_inertia(robot: ET.Element, tree: LinkTree, name: str, free_base: bool) -> list[str]:
    """Repair the inertias of all links in place; return what was changed, in words.

    Raises ModelError, with the file's `name`, for absent, negative and non-finite values.
    """
    repairs = [repair for link in robot.findall("link") if (repair := _repair_link(link, name))]
    moving = [child for below in tree.below.values() for child, kind in below if kind != "fixed"]
    # A small mass for massless links that move: the mass matrix would be singular.
    for link in [tree.root] * free_base + moving:
        masses = [tree.links[fixed].find("inertial/mass") for fixed in tree.below_of(link, True)]
        if sum(float(mass.get("value", 0.0)) for mass in masses if mass is not None) < MASSLESS:
            repairs.append(_give_mass(tree.links[link], link))
    return repairs


def _repair_link(link: ET.Element, name: str) -> str:
    """Complete and correct the inertial of a link; return this in words, "" for nothing."""
    inertial = link.find("inertial")
    if inertial is None:
        return ""
    label = f"{name}: link {link.get('name')!r}"
    written = inertial.find("mass")
    if written is None:
        raise ModelError(f"{label} has an <inertial> without <mass>; give it a mass in kg.")
    mass = finite_value(written, "value", label)
    if mass < 0:
        raise ModelError(f"{label} has the negative mass {mass}; a mass is in kg and at least 0.")
    # Absent numbers mean zero, and MuJoCo wants to see them.
    element = inertial.find("inertia")
    if element is None:
        element = ET.SubElement(inertial, "inertia", dict.fromkeys(_KEYS, "0"))
    for key in _KEYS:
        value = finite_value(element, key, label, default=0.0)
        element.attrib.setdefault(key, repr(value))
    six = element_inertia(element)
    if not six.any() or (mass > 0 and bool(np.abs(six).max() < _SMALLEST)):
        if mass <= 0:
            return ""
        moment = point_inertia(mass)
        _write_inertia(element, np.array([moment, 0, 0, moment, 0, moment]))
        return f"point mass of link {link.get('name')!r} given the inertia {moment:.2g} kg m^2"
    if is_feasible(six, inertial):
        return ""
    nearest = nearest_feasible(inertia_matrix(six))
    change = np.abs(nearest - inertia_matrix(six)).max() / np.abs(six).max()
    _write_inertia(element, inertia_values(nearest))
    if change <= _UNREPORTED:
        return ""
    return (
        f"inertia of link {link.get('name')!r} made physically possible (largest relative change "
        f"{change:.2g})"
    )


def is_feasible(six: Array, inertial: ET.Element) -> bool:
    """True where the principal moments are positive and keep the triangle inequality."""
    moments = np.linalg.eigvalsh(inertia_matrix(six))
    # MuJoCo diagonalises a tilted lamina, whose principal axes are not those of the link, again and
    # may round its moments beyond the border.
    is_tilted = bool(six[[1, 2, 4]].any()) or inertial.find("origin[@rpy]") is not None
    slack = _ROUNDING * moments[2] if is_tilted else 0.0
    return bool(moments[0] >= _SMALLEST and moments[0] + moments[1] >= moments[2] + slack)


def point_inertia(mass: float) -> float:
    """Principal moments (kg m^2) that the repair gives to a point mass (kg)."""
    return max(_SMALLEST, 1e-6 * mass)


def nearest_feasible(inertia: Array) -> Array:
    """The inertia (3, 3) with negative eigenvalues of its density covariance lifted to a margin.

    The covariance tr(I)/2 1 - I is positive semidefinite iff the inertia is possible (Wensing, Kim,
    Slotine 2018). A lamina, possible but for rounding, is lifted to next to nothing.
    """
    covariance = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    values, vectors = np.linalg.eigh(covariance)
    # Relative margins: the inertia of a microrobot is as good as that of a crane. A lamina has one
    # eigenvalue of zero, up to rounding, and two that are not.
    largest = float(np.abs(inertia).max())
    lamina = values[0] >= -_LAMINA * largest and values[1] >= max(_MARGIN * largest, 2 * _SMALLEST)
    lifted = np.maximum(values, _LAMINA * largest if lamina else max(_MARGIN * largest, _SMALLEST))
    covariance = vectors @ np.diag(lifted) @ vectors.T
    nearest: Array = np.trace(covariance) * np.eye(3) - covariance
    return nearest


def _give_mass(link: ET.Element, name: str) -> str:
    """Replace the inertial parameters of a link by those of a tiny ball; return this in words."""
    inertials = link.findall("inertial")
    inertias = [inertia for inertial in inertials for inertia in inertial.findall("inertia")[:1]]
    weightless = any(bool(element_inertia(inertia).any()) for inertia in inertias)
    for inertial in inertials:
        link.remove(inertial)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", {"xyz": "0 0 0"})
    ET.SubElement(inertial, "mass", {"value": repr(TINY_MASS)})
    _write_inertia(ET.SubElement(inertial, "inertia"), inertia_values(TINY_MOMENT * np.eye(3)))
    lost = "; its inertia left out: without mass there is none" if weightless else ""
    return f"massless moving link {name!r} given {TINY_MASS:.0e} kg{lost}"


def element_inertia(inertia: ET.Element) -> Array:
    return np.array([float(inertia.get(key, 0.0)) for key in _KEYS])


def _write_inertia(element: ET.Element, six: Array) -> None:
    for key, value in zip(_KEYS, six, strict=True):
        element.set(key, repr(float(value)))
