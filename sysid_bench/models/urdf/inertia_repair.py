"""Inertia repair of a URDF: physically impossible inertias, point masses, massless moving links.

MuJoCo refuses what cannot exist; Pinocchio takes it. Each repair is part of the simulated truth and
is reported in words.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from typing import Final

import numpy as np

from sysid_bench.errors import ModelError
from sysid_bench.models.urdf.link_tree import LinkTree
from sysid_bench.models.urdf.xml_values import finite_value
from sysid_bench.spatial import inertia_matrix, inertia_values
from sysid_bench.types import Array

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
    repairs = [text for link in robot.findall("link") for text in _repair_link(link, name)]
    return [*repairs, *_give_mass_to_moving(tree, free_base)]


def _repair_link(link: ET.Element, name: str) -> list[str]:
    inertial = link.find("inertial")
    if inertial is None:
        return []
    mass, element = _checked(inertial, f"{name}: link {link.get('name')!r}")
    six = element_inertia(element)
    if _is_point_mass(six, mass):
        return _repair_point_mass(element, mass, link)
    if is_feasible(six, inertial):
        return []
    return _repair_inertia(element, six, link)


def _checked(inertial: ET.Element, label: str) -> tuple[float, ET.Element]:
    """Mass (kg) and <inertia> element of an <inertial>, with all six numbers written."""
    written = inertial.find("mass")
    if written is None:
        raise ModelError(f"{label} has an <inertial> without <mass>; give it a mass in kg.")
    mass = finite_value(written, "value", label)
    if mass < 0:
        raise ModelError(f"{label} has the negative mass {mass}; a mass is in kg and at least 0.")
    return mass, _complete_inertia(inertial, label)


def _complete_inertia(inertial: ET.Element, label: str) -> ET.Element:
    """The <inertia> element with its six numbers: absent means zero, and MuJoCo wants to see it."""
    element = inertial.find("inertia")
    if element is None:
        element = ET.SubElement(inertial, "inertia", dict.fromkeys(_KEYS, "0"))
    for key in _KEYS:
        value = finite_value(element, key, label, default=0.0)
        element.attrib.setdefault(key, repr(value))
    return element


def is_feasible(six: Array, inertial: ET.Element) -> bool:
    """True where the principal moments are positive and keep the triangle inequality."""
    moments = np.linalg.eigvalsh(inertia_matrix(six))
    # MuJoCo diagonalises a tilted lamina again and may round its moments beyond the border.
    slack = _ROUNDING * moments[2] if _is_tilted(six, inertial) else 0.0
    return bool(moments[0] >= _SMALLEST and moments[0] + moments[1] >= moments[2] + slack)


def _is_tilted(six: Array, inertial: ET.Element) -> bool:
    """True where the principal axes may differ from those of the link."""
    return bool(six[[1, 2, 4]].any()) or inertial.find("origin[@rpy]") is not None


def _repair_inertia(element: ET.Element, six: Array, link: ET.Element) -> list[str]:
    nearest = nearest_feasible(inertia_matrix(six))
    change = np.abs(nearest - inertia_matrix(six)).max() / np.abs(six).max()
    _write_inertia(element, inertia_values(nearest))
    if change <= _UNREPORTED:
        return []
    return [
        f"inertia of link {link.get('name')!r} made physically possible (largest relative change "
        f"{change:.2g})"
    ]


def _is_point_mass(six: Array, mass: float) -> bool:
    return not six.any() or (mass > 0 and bool(np.abs(six).max() < _SMALLEST))


def _repair_point_mass(element: ET.Element, mass: float, link: ET.Element) -> list[str]:
    if mass <= 0:
        return []
    moment = point_inertia(mass)
    _write_inertia(element, np.array([moment, 0, 0, moment, 0, moment]))
    return [f"point mass of link {link.get('name')!r} given the inertia {moment:.2g} kg m^2"]


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


def _give_mass_to_moving(tree: LinkTree, free_base: bool) -> Iterator[str]:
    """Give massless links that move a small mass: the mass matrix would be singular."""
    for name in [tree.root] * free_base + _moving_links(tree):
        if tree.rigid_mass(name) < MASSLESS:
            yield _give_mass(tree.links[name], name)


def _moving_links(tree: LinkTree) -> list[str]:
    return [child for below in tree.below.values() for child, kind in below if kind != "fixed"]


def _give_mass(link: ET.Element, name: str) -> str:
    """Replace the inertial parameters of a link by those of a tiny ball; return this in words."""
    inertials = link.findall("inertial")
    weightless = any(map(_has_moments, inertials))
    for inertial in inertials:
        link.remove(inertial)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", {"xyz": "0 0 0"})
    ET.SubElement(inertial, "mass", {"value": repr(TINY_MASS)})
    _write_inertia(ET.SubElement(inertial, "inertia"), inertia_values(TINY_MOMENT * np.eye(3)))
    lost = "; its inertia left out: without mass there is none" if weightless else ""
    return f"massless moving link {name!r} given {TINY_MASS:.0e} kg{lost}"


def _has_moments(inertial: ET.Element) -> bool:
    inertia = inertial.find("inertia")
    return inertia is not None and bool(element_inertia(inertia).any())


def element_inertia(inertia: ET.Element) -> Array:
    return np.array([float(inertia.get(key, 0.0)) for key in _KEYS])


def _write_inertia(element: ET.Element, six: Array) -> None:
    for key, value in zip(_KEYS, six, strict=True):
        element.set(key, repr(float(value)))
