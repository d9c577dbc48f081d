"""What an MJCF text may make MuJoCo read and build, looked at before MuJoCo sees it.

Files that are pulled in while the text is read must lie in the model's folder; a text must not
stand for more elements than any robot has.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from sysid_bench.errors import ModelError
from sysid_bench.models.urdf import parse_xml

MOST_ELEMENTS: Final = 200_000
"""After <replicate> and the like; the largest public robots have a few thousand."""

_READ_AT_ONCE: Final = ("include", "model", "flexcomp")
"""Elements whose `file` is read while the text is; meshes and textures wait for the compiler."""


def check_files(path: Path, text: bytes) -> None:
    """Raises ModelError for a file that is absent, lies outside of the folder of `path` or includes
    itself, and for a text that stands for too many elements; included files are looked into."""
    _check_file(path, text, path, ())


def inside(path: Path, folder: Path) -> bool:
    """Whether a file lies in a folder, links followed."""
    return path.resolve().is_relative_to(folder.resolve())


def _check_file(path: Path, text: bytes, model: Path, above: tuple[Path, ...]) -> None:
    root = parse_xml(text, path.name)
    _check_size(root, path.name)
    for element in root.iter():
        name = element.get("file")
        if element.tag not in _READ_AT_ONCE or name is None:
            continue
        file = _found(element.tag, name, path, model)
        if file.resolve() in (path.resolve(), *above):
            raise ModelError(f"{path.name} includes {name!r}, which includes it again: a cycle.")
        if element.tag == "include":
            _check_file(file, file.read_bytes(), model, (*above, path.resolve()))


def _found(tag: str, name: str, path: Path, model: Path) -> Path:
    """MuJoCo looks beside the model and beside the including file: neither may lead outside."""
    folder = model.parent
    there = [place / name for place in (folder, path.parent) if (place / name).is_file()]
    if Path(name).is_absolute() or any(not inside(file, folder) for file in there):
        raise ModelError(
            f"{path.name}: <{tag} file={name!r}> lies outside of the model's folder, and nothing "
            "is read there; put the file beside the model."
        )
    if not there:
        raise ModelError(f"{path.name}: the file of <{tag} file={name!r}> is not there.")
    return there[0]


def _check_size(root: ET.Element, name: str) -> None:
    total = 0
    for copies in _copies(root):
        total += copies
        if total > MOST_ELEMENTS:
            raise ModelError(
                f"{name} stands for more than {MOST_ELEMENTS} elements; no robot is that large."
            )


def _copies(root: ET.Element) -> Iterator[int]:
    """How often each element comes, as its ancestors repeat it; no recursion, for deep texts."""
    waiting = [(root, 1)]
    while waiting:
        element, copies = waiting.pop()
        times = _count(element) if element.tag in ("replicate", "flexcomp") else 1
        yield copies * times
        waiting += [(child, copies * max(times, 1)) for child in element]


def _count(element: ET.Element) -> int:
    words = element.get("count", "1").split()
    try:
        return math.prod(min(max(int(float(word)), 0), MOST_ELEMENTS + 1) for word in words)
    except (ValueError, OverflowError):
        return 1  # MuJoCo says what is wrong with it
