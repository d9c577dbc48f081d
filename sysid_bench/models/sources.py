"""Sources of robot models: settings after a name, files of packages, model files below a folder."""

import hashlib
import importlib
import math
import re
from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from functools import lru_cache
from itertools import chain, product
from pathlib import Path
from types import ModuleType
from typing import Any, Final, NamedTuple
from urllib.parse import parse_qsl, urlencode

from sysid_bench import package_folders
from sysid_bench.errors import ModelError, SysidBenchError, UsageError, reason_of, unknown_name
from sysid_bench.input_files import file_hash, is_file, is_folder, read_data
from sysid_bench.models.xml_file import parse_xml, read_file

SEPARATOR: Final = "?"


def _flag(text: str) -> bool:
    if text not in ("true", "false"):
        raise UsageError(f"free_base = {text!r}: give true or false.")
    return text == "true"


def _folder(text: str) -> Path:
    if not Path(text).is_dir():
        raise UsageError(f"assets: {text!r} is not a folder.")
    return Path(text)


def _vector(text: str) -> tuple[float, ...]:
    try:
        numbers = tuple(map(float, text.replace(",", " ").split()))
    except ValueError:
        numbers = ()
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise UsageError(f"gravity = {text!r}: give x,y,z in the base frame (m/s^2), as 0,0,-9.81.")
    return numbers


_READ: Final[Mapping[str, Callable[[str], Any]]] = {
    "assets": _folder,
    "tool": str,
    "free_base": _flag,
    "gravity": _vector,
}


def with_settings(source: str, settings: Mapping[str, Any]) -> str:
    """Return a source with settings after it, those that are None left out; settings that the
    source has already stay unless they are given anew."""
    plain, given = _divided(source)
    for key, value in settings.items():
        if isinstance(value, bool):
            given[key] = str(value).lower()
        elif value is not None:
            given[key] = str(value.resolve() if isinstance(value, Path) else value)
    return f"{plain}{SEPARATOR}{urlencode(given, safe=',')}" if given else source


def source_settings(source: str) -> tuple[str, dict[str, Any]]:
    """Return a source without its settings, and their values; raise UsageError for a setting that
    there is not, or a value that cannot be used."""
    plain, texts = _divided(source)
    for key in texts:
        if key not in _READ:
            raise unknown_name(f"setting of {plain}", key, _READ)
    return plain, {key: _READ[key](text) for key, text in texts.items()}


def _divided(source: str) -> tuple[str, dict[str, str]]:
    plain, separator, text = source.partition(SEPARATOR)
    if not separator or is_file(Path(source)) or is_folder(Path(source)):
        return source, {}
    return plain, dict(parse_qsl(text, keep_blank_values=True))


PACKAGES: Final = ("example-robot-data", "robot_descriptions")
"""Sources of model files besides the user's own, written `package:rest`."""

_LONGEST: Final = 200
"""Letters of a name to which the nearest is sought: twice those of the longest."""


def is_package_file(source: str) -> bool:
    """True for a text that names a file of a package."""
    package, colon, _ = source.partition(":")
    return bool(colon) and package in PACKAGES


def package_file(source: str, label: str) -> tuple[Path, Path | None]:
    """Return the model file of a `package:rest`, and the folder that it may read files from.

    Reading a robot_descriptions module may download the robot. Raises ModelError, with `label`, for
    what is not installed or cannot be downloaded.
    """
    package, _, rest = source.partition(":")
    if package == "robot_descriptions":
        wanted = f"{label}: 'robot_descriptions:{rest}'"
        module = _description_module(rest, wanted)
        file = getattr(module, "URDF_PATH", None) or getattr(module, "MJCF_PATH", None)
        if file is None:
            raise ModelError(f"{wanted} is not a robot: it has neither a URDF nor an MJCF.")
        path, folder = Path(file), getattr(module, "PACKAGE_PATH", None)
        if not is_file(path):
            raise ModelError(f"{wanted}: its file {str(path)!r} does not exist; download it again.")
        return path, Path(folder) if folder and path.is_relative_to(folder) else None
    return package_folders.robot_data_folder() / rest, None


def unknown_file(name: str) -> UsageError:
    """The error for an unknown file of example-robot-data, with the nearest names."""
    folder = package_folders.robot_data_folder()
    known = [str(file.relative_to(folder)) for file in folder.rglob("*.urdf")]
    near: list[str] = []
    if len(name) <= _LONGEST:
        stem = Path(name).stem.lower()
        near = get_close_matches(name, known, n=3, cutoff=0.8)
        # Else files that contain the name: a shorter name, or one of another folder.
        near = near or [file for file in known if stem in file.lower()][:3]
    nearest = f" Did you mean {' or '.join(map(repr, near))}?" if near else ""
    return UsageError(
        f"No file of example-robot-data is called {name!r}.{nearest} There are {len(known)} URDFs."
    )


def _description_module(name: str, wanted: str) -> ModuleType:
    """Import a module of robot_descriptions, which downloads its robot."""
    try:
        if not name.isidentifier() or name.startswith("_"):  # a path, or a helper of the package
            raise ModuleNotFoundError(name)
        return importlib.import_module(f"robot_descriptions.{name}")
    except ModuleNotFoundError as error:
        raise ModelError(
            f"{wanted} is not installed or not known; "
            "pip install robot_descriptions, and see its list of names."
        ) from error
    except Exception as error:  # its modules clone repositories while they are imported
        raise ModelError(
            f"{wanted} could not be downloaded ({reason_of(error)[:200]}); the internet is needed "
            "once, for the robot's files."
        ) from error


