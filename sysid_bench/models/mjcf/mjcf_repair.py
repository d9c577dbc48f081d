"""Faults of MJCF files that other programs read over, mended where MuJoCo refuses the file.

Attributes of settings that MuJoCo no longer has (`apirate`, `collision`) have no effect on the
dynamics; of repeated meshes, textures and materials the first is used, and a shape, site, camera or
light keeps no name that another one has. An <inertial> without a position lies in the frame of its
body, as Pinocchio reads it.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from sysid_bench.input_files import is_file
from sysid_bench.models.xml_file import parse_xml, read_file

_UNKNOWN: Final = re.compile(r"unrecognized attribute: '([^']+)'\s*Element '([^']+)'")
_SETTINGS: Final = ("option", "flag", "default", "size", "map", "global", "quality", "statistic")
"""Elements whose unknown attributes concern the solver, the viewer or memory."""
_ASSETS: Final = ("mesh", "texture", "material")
_PARTS: Final = ("geom", "site", "camera", "light")
"""Elements of bodies that are not needed by name, since a reference reaches the first one."""
_WITH_FILES: Final = ("model", "flexcomp")
"""Elements with files that are read from the folder of the text, which a changed text has not."""


def repair_mjcf(path: Path, text: bytes, error: str) -> tuple[str, tuple[str, ...]]:
    """Return a text, included files in it, without what MuJoCo's `error` complains of, and the
    changes in words; none where it cannot be mended."""
    root = element_tree(path, text)
    if any(next(root.iter(tag), None) is not None for tag in _WITH_FILES):
        return "", ()
    repairs = (
        *_without_attribute(root, error),
        *_without_repeats(root, error),
        *_without_repeated_names(root, error),
        *_with_positions(root, error),
    )
    return ET.tostring(root, encoding="unicode"), repairs


def element_tree(path: Path, text: bytes) -> ET.Element:
    """Return the root of a model with the elements of all files that it includes, which MuJoCo
    looks for in the folders of the model and of the including file."""
    root = parse_xml(text, path.name)
    _include(root, path, path.parent)
    return root


def _include(element: ET.Element, path: Path, folder: Path) -> None:
    """Replace the <include> elements below `element`, which is of the file `path`."""
    for child in [part for part in element if part.tag == "include"]:
        files = [place / child.get("file", "") for place in (folder, path.parent)]
        file = next(filter(is_file, files), files[0])
        inner = parse_xml(read_file(file), file.name)
        _include(inner, file, folder)
        place = list(element).index(child)
        element.remove(child)
        for k, part in enumerate(inner):
            element.insert(place + k, part)
    for child in element:
        _include(child, path, folder)


def _without_attribute(root: ET.Element, error: str) -> Iterator[str]:
    """Remove an unknown attribute of settings, wherever it stands; yield this in words."""
    found = _UNKNOWN.search(error)
    if found is None or found[2] not in _SETTINGS:
        return
    for element in root.iter(found[2]):
        element.attrib.pop(found[1], None)
    yield f"unknown attribute {found[1]!r} of <{found[2]}> left out"


def _without_repeats(root: ET.Element, error: str) -> Iterator[str]:
    """Remove repeated assets; yield this in words."""
    if "repeated name" not in error:
        return
    known: set[tuple[str, str]] = set()
    for section in root.findall("asset"):
        for asset in _repeated(section, _ASSETS, known):
            section.remove(asset)
            yield f"repeated {asset.tag} {asset.get('name')!r}: the first is used"


def _without_repeated_names(root: ET.Element, error: str) -> Iterator[str]:
    """Remove the names of shapes, sites, cameras and lights that others before them have; yield
    this in words."""
    if "repeated name" not in error:
        return
    known: set[tuple[str, str]] = set()
    for section in root.findall("worldbody"):
        for part in _repeated(section.iter(), _PARTS, known):
            name = part.attrib.pop("name")
            yield f"repeated name of {part.tag} {name!r}: the first keeps it"


def _repeated(
    parts: Iterable[ET.Element], tags: tuple[str, ...], known: set[tuple[str, str]]
) -> Iterator[ET.Element]:
    """Yield the elements of these kinds whose name is `known`, and add the names of the others."""
    # A list, since elements are removed while they are gone through.
    for part in [part for part in parts if part.tag in tags and part.get("name")]:
        key = (part.tag, part.get("name", ""))
        if key in known:
            yield part
        known.add(key)


def _with_positions(root: ET.Element, error: str) -> Iterator[str]:
    """Give every <inertial> without a position the origin of its body; yield this in words."""
    if "attribute missing: 'pos'" not in error or "'inertial'" not in error:
        return
    for body in root.iter("body"):
        for inertial in body.findall("inertial"):
            if "pos" not in inertial.attrib:
                inertial.set("pos", "0 0 0")
                yield f"<inertial> of body {body.get('name', '')!r} without position: at its origin"
