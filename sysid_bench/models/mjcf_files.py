"""Limits of an MJCF: files it may include and elements it may expand to, checked before MuJoCo.

Files that are read together with the text must lie in one folder. A text, with all that it
includes, must not expand to more elements than any robot has.
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
from sysid_bench.input_files import is_file
from sysid_bench.models.model_checks import LARGEST_TREE
from sysid_bench.models.xml_file import LARGEST_FILE, parse_xml, read_file

MOST_ELEMENTS: Final = 20_000
"""After <replicate> and the like; of 295 public models the largest has 902."""

MOST_FILES: Final = 200
"""Files of one model, and inclusions of them; public robots have a few dozen."""

MOST_CELLS: Final = 10_000_000
"""Cells of a height field."""

MOST_NUMBERS: Final = 10_000
"""Numbers that <size> reserves for each element."""

FINEST_MESH: Final = 1_000
"""Subdivisions of a mesh that MuJoCo generates."""

_READ_AT_ONCE: Final = ("include", "model", "flexcomp")
"""Elements whose `file` is read with the text; meshes and textures are read by the compiler."""

_REPEATED: Final = ("replicate", "flexcomp", "composite")
_NAMING: Final = frozenset({"default", "equality", "tendon", "actuator", "sensor", "contact"})
"""Sections in which <joint> and the like refer to an element instead of creating one."""


def check_files(path: Path, text: bytes, folder: Path | None = None) -> None:
    """Raise ModelError for a file that does not exist, lies outside `folder` (None: that of `path`)
    or includes itself, and for a text that expands to too many elements, included files counted."""
    _Reading(path, folder or path.parent).count_model(path, parse_xml(text, path.name))


def is_file_of(path: Path, folder: Path) -> bool:
    """True where a file lies in a folder, links followed."""
    return _resolved(path).is_relative_to(folder.resolve())


def _resolved(path: Path) -> Path:
    return Path(os.path.realpath(path))  # Path.resolve raises for links in a loop


def folder_text(path: Path, file: Path) -> str:
    """Advice, in words, for a file outside the folder of a model `path`."""
    common = os.path.commonpath([path.resolve().parent, _resolved(file)])
    above = os.path.relpath(common, path.resolve().parent)
    return (
        "outside the model's folder, where nothing is read; put it into that folder, or "
        "name the folder that holds both: 'FILE?assets=DIR', or "
        f'assets = "{above}" (from the folder of {path.name}) in a robot.toml'
    )


@dataclass
class _Reading:
    """One model with its included files; mutable, since each file is read only once."""

    path: Path
    folder: Path
    files: dict[tuple[Path, Path], Counter[str]] = field(default_factory=dict)  # by model, file
    models: dict[Path, Counter[str]] = field(default_factory=dict)
    open: list[Path] = field(default_factory=list)  # files that are being read
    bytes: int = 0

    def count_model(self, path: Path, root: ET.Element) -> Counter[str]:
        """Counts of elements, bodies, joints and inclusions of a model, attached models
        included."""
        key = _resolved(path)
        if key not in self.models:
            attached: dict[str, Path] = {}
            weight = Counter(self._count_file(path, root, path, attached))
            for name, file in attached.items():
                # An attached model counts once for each <attach>, copies of the <attach> included.
                self._add(weight, self.models[file.resolve()], weight[f"attach {name}"])
            self.models[key] = weight
        return self.models[key]

    def _count_file(
        self, path: Path, root: ET.Element | None, model: Path, attached: dict[str, Path]
    ) -> Counter[str]:
        """The same counts of one file of `model`; collects the models that it may attach, by
        name."""
        key = _resolved(path)
        if key in self.open:
            raise ModelError(f"{path.name} includes itself through other files: a cycle.")
        if (model, key) not in self.files:
            self.open.append(key)
            weight: Counter[str] = Counter()
            self._add(weight, Counter(bytes=path.stat().st_size if is_file(path) else 0), 1)
            for element, copies, tags in _expanded(self._parse(path) if root is None else root):
                _check_sizes(element, path.name)
                made = Counter(elements=1)
                if element.tag == "attach":
                    made[f"attach {element.get('model')}"] = 1
                # Every point of a soft flexcomp is a body with three slides.
                soft = element.tag == "flexcomp" and element.get("rigid") != "true"
                soft = soft and element.get("dof", "full") == "full"
                if not tags & _NAMING:
                    jointed = element.tag in ("joint", "freejoint", "composite")
                    made["bodies"] = int(element.tag in ("body", "composite") or soft)
                    made["joints"] = int(jointed) + 3 * soft
                self._add(weight, made, copies)
                for file in self._find(element, path, model):
                    self._add(weight, self._included(element, file, model, attached), copies)
            self.files[model, key] = weight
            self.open.pop()
        return self.files[model, key]

    def _included(
        self, element: ET.Element, file: Path, model: Path, attached: dict[str, Path]
    ) -> Counter[str]:
        """Counts of a file where an element names it."""
        if element.tag == "include":
            return self._count_file(file, None, model, attached) + Counter(inclusions=1)
        if element.tag == "model":
            root = self._parse(file)
            attached[element.get("name", root.get("model", ""))] = file
            self.count_model(file, root)
        else:
            self._add_size(file)
        return Counter()

    def _find(self, element: ET.Element, path: Path, model: Path) -> list[Path]:
        """The files of an element that are read with the text: MuJoCo looks in the folders of the
        model and of the including file. Raises ModelError for one outside the folder, and for
        none."""
        name = element.get("file")
        if name is None or element.tag not in _READ_AT_ONCE:
            return []
        files = [folder / name for folder in (model.parent, path.parent)]
        # By their resolved path: links to one file count once, and one inside may lead outside.
        found = {file.resolve(): file for file in files if is_file(file)}
        label = f"<{element.tag} file={name!r}>"
        if Path(name).is_absolute() or not all(is_file_of(file, self.folder) for file in found):
            advice = folder_text(self.path, next(iter(found), Path(name)))
            raise ModelError(f"{path.name}: {label} lies {advice}.")
        if not found:
            raise ModelError(f"{path.name}: the file of {label} does not exist.")
        return list(found.values())

    def _parse(self, path: Path) -> ET.Element:
        self._add_size(path)
        return parse_xml(read_file(path), path.name)

    def _add_size(self, path: Path) -> None:
        self.bytes += path.stat().st_size
        self._check_size(self.bytes)

    def _check_size(self, size: int) -> None:
        if size > LARGEST_FILE:
            raise ModelError(
                f"{self.path.name} and its included files have {size} bytes together; "
                f"{LARGEST_FILE} are allowed at most."
            )

    def _add(self, weight: Counter[str], more: Counter[str], copies: int) -> None:
        """Add counts in place; raises ModelError beyond the limits."""
        for key, count in more.items():
            weight[key] += copies * count
        # Checked after each addition: copies of copies grow beyond any memory before the end.
        if max(weight["inclusions"], len(self.files) + len(self.open)) > MOST_FILES:
            raise ModelError(
                f"{self.path.name} includes files more than {MOST_FILES} times; simplify the model."
            )
        self._check_size(weight["bytes"])
        if weight["elements"] > MOST_ELEMENTS:
            raise ModelError(
                f"{self.path.name} expands to more than {MOST_ELEMENTS} elements; "
                "simplify the model."
            )
        if weight["bodies"] * weight["joints"] > LARGEST_TREE:
            raise ModelError(
                f"{self.path.name} expands to at least {weight['bodies']} bodies and "
                f"{weight['joints']} joints (degrees of freedom at least); their product "
                f"may be {LARGEST_TREE} at most."
            )


def _expanded(root: ET.Element) -> Iterator[tuple[ET.Element, int, frozenset[str]]]:
    """Every element with its number of copies, due to it and its ancestors, and the tags of its
    ancestors; without recursion, for deep texts."""
    nothing: frozenset[str] = frozenset()
    waiting = [(root, 1, nothing)]
    while waiting:
        element, copies, above = waiting.pop()
        if element.tag in _REPEATED:
            # The default grid of a flexcomp; one with a file has as many points as the file says.
            grid = element.tag == "flexcomp" and element.get("file") is None
            numbers = _numbers(element, "count", "10 10 10" if grid else "1")
            copies *= math.prod(min(max(int(n), 0), MOST_ELEMENTS + 1) for n in numbers)
        yield element, copies, above
        below = above | {element.tag} if element.tag in _NAMING else above
        # Below a count of zero nothing is made, but files are read and sizes reserved all the same.
        waiting += [(child, max(copies, 1), below) for child in element]


def _check_sizes(element: ET.Element, name: str) -> None:
    """Refuse numbers that alone make MuJoCo reserve memory or compute at length."""
    sizes, limit = [0.0], 0
    if element.tag == "hfield":
        cells = (*_numbers(element, "nrow", "0"), *_numbers(element, "ncol", "0"))
        sizes, limit = [math.prod(cells)], MOST_CELLS
    elif element.tag == "size":
        keys = [key for key in element.attrib if key.startswith(("nuser", "nkey"))]
        sizes, limit = [math.prod(_numbers(element, key, "0")) for key in keys], MOST_NUMBERS
    elif element.tag == "mesh" and element.get("builtin") is not None:
        sizes, limit = _numbers(element, "params", "0"), FINEST_MESH
    largest = max(sizes, default=0.0)
    if largest > limit:
        raise ModelError(
            f"{name}: <{element.tag}> asks for the size {largest:.3g}; {limit} is allowed at "
            "most: correct the file."
        )


def _numbers(element: ET.Element, key: str, default: str) -> list[float]:
    """The numbers of an attribute; anything else is left to MuJoCo, which reports the error."""
    try:
        found = [float(word) for word in element.get(key, default).split()]
    except ValueError:
        return [1.0]
    # An infinite count would not convert to an integer.
    return [max(min(number, 1e300), -1e300) for number in found if not math.isnan(number)]