SUFFIXES: Final = (".urdf", ".xml", ".mjcf")
_DEEPEST: Final = 8
"""Levels of files that include files."""


class _Outline(NamedTuple):
    """Root element of an XML file ("" where it cannot be read), all its elements, and the files
    that it includes."""

    root: str = ""
    tags: frozenset[str] = frozenset()
    included: tuple[str, ...] = ()


def model_files(folder: Path, scenes: bool = False) -> list[Path]:
    """Return the model files below a folder, sorted; with `scenes` also files whose bodies all
    come from files that they include."""
    found = sorted(file for file in folder.rglob("*") if file.suffix in SUFFIXES)
    return [file for file in found if _is_model(file, _DEEPEST if scenes else 0)]


def check_model_file(file: Path) -> None:
    """Raise ModelError for a file that is not a URDF and not an MJCF, by its root element.

    Broken XML passes: its robot fails alone, with the place of the error.
    """
    root = _outline(file).root
    if not root and is_file(file) and file.read_bytes().lstrip().startswith(b"<"):
        return
    if root not in ("robot", "mujoco"):
        found = f"its root element is <{root}>" if root else "it cannot be read as XML"
        raise ModelError(f"{file} is neither URDF nor MJCF: {found}.")


def hash_of_files(files: Iterable[Path]) -> dict[Path, str]:
    """Return the digest of each file, of files with equal content the first alone."""
    first: dict[str, Path] = {}
    for file in files:
        first.setdefault(_model_hash(file), file)
    return {file: digest for digest, file in first.items()}


def _model_hash(file: Path, depth: int = _DEEPEST) -> str:
    """Return the SHA-256 of a model file and of the files that it includes."""
    try:
        found = hashlib.sha256(read_file(file))
    except ModelError:
        found = hashlib.sha256()
    for name in _outline(file).included if depth else ():
        found.update(_model_hash(file.parent / name, depth - 1).encode())
    return found.hexdigest()


def _outline(file: Path) -> _Outline:
    """Outline of a file; an empty one where it cannot be read."""
    try:
        return _read_outline(file, file.stat().st_mtime_ns)
    except (OSError, ValueError, SysidBenchError):
        return _Outline()


@lru_cache(maxsize=4096)
def _read_outline(file: Path, changed: int) -> _Outline:
    """Outline of a file as last changed at `changed` (ns)."""
    root = parse_xml(read_file(file), file.name)
    included = tuple(element.get("file", "") for element in root.iter("include"))
    return _Outline(root.tag, frozenset(element.tag for element in root.iter()), included)


def _is_model(file: Path, depth: int) -> bool:
    outline = _outline(file)
    if not outline.root:
        return file.suffix == ".urdf"  # its error is a finding
    if outline.root not in ("robot", "mujoco"):
        return False
    return {"joint", "link" if outline.root == "robot" else "body"} <= _tags(file, depth)


def _tags(file: Path, depth: int) -> frozenset[str]:
    """Tags of a file and of those that it includes."""
    outline = _outline(file)
    inner = (_tags(file.parent / name, depth - 1) for name in outline.included if depth)
    return outline.tags.union(*inner)


_FILE: Final = re.compile(rb"""\s(?:file|filename)\s*=\s*["']([^"']+)["']""")
_FOLDER: Final = re.compile(rb"""\s(?:meshdir|assetdir)\s*=\s*["']([^"']*)["']""")
_PICTURES: Final = (".png", ".jpg", ".jpeg", ".tga", ".mtl", ".ktx")
ABSENT: Final = "absent"


def file_state(path: str) -> str:
    """Return the hash of a file, ABSENT where it cannot be read."""
    try:
        return file_hash(Path(path))
    except OSError:
        return ABSENT


def model_states(path: str) -> list[str]:
    """Return the hashes of a model file and of all files that it names: includes, attached models,
    meshes and height fields, since MuJoCo can compute inertias from them. Pictures do not count."""
    hashes, waiting, folders = dict[str, str](), [Path(path)], [Path(path).parent]
    while waiting:
        file = waiting.pop()
        if str(file) in hashes:
            continue
        hashes[str(file)] = file_state(str(file))
        if file.suffix in SUFFIXES:
            try:
                text = read_data(file)
            except OSError:  # absent, or too large for a model; it is in the hashes in any case
                text = b""
            meshes = (name.decode(errors="replace") for name in _FOLDER.findall(text))
            folders += [file.parent, *(Path(path).parent / name for name in meshes)]
            # Engines look for a file in different folders: each that is there counts.
            below = list(dict.fromkeys(folders))
            above = chain.from_iterable(folder.parents for folder in below)
            names = dict.fromkeys(name.decode(errors="replace") for name in _FILE.findall(text))
            named = [
                name.removeprefix("package://").removeprefix("file://")
                for name in names
                if not name.lower().endswith(_PICTURES)
            ]
            places = product(named, (*below, *above))
            waiting += filter(is_file, (folder / name for name, folder in places))
    return list(hashes.values())
