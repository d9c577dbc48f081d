"""What an MJCF text may make MuJoCo read and build, looked at before MuJoCo sees it.

Files that are pulled in while the text is read must lie in one folder; a text, with all that it
pulls in as often as it does, must not stand for more elements than any robot has.
"""

import math
import os
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from sysid_bench.errors import ModelError
from sysid_bench.models.checks.finite_checks import LARGEST_TREE
from sysid_bench.models.xml_file import LARGEST_FILE, parse_xml

MOST_ELEMENTS: Final = 20_000
"""After <replicate> and the like; of 295 public models the largest has 902."""

MOST_FILES: Final = 200
"""Different files of one model, and inclusions of them; public robots have a few dozen."""

MOST_CELLS: Final = 10_000_000
"""Of a height field."""

MOST_NUMBERS: Final = 10_000
"""That <size> reserves for each element."""

FINEST_MESH: Final = 1_000
"""Subdivisions of a mesh that MuJoCo makes itself."""

_READ_AT_ONCE: Final = ("include", "model", "flexcomp")
"""Elements whose `file` is read while the text is; meshes and textures wait for the compiler."""

_REPEATED: Final = ("replicate", "flexcomp", "composite")
_NAMING: Final = frozenset({"default", "equality", "tendon", "actuator", "sensor", "contact"})
"""Where <joint> and the like name something instead of making it."""


def check_files(path: Path, text: bytes, folder: Path | None = None) -> None:
    """Raises ModelError for a file that is absent, lies outside of `folder` (of `path`, if none is
    given) or includes itself, and for a text that stands for too much; what it pulls in counts."""
    _Reading(path, folder or path.parent).model(path, parse_xml(text, path.name))


def is_inside(path: Path, folder: Path) -> bool:
    """Whether a file lies in a folder, links followed."""
    return path.resolve().is_relative_to(folder.resolve())


def files_outside(path: Path, file: Path) -> str:
    """What to do about a file outside of the folder of a model `path`, in words."""
    common = os.path.commonpath([path.resolve().parent, file.resolve()])
    above = os.path.relpath(common, path.resolve().parent)
    return (
        "outside of the model's folder, and nothing is read there; put it into that folder, or "
        "name the folder that holds both: crosscheck --assets DIR, or "
        f'assets = "{above}" (from the folder of {path.name}) in a robot.toml'
    )


@dataclass
class _Reading:
    """One model with all that it pulls in; mutable, since every file is looked into once."""

    path: Path
    folder: Path
    files: dict[tuple[Path, Path], Counter[str]] = field(default_factory=dict)  # by model, file
    models: dict[Path, Counter[str]] = field(default_factory=dict)
    open: list[Path] = field(default_factory=list)  # files that are being looked into
    bytes: int = 0

    def model(self, path: Path, root: ET.Element) -> Counter[str]:
        """How many elements, bodies, joints and inclusions a model stands for, with all that it
        attaches."""
        key = path.resolve()
        if key not in self.models:
            attached: dict[str, Path] = {}
            weight = Counter(self.file(path, root, path, attached))
            for name, file in attached.items():
                self.add(weight, self.models[file.resolve()], weight[f"attach {name}"])
            self.models[key] = weight
        return self.models[key]

    def file(
        self, path: Path, root: ET.Element | None, model: Path, attached: dict[str, Path]
    ) -> Counter[str]:
        """The same of one file of `model`; notes the models that it may attach, by their names."""
        key = path.resolve()
        if key in self.open:
            raise ModelError(f"{path.name} is pulled in by what it pulls in itself: a cycle.")
        if (model, key) not in self.files:
            self.open.append(key)
            weight: Counter[str] = Counter()
            self.add(weight, Counter(bytes=path.stat().st_size if path.is_file() else 0), 1)
            for element, copies, tags in _expanded(self.parsed(path) if root is None else root):
                _check_sizes(element, path.name)
                self.add(weight, _makes(element, tags), copies)
                if element.tag in _READ_AT_ONCE and element.get("file") is not None:
                    for file in self.found(element, path, model):
                        self.add(weight, self.pulled(element, file, model, attached), copies)
            self.open.pop()
            self.files[model, key] = weight
        return self.files[model, key]

    def pulled(
        self, element: ET.Element, file: Path, model: Path, attached: dict[str, Path]
    ) -> Counter[str]:
        """What a file stands for where an element names it."""
        if element.tag == "include":
            return self.file(file, None, model, attached) + Counter(inclusions=1)
        if element.tag == "model":
            root = self.parsed(file)
            attached[element.get("name", root.get("model", ""))] = file
            self.model(file, root)
        else:
            self.weigh(file)
        return Counter()

    def found(self, element: ET.Element, path: Path, model: Path) -> list[Path]:
        """MuJoCo looks beside the model and beside the including file: none may lie outside."""
        name = element.get("file", "")
        told = f"<{element.tag} file={name!r}>"
        files = [place / name for place in (model.parent, path.parent)]
        there = {file.resolve(): file for file in files if file.is_file()}
        if Path(name).is_absolute() or any(not is_inside(file, self.folder) for file in there):
            lies = files_outside(self.path, next(iter(there), Path(name)))
            raise ModelError(f"{path.name}: {told} lies {lies}.")
        if not there:
            raise ModelError(f"{path.name}: the file of {told} is not there.")
        return list(there.values())

    def parsed(self, path: Path) -> ET.Element:
        self.weigh(path)
        return parse_xml(path.read_bytes(), path.name)

    def weigh(self, path: Path) -> None:
        self.bytes += path.stat().st_size
        if self.bytes > LARGEST_FILE:
            raise self.too_long(self.bytes)

    def too_long(self, size: int) -> ModelError:
        return ModelError(
            f"{self.path.name} and the files that it pulls in have {size} bytes together; no robot "
            "text is that long."
        )

    def add(self, weight: Counter[str], more: Counter[str], copies: int) -> None:
        """Adds in place, and stops where it is too much."""
        for key, count in more.items():
            weight[key] += copies * count
        if max(weight["inclusions"], len(self.files) + len(self.open)) > MOST_FILES:
            raise ModelError(
                f"{self.path.name} pulls in files more than {MOST_FILES} times; no robot needs "
                "that."
            )
        if weight["bytes"] > LARGEST_FILE:
            raise self.too_long(weight["bytes"])
        if weight["elements"] > MOST_ELEMENTS:
            raise ModelError(
                f"{self.path.name} stands for more than {MOST_ELEMENTS} elements; no robot is that "
                "large."
            )
        if weight["bodies"] * weight["joints"] > LARGEST_TREE:
            raise ModelError(
                f"{self.path.name} stands for {weight['bodies']} bodies or more, with "
                f"{weight['joints']} joints or more (degrees of freedom at least); their product "
                f"may be {LARGEST_TREE} at most."
            )


