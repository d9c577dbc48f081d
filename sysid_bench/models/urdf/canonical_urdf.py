"""One canonical text per URDF, given to both engines.

Visual and collision shapes go, fixed links stay, and only links that MuJoCo would reject are
repaired, one by one; each repair is told in words, because it is part of the simulated truth.
"""

import math
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.errors import ModelError
from sysid_bench.models.checks.unit_checks import turned_too_far
from sysid_bench.models.urdf.urdf_joints import canonical_joints
from sysid_bench.models.xml_file import parse_xml
from sysid_bench.spatial.inertia import matrix_of_six, six_of_matrix
from sysid_bench.types import Array

_SIX: Final = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_ROWS, _COLUMNS = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)  # of the six in the matrix
_SMALLEST: Final = 1.5e-14  # kg m^2; MuJoCo rejects moments below 1e-14
_ROUNDING: Final = 1e-14  # of the largest moment
_UNTOLD: Final = 1e-12  # of an inertia: rounding, and no repair
_LAMINA: Final = 1e-13  # of the largest moment; how thick a body without thickness is made
_MARGIN: Final = 1e-6  # of the largest moment; how thick an impossible one is made
MASSLESS: Final = 1e-9  # kg
TINY_MASS: Final = 1e-6  # kg; what a massless body that moves gets
TINY_MOMENT: Final = 1e-9  # kg m^2
_NO_DYNAMICS: Final = (
    "compiler meshdir", "compiler strippath", "compiler discardvisual", "compiler fusestatic"
)  # fmt: skip


@dataclass(frozen=True)
class Mimic:
    """A joint that follows another: q = multiplier * q of `driver` + offset."""

    joint: str
    driver: str | None
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Urdf:
    """A canonical URDF: its text, the repairs in words, and what MuJoCo would not read from it."""

    text: str
    repairs: tuple[str, ...]
    velocity_limits: dict[str, float]  # joint -> rad/s or m/s
    mimic: tuple[Mimic, ...]  # taken out of the text: Pinocchio has no regressor for them


def canonical_urdf(text: str | bytes, name: str, free_base: bool = False) -> Urdf:
    """The canonical text of a URDF; raises ModelError with `name` for what cannot be mended."""
    robot = parse_xml(text, name)
    if robot.tag != "robot":
        raise ModelError(f"{name} is no URDF: its root element is <{robot.tag}>, not <robot>.")
    told = list(_strip(robot))
    tree = _Chain.of(robot, name)
    mimic = tuple(_take_mimic(robot, name))
    if free_base:
        tree = _without_world(robot, tree, name)
    told += _rename_worlds(robot, tree, free_base)
    tree = _Chain.of(robot, name)
    robot.attrib.setdefault("name", "robot")  # Pinocchio insists
    limits = canonical_joints(robot, tree.root, name)
    repairs: list[str] = []
    for link in robot.findall("link"):
        repairs += _repair_inertia(link, name)
    repairs += _give_mass_to_moving(tree, free_base)
    compiler = ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler")
    compiler.set("fusestatic", "false")
    return Urdf(
        ET.tostring(robot, encoding="unicode"),
        (*repairs, *limits, *told, *turned_too_far(robot)),
        _velocities(robot, name),
        mimic,
    )


def _strip(robot: ET.Element) -> Iterator[str]:
    for link in robot.findall("link"):
        for tag in ("visual", "collision"):
            for element in link.findall(tag):
                link.remove(element)
    for section in robot.findall("mujoco"):
        written = [f"{part.tag} {key}" for part in section for key in part.attrib]
        if given := [words for words in written if words not in _NO_DYNAMICS]:
            yield f"of the <mujoco> extension left out: {', '.join(given)}"
    for tag in ("mujoco", "gazebo", "transmission", "material", "sensor"):
        for element in robot.findall(tag):
            robot.remove(element)


