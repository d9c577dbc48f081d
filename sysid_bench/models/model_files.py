"""Model files below a folder: URDF and MJCF, without the parts that others include."""

import hashlib
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple

from sysid_bench.errors import ModelError, SysidBenchError
from sysid_bench.models.xml_file import parse_xml, read_file

SUFFIXES: Final = (".urdf", ".xml", ".mjcf")
_DEEPEST: Final = 8
"""Levels of files that include files."""


class _Outline(NamedTuple):
    """Root element of an XML file, all its elements, and the files that it includes."""

    root: str
    tags: frozenset[str]
    included: tuple[str, ...]


_NO_OUTLINE: Final = _Outline("", frozenset(), ())


def model_files(folder: Path, scenes: bool = False) -> list[Path]:
    """Return the model files below a folder, sorted; with `scenes` also files whose bodies all
    come from files that they include."""
    found = sorted(file for file in folder.rglob("*") if file.suffix in SUFFIXES)
    return [file for file in found if _is_model(file, _DEEPEST if scenes else 0)]


def hash_of_files(files: Iterable[Path]) -> dict[Path, str]:
    """Return the digest of each file, of files with equal content the first alone."""
    first: dict[str, Path] = {}
    for file in files:
        first.setdefault(_model_hash(file), file)
    return {file: digest for digest, file in first.items()}


def content_hash(model: Path, manifest: Path | None) -> str:
    """Return the SHA-256 of a model's file, of the files that it includes and of its robot.toml:
    the same wherever they lie. Meshes do not count."""
    found = hashlib.sha256(_model_hash(model).encode())
    if manifest is not None:
        found.update(_content(manifest))
    return found.hexdigest()


def _model_hash(file: Path, depth: int = _DEEPEST) -> str:
    """Return the SHA-256 of a model file and of the files that it includes."""
    found = hashlib.sha256(_content(file))
    for name in _outline(file).included if depth else ():
        found.update(_model_hash(file.parent / name, depth - 1).encode())
    return found.hexdigest()


def _content(file: Path) -> bytes:
    try:
        return read_file(file)
    except ModelError:
        return b""


def _outline(file: Path) -> _Outline:
    """Outline of a file; an empty one where it cannot be read."""
    try:
        return _read_outline(file, file.stat().st_mtime_ns)
    except (OSError, ValueError, SysidBenchError):
        return _NO_OUTLINE


@lru_cache(maxsize=4096)
def _read_outline(file: Path, changed: int) -> _Outline:
    """Outline of a file as last changed at `changed` (ns)."""
    root = parse_xml(read_file(file), file.name)
    included = tuple(element.get("file", "") for element in root.iter("include"))
    return _Outline(root.tag, frozenset(element.tag for element in root.iter()), included)


def _is_model(file: Path, depth: int) -> bool:
    outline = _outline(file)
    if outline is _NO_OUTLINE:
        return file.suffix == ".urdf"  # its error is a finding
    if outline.root not in ("robot", "mujoco"):
        return False
    tags = _tags(file, depth)
    return "joint" in tags and ("link" if outline.root == "robot" else "body") in tags


def _tags(file: Path, depth: int) -> frozenset[str]:
    """Tags of a file and of those that it includes."""
    outline = _outline(file)
    inner = (_tags(file.parent / name, depth - 1) for name in outline.included if depth)
    return outline.tags.union(*inner)