def _makes(element: ET.Element, above: frozenset[str]) -> Counter[str]:
    """What one element stands for, by itself, below elements of these tags."""
    made = Counter(elements=1)
    if element.tag == "attach":
        made[f"attach {element.get('model')}"] = 1
    soft = element.tag == "flexcomp" and _is_soft(element)
    if not above & _NAMING:
        made["bodies"] = int(element.tag in ("body", "composite") or soft)
        made["joints"] = int(element.tag in ("joint", "freejoint", "composite")) + 3 * soft
    return made


def _is_soft(flexcomp: ET.Element) -> bool:
    """Whether every point of it is a body with three slides."""
    return flexcomp.get("rigid") != "true" and flexcomp.get("dof", "full") == "full"


def _expanded(root: ET.Element) -> Iterator[tuple[ET.Element, int, frozenset[str]]]:
    """Every element with how often it comes, as it and its ancestors are repeated, and with the
    tags of its ancestors; no recursion, for deep texts."""
    nothing: frozenset[str] = frozenset()
    waiting = [(root, 1, nothing)]
    while waiting:
        element, copies, above = waiting.pop()
        copies *= _count(element) if element.tag in _REPEATED else 1
        yield element, copies, above
        below = above | {element.tag} if element.tag in _NAMING else above
        waiting += [(child, max(copies, 1), below) for child in element]


def _count(element: ET.Element) -> int:
    usual = "10 10 10" if element.tag == "flexcomp" and element.get("file") is None else "1"
    numbers = _numbers(element, "count", usual)
    return math.prod(min(max(int(n), 0), MOST_ELEMENTS + 1) for n in numbers)


def _check_sizes(element: ET.Element, name: str) -> None:
    """Refuses numbers that make MuJoCo reserve memory or compute, with nothing in the text."""
    if element.tag == "hfield":
        sizes, limit = [_product(element, "nrow", "ncol")], MOST_CELLS
    elif element.tag == "size":
        keys = [key for key in element.attrib if key.startswith("nuser") or key == "nkey"]
        sizes, limit = [_product(element, key) for key in keys], MOST_NUMBERS
    elif element.tag == "mesh" and element.get("builtin") is not None:
        sizes, limit = _numbers(element, "params", "0"), FINEST_MESH
    else:
        return
    if max(sizes, default=0.0) > limit:
        raise ModelError(
            f"{name}: <{element.tag}> asks for the size {max(sizes):.3g}, {limit} at most; no "
            "robot needs that: correct the file."
        )


def _product(element: ET.Element, *keys: str) -> float:
    return math.prod(math.prod(_numbers(element, key, "0")) for key in keys)


def _numbers(element: ET.Element, key: str, usual: str) -> list[float]:
    """The numbers of an attribute; what is none is left to MuJoCo, who says what is wrong."""
    try:
        found = [float(word) for word in element.get(key, usual).split()]
    except ValueError:
        return [1.0]
    return [min(number, 1e300) for number in found if not math.isnan(number)]