@dataclass(frozen=True)
class _Chain:
    """Who hangs on whom: links by name, and the joints below each link."""

    links: dict[str, ET.Element]
    below: dict[str, list[tuple[str, str]]]  # parent -> [(child, joint type)]
    root: str

    @classmethod
    def of(cls, robot: ET.Element, name: str) -> "_Chain":
        for tag in ("link", "joint"):
            counts = Counter(element.get("name") for element in robot.findall(tag))
            for key, count in counts.items():
                if key is None:
                    raise ModelError(f"{name}: a <{tag}> has no name; give it one.")
                if count > 1:
                    raise ModelError(
                        f"{name}: {count} <{tag}> elements are called {key!r}; names must differ."
                    )
        links = {str(link.get("name")): link for link in robot.findall("link")}
        below: dict[str, list[tuple[str, str]]] = {}
        parents: dict[str, str] = {}
        for joint in robot.findall("joint"):
            parent, child = (_end(joint, tag, links, name) for tag in ("parent", "child"))
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
            there = (
                f"{len(roots)} root links ({', '.join(roots[:5])})"
                if roots
                else "no root link: a cycle"
            )
            raise ModelError(f"{name} has {there}; a URDF tree has exactly one.")
        chain = cls(links, below, roots[0])
        reached = chain.reached(roots[0])
        if len(reached) != len(links):
            lost = sorted(set(links) - reached)
            raise ModelError(
                f"{name}: the links {', '.join(lost[:5])} form a cycle apart from {roots[0]!r}."
            )
        return chain

    def reached(self, start: str) -> set[str]:
        seen, todo = {start}, [start]
        while todo:
            for child, _ in self.below.get(todo.pop(), []):
                if child not in seen:
                    seen.add(child)
                    todo.append(child)
        return seen

    def rigid_mass(self, link: str) -> float:
        """Mass (kg) of a link and everything fixed to it."""
        total, todo = 0.0, [link]
        while todo:
            here = todo.pop()
            total += _mass(self.links[here])
            todo += [child for child, kind in self.below.get(here, []) if kind == "fixed"]
        return total


def _end(joint: ET.Element, tag: str, links: dict[str, ET.Element], name: str) -> str:
    element = joint.find(tag)
    link = None if element is None else element.get("link")
    if link is None or link not in links:
        raise ModelError(
            f"{name}: the {tag} of joint {joint.get('name')!r} is {link!r}, which is no link of it."
        )
    return link


def _take_mimic(robot: ET.Element, name: str) -> list[Mimic]:
    taken = []
    for joint in robot.findall("joint"):
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
            label = f"{name}: the mimic of joint {joint.get('name')!r}"
            multiplier = _number(mimic, "multiplier", label, default=1.0)
            offset = _number(mimic, "offset", label, default=0.0)
            taken.append(Mimic(str(joint.get("name")), mimic.get("joint"), multiplier, offset))
    return taken


def _without_world(robot: ET.Element, chain: _Chain, name: str) -> _Chain:
    """A root link called `world` stands for the ground: a floating robot begins below it."""
    kinds = [kind for _, kind in chain.below.get(chain.root, [])]
    weighs = chain.links[chain.root].find("inertial") is not None
    if chain.root != "world" or weighs or kinds not in (["fixed"], ["floating"]):
        return chain
    robot.remove(chain.links["world"])
    for joint in robot.findall("joint"):
        parent = joint.find("parent")
        if parent is not None and parent.get("link") == "world":
            robot.remove(joint)
    return _Chain.of(robot, name)


def _rename_worlds(robot: ET.Element, chain: _Chain, free_base: bool) -> Iterator[str]:
    """MuJoCo takes every link called `world` for the ground: one that moves needs another name."""
    if "world" not in chain.links or (chain.root == "world" and not free_base):
        return
    new = "world_"
    while new in chain.links:
        new += "_"
    chain.links["world"].set("name", new)
    for end in (*robot.findall("joint/parent"), *robot.findall("joint/child")):
        if end.get("link") == "world":
            end.set("link", new)
    yield f"link 'world', which moves, is called {new!r}"


def _repair_inertia(link: ET.Element, name: str) -> list[str]:
    inertial = link.find("inertial")
    if inertial is None:
        return []
    label = f"{name}: link {link.get('name')!r}"
    if inertial.find("mass") is None:
        raise ModelError(f"{label} has an <inertial> without <mass>; give it a mass in kg.")
    mass = _number(inertial.find("mass"), "value", label)
    element = inertial.find("inertia")
    _check_origin(inertial.find("origin"), label)
    if mass < 0:
        raise ModelError(f"{label} has the negative mass {mass}; a mass is in kg and at least 0.")
    if element is None:
        element = ET.SubElement(inertial, "inertia", dict.fromkeys(_SIX, "0"))
    six = np.array([_number(element, key, label, default=0.0) for key in _SIX])
    for key, value in zip(_SIX, six, strict=True):
        if element.get(key) is None:  # absent means zero, and MuJoCo wants to see it
            element.set(key, repr(float(value)))
    moments = np.linalg.eigvalsh(matrix_of_six(six))
    if not six.any() or (mass > 0 and np.abs(six).max() < _SMALLEST):
        return _point_mass(element, mass, link)
    # MuJoCo finds the moments of a tilted lamina again, rounded to either side of the border.
    tilted = six[[1, 2, 4]].any() or inertial.find("origin[@rpy]") is not None
    slack = _ROUNDING * moments[2] if tilted else 0.0
    if moments[0] >= _SMALLEST and moments[0] + moments[1] >= moments[2] + slack:
        return []
    nearest = _nearest_possible(matrix_of_six(six))
    change = np.abs(nearest - matrix_of_six(six)).max() / np.abs(six).max()
    _write_six(element, six_of_matrix(nearest))
    if change <= _UNTOLD:
        return []
    return [
        f"inertia of link {link.get('name')!r} made possible (largest change {change:.2g} of it)"
    ]


