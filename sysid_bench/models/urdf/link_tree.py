"""Links of a URDF as a tree: names checked, the root link found, masses of rigid groups."""

import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import dataclass

from sysid_bench.errors import ModelError


@dataclass(frozen=True)
class LinkTree:
    """Links by name, the joints below each link as (child, joint type), and the root link."""

    links: dict[str, ET.Element]
    below: dict[str, list[tuple[str, str]]]
    root: str

    def subtree(self, start: str) -> set[str]:
        """A link and all links below it."""
        found, pending = {start}, [start]
        while pending:
            below = {child for child, _ in self.below.get(pending.pop(), [])} - found
            found |= below
            pending += below
        return found

    def rigid_mass(self, link: str) -> float:
        """Mass (kg) of a link and of everything that is fixed to it."""
        total, pending = 0.0, [link]
        while pending:
            name = pending.pop()
            element = self.links[name].find("inertial/mass")
            total += 0.0 if element is None else float(element.get("value", 0.0))
            pending += self._fixed_to(name)
        return total

    def _fixed_to(self, link: str) -> list[str]:
        return [child for child, kind in self.below.get(link, []) if kind == "fixed"]


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
        _check_one_parent(child, parent, parents, name)
        parents[child] = parent
        below.setdefault(parent, []).append((child, str(joint.get("type"))))
    tree = LinkTree(links, below, _root(links, parents, name))
    _check_connected(tree, name)
    return tree


def link_at(joint: ET.Element, end: str) -> str | None:
    """Return the name of the link at an end ("parent" or "child") of a joint, None without one."""
    element = joint.find(end)
    return None if element is None else element.get("link")


def _check_names(robot: ET.Element, name: str) -> None:
    for tag in ("link", "joint"):
        counts = Counter(element.get("name") for element in robot.findall(tag))
        for key, count in counts.items():
            _check_name(tag, key, count, name)


def _check_name(tag: str, key: str | None, count: int, name: str) -> None:
    """Raise ModelError for an element without a name, or for one of several with the same."""
    if key is None:
        raise ModelError(f"{name}: a <{tag}> has no name; give it one.")
    if count > 1:
        raise ModelError(f"{name}: {count} <{tag}> elements are called {key!r}; names must differ.")


def _root(links: dict[str, ET.Element], parents: dict[str, str], name: str) -> str:
    """The one link without a parent."""
    if not links:
        raise ModelError(f"{name} has no <link>; a robot needs at least two and a joint.")
    roots = [link for link in links if link not in parents]
    if len(roots) != 1:
        raise ModelError(f"{name} has {_count_text(roots)}; a URDF tree has exactly one.")
    return roots[0]


def _count_text(roots: list[str]) -> str:
    if not roots:
        return "no root link: a cycle"
    return f"{len(roots)} root links ({', '.join(roots[:5])})"


def _check_one_parent(child: str, parent: str, parents: dict[str, str], name: str) -> None:
    if child in parents:
        raise ModelError(
            f"{name}: link {child!r} has two parents, {parents[child]!r} and {parent!r}."
        )


def _check_connected(tree: LinkTree, name: str) -> None:
    """Raise ModelError for links that the root does not reach. Each has one parent, so that they
    form cycles."""
    lost = sorted(set(tree.links) - tree.subtree(tree.root))
    if lost:
        raise ModelError(
            f"{name}: the links {', '.join(lost[:5])} form a cycle apart from {tree.root!r}."
        )


def _known_link(joint: ET.Element, end: str, links: dict[str, ET.Element], name: str) -> str:
    link = link_at(joint, end)
    if link is None or link not in links:
        advice = f'add <link name="{link}"/>, or correct the name' if link else f"give it a <{end}>"
        raise ModelError(
            f"{name}: the {end} of joint {joint.get('name')!r} is {link!r}, which is not one of "
            f"its links, so that ROS, MuJoCo and Pinocchio refuse the file: {advice}."
        )
    return link
