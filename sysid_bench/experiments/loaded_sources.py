"""Source files and distributions that third-party code has really loaded into this process."""

import contextlib
import inspect
import re
import sys
import sysconfig
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib.metadata import (
    Distribution,
    PackageNotFoundError,
    distributions,
    requires,
    version,
)
from pathlib import Path

from sysid_bench.input_files import file_hash
from sysid_bench.version_fields import PACKAGE_FOLDER


def loaded_sources() -> dict[str, str]:
    """Return {path: SHA-256} of the third-party source files and {distribution: version} of the
    third-party packages in this process.

    The standard library, this package and the distributions that it requires are left out: they
    are in the fingerprint of every row. Third-party code is loaded in isolated processes alone, so
    that all that is found belongs to the present cell.
    """
    sources = dict[str, str]()
    for name, path in _modules():
        if _is_installed(path):
            sources |= _distributions(name.partition(".")[0])
        elif not _is_ours(path):
            sources[str(path)] = _state(path)
    return dict(sorted(sources.items()))


def read_package_files() -> None:
    """Read what is installed, which takes a while, before the forks of this process need it."""
    _required()
    for entry in sys.path:
        _owners(entry)


def _state(path: Path) -> str:
    """Return the SHA-256 of a file, "absent" where it cannot be read."""
    try:
        return file_hash(path)
    except OSError:
        return "absent"


def stale_sources(sources: Mapping[str, str]) -> list[str]:
    """Return the sources of a row that are there and differ now; what is gone proves nothing."""
    return [name for name, state in sources.items() if _present(name) not in (state, "absent")]


@cache
def _present(name: str) -> str:
    """State of a source now: the hash of a path, the version of a distribution."""
    if Path(name).is_absolute():
        return _state(Path(name))
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"


def _modules() -> Iterator[tuple[str, Path]]:
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if isinstance(file, str):
            yield name, Path(file).resolve()


def _is_ours(path: Path) -> bool:
    return PACKAGE_FOLDER in path.parents or _standard_library() in path.parents


def _is_installed(path: Path) -> bool:
    return any(part in ("site-packages", "dist-packages") for part in path.parts)


@cache
def _standard_library() -> Path:
    return Path(sysconfig.get_path("stdlib")).resolve()


@cache
def _owners(entry: str) -> Mapping[str, list[str]]:
    """Distributions of each top-level module below an entry of sys.path. A plug-in may add entries,
    so that each is read by itself."""
    owners = defaultdict[str, list[str]](list)
    for distribution in distributions(path=[entry]):
        for top in _top_modules(distribution):
            owners[top].append(distribution.name)
    return owners


def _top_modules(distribution: Distribution) -> Iterable[str]:
    """Top-level modules of a distribution. `importlib.metadata.packages_distributions` makes a path
    of each installed file, which takes seconds."""
    declared = (distribution.read_text("top_level.txt") or "").split()
    if declared:
        return declared
    lines = (distribution.read_text("RECORD") or "").splitlines()
    return set(filter(None, (_top_module(line.partition(",")[0]) for line in lines)))


def _top_module(file: str) -> str | None:
    """Top-level module of an installed file; None for one that is not of a module."""
    folder, slash, _ = file.partition("/")
    if slash:
        return folder if file.endswith(".py") else None
    return inspect.getmodulename(file)


def _distributions(top: str) -> dict[str, str]:
    owners = {name for entry in sys.path for name in _owners(entry).get(top, ())}
    return {name: version(name) for name in owners if _canonical(name) not in _required()}


@cache
def _required() -> frozenset[str]:
    """Normalised names of this distribution and all that it requires, extras included."""
    found, waiting = set[str](), ["sysid-bench"]
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        found.add(name)
        with contextlib.suppress(PackageNotFoundError):
            waiting += [_canonical(text) for text in requires(name) or ()]
    return frozenset(found)


def _canonical(requirement: str) -> str:
    """Normalised name of a distribution at the head of a requirement (PEP 503)."""
    match = re.match(r"[A-Za-z0-9._-]+", requirement)
    return re.sub(r"[-_.]+", "-", match[0]).lower() if match else ""
