"""Folders of robots, motors, suites, plants, data sets and collections of models: of a checkout, an
installed wheel, or the user; and the compiled libraries of this package."""

import ctypes
import hashlib
import os
from functools import cache
from pathlib import Path
from typing import Any

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.extras import missing
from sysid_bench.input_files import is_file, is_folder


def package_folder(kind: str) -> Path:
    """Return the folder `robots` or `suites`, or `plants`, `datasets`, `collections` or `motors`
    below `data`, of this installation (checkout or wheel)."""
    package = Path(__file__).resolve().parent
    # In a wheel first: beside an installed package, a folder of that name may be anybody's.
    for place in (package, package.parent):
        for folder in (place / kind, place / "data" / kind):
            if is_folder(folder):
                return folder
    raise UsageError(f"This installation of sysid_bench has no {kind!r} folder; install it again.")


@cache
def cache_folder() -> Path:
    """Return the folder of what is computed once: `SYSID_BENCH_CACHE`, else the user's cache."""
    named = os.environ.get("SYSID_BENCH_CACHE")
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(named) if named else Path(home) / "sysid_bench"


def robot_folders(extra: Path | None = None) -> list[Path]:
    """Return folders with <name>/robot.toml by precedence: --robots, ./robots, installed."""
    folders = (extra, Path("robots"), package_folder("robots"))
    return [folder for folder in folders if folder is not None and is_folder(folder)]


def robots(extra: Path | None = None) -> dict[str, Path]:
    """Return the manifest of every robot that has a name."""
    found: dict[str, Path] = {}
    for folder in robot_folders(extra):
        for manifest in sorted(folder.glob("*/robot.toml")):
            found.setdefault(manifest.parent.name, manifest)
    return found


def suite_files() -> dict[str, Path]:
    """Return the file of every suite that has a name, ./suites before the installed ones."""
    return _toml_files("suites")


def _nested_suites() -> list[str]:
    """Names of the installed suites in folders of suites, as "claims/smoke"."""
    files = sorted(package_folder("suites").glob("*/*.toml"))
    return [f"{file.parent.name}/{file.stem}" for file in files]


def plant_files() -> dict[str, Path]:
    """Return the file of every plant that has a name, ./plants before the installed ones."""
    return _toml_files("plants")


def dataset_files() -> dict[str, Path]:
    """Return the file of every data set that has a name, ./datasets before the installed ones:
    NAME.toml, or NAME/dataset.toml with its robot and recordings beside it."""
    own = sorted(Path("datasets").glob("*/dataset.toml"))
    return {file.parent.name: file for file in own} | _toml_files("datasets")


def collection_files() -> dict[str, Path]:
    """Return the file of every collection of models that has a name, ./collections before the
    installed ones."""
    return _toml_files("collections")


def motor_files() -> dict[str, Path]:
    """Return the files of motors by name, ./motors before the installed ones."""
    return _toml_files("motors")


def _toml_files(kind: str) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for folder in (Path(kind), package_folder(kind)):
        for file in sorted(folder.glob("*.toml")):
            found.setdefault(file.stem, file)
    return found


def suite(name: str) -> Path:
    """Return the file of a suite from its name or path, of one in a folder of suites from
    "claims/smoke". Raises UsageError where there is none."""
    path = Path(name)
    if path.suffix == ".toml" or path.parent != Path("."):
        inside = package_folder("suites") / f"{name}.toml"
        # A path of the user before that of the package.
        for file in (path, inside):
            if is_file(file):
                return file
        if is_folder(path):
            raise UsageError(f"{name!r} is a folder; give the TOML file of a suite.")
        raise unknown_name("suite file", name, (*suite_files(), *_nested_suites()))
    table = suite_files()
    if name not in table:
        raise unknown_name("suite", name, table, "Or give the path of a TOML file.")
    return table[name]


@cache
def robot_data_folder() -> Path:
    """Return the folder `robots` of the package example-robot-data, without importing it."""
    from importlib.metadata import PackageNotFoundError, files  # 16 ms that completion waits for

    try:
        listed = files("example-robot-data") or []
    except PackageNotFoundError as error:
        here = ("*.urdf", "*.xml")
        known = [n for n, file in robots().items() if any(any(file.parent.glob(p)) for p in here)]
        otherwise = f"Robots that need none: {', '.join(known)}, and any model file."
        raise missing("example-robot-data", "This robot", otherwise) from error
    urdf = next((f for f in listed if f.name.endswith(".urdf") and "robots" in f.parts), None)
    if urdf is None:
        raise UsageError("The package example-robot-data holds no URDF; install it again.")
    depth = len(urdf.parts) - urdf.parts.index("robots") - 2
    return Path(str(urdf.locate())).resolve().parents[depth]


def c_library(source: Path, library: str, hash_function: str) -> Any:
    """Return the library (ctypes) that was compiled from the C file `source` in the same folder.

    `hash_function` names its function that returns the hash of that file and vectors.h. Raises
    OSError, with the reason, if there is no library, or one compiled from another text.
    """
    # The suffix depends on the operating system.
    files = (source.with_name(f"{library}{suffix}") for suffix in (".so", ".dylib", ".dll"))
    file = next(filter(Path.is_file, files), None)
    if file is None:
        raise OSError(
            f"{library} was not compiled when the package was installed; to compile it, install a "
            "C compiler, gcc or clang, and then the package again"
        )
    dll = ctypes.CDLL(str(file))
    source_hash = getattr(dll, hash_function)
    source_hash.restype = ctypes.c_char_p  # ctypes takes results for ints, which cut pointers off
    texts = (source, Path(__file__).with_name("vectors.h"))  # as in CMakeLists.txt
    hashes = "".join(hashlib.sha256(text.read_bytes()).hexdigest() for text in texts)
    if source_hash().decode() != hashlib.sha256(hashes.encode()).hexdigest():
        raise OSError(
            f"{file.name} was compiled from another {source.name}; install the package again"
        )
    return dll