def _point_mass(element: ET.Element, mass: float, link: ET.Element) -> list[str]:
    if mass <= 0:
        return []
    moment = max(_SMALLEST, 1e-6 * mass)
    _write_six(element, np.array([moment, 0, 0, moment, 0, moment]))
    return [f"point mass of link {link.get('name')!r} given the inertia {moment:.2g} kg m^2"]


def _nearest_possible(inertia: Array) -> Array:
    """The inertia with the negative eigenvalues of its density covariance lifted to a margin: to
    next to nothing for a lamina, which is possible but for rounding."""
    covariance = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    values, vectors = np.linalg.eigh(covariance)
    # Relative to what is there: a microrobot's inertia is as good as a crane's.
    largest = float(np.abs(inertia).max())
    lamina = values[0] >= -_LAMINA * largest and values[1] >= max(_MARGIN * largest, 2 * _SMALLEST)
    lifted = np.maximum(values, _LAMINA * largest if lamina else max(_MARGIN * largest, _SMALLEST))
    covariance = vectors @ np.diag(lifted) @ vectors.T
    return np.trace(covariance) * np.eye(3) - covariance


def _give_mass_to_moving(chain: _Chain, free_base: bool) -> Iterator[str]:
    moving = [child for below in chain.below.values() for child, kind in below if kind != "fixed"]
    for name in [chain.root] * free_base + moving:
        if chain.rigid_mass(name) >= MASSLESS:
            continue
        link = chain.links[name]
        weightless = any(_has_moments(inertial) for inertial in link.findall("inertial"))
        for inertial in link.findall("inertial"):
            link.remove(inertial)
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "origin", {"xyz": "0 0 0"})
        ET.SubElement(inertial, "mass", {"value": repr(TINY_MASS)})
        _write_six(ET.SubElement(inertial, "inertia"), TINY_MOMENT * np.eye(3)[_ROWS, _COLUMNS])
        lost = "; its inertia, which nothing without mass can have, left out" if weightless else ""
        yield f"massless moving link {name!r} given {TINY_MASS:.0e} kg{lost}"


def _has_moments(inertial: ET.Element) -> bool:
    inertia = inertial.find("inertia")
    return inertia is not None and any(float(inertia.get(key, 0.0)) for key in _SIX)


def _mass(link: ET.Element) -> float:
    element = link.find("inertial/mass")
    return 0.0 if element is None else float(element.get("value", 0.0))


def _number(
    element: ET.Element | None, key: str, label: str, default: float | None = None
) -> float:
    text = None if element is None else element.get(key)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ModelError(f"{label}: {key} is {text!r}; it must be a finite number.")
    return value


def _check_origin(origin: ET.Element | None, label: str) -> None:
    for key in ("xyz", "rpy"):
        words = "0 0 0" if origin is None else origin.get(key, "0 0 0")
        try:
            good = len(words.split()) == 3 and all(
                math.isfinite(float(word)) for word in words.split()
            )
        except ValueError:
            good = False
        if not good:
            raise ModelError(
                f"{label}: the inertial origin's {key} is {words!r}; write three finite numbers."
            )


def _write_six(element: ET.Element, six: Array) -> None:
    for key, value in zip(_SIX, six, strict=True):
        element.set(key, repr(float(value)))


def _velocities(robot: ET.Element, name: str) -> dict[str, float]:
    found = {}
    for joint in robot.findall("joint"):
        limit = joint.find("limit")
        label = f"{name}: joint {joint.get('name')!r}"
        for key in ("lower", "upper", "effort", "velocity"):
            if limit is not None and limit.get(key) is not None:
                _number(limit, key, label)
        if limit is not None and float(limit.get("velocity", 0.0)) > 0:
            found[str(joint.get("name"))] = float(limit.get("velocity", 0.0))
        _check_origin(joint.find("origin"), label)
    return found
