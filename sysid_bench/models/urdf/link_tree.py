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

    def descendants(self, start: str) -> set[str]:
        """A link and all links below it."""
        found, pending = {start}, [start]
        while pending:
            for child, _ in self.below.get(pending.pop(), []):
                if child not in found:
                    found.add(child)
                    pending.append(child)
        return found

    def rigid_mass(self, link: str) -> float:
        """Mass (kg) of a link and of everything that is fixed to it."""
        total, pending = 0.0, [link]
        while pending:
            name = pending.pop()
            element = self.links[name].find("inertial/mass")
            total += 0.0 if element is None else float(element.get("value", 0.0))
            pending += [child for child, kind in self.below.get(name, []) if kind == "fixed"]
        return total


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
        parent, child = (_end(joint, tag, links, name) for tag in ("parent", "child"))
        if child in parents:
            raise ModelError(
                f"{name}: link {child!r} has two parents, {parents[child]!r} and {parent!r}."
            )
        parents[child] = parent
        below.setdefault(parent, []).append((child, str(joint.get("type"))))
    tree = LinkTree(links, below, _root(links, parents, name))
    reached = tree.descendants(tree.root)
    if len(reached) != len(links):
        lost = sorted(set(links) - reached)
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


def _root(links: dict[str, ET.Element], parents: dict[str, str], name: str) -> str:
    if not links:
        raise ModelError(f"{name} has no <link>; a robot needs at least two and a joint.")
    roots = [link for link in links if link not in parents]
    if len(roots) == 1:
        return roots[0]
    found = (
        f"{len(roots)} root links ({', '.join(roots[:5])})" if roots else "no root link: a cycle"
    )
    raise ModelError(f"{name} has {found}; a URDF tree has exactly one.")


def _end(joint: ET.Element, tag: str, links: dict[str, ET.Element], name: str) -> str:
    element = joint.find(tag)
    link = None if element is None else element.get("link")
    if link is None or link not in links:
        raise ModelError(
            f"{name}: the {tag} of joint {joint.get('name')!r} is {link!r}, which is not one of "
            "its links."
        )
    return link
