"""Third-party code of an experiment: plug-ins that it names, and sources that it has loaded."""

import inspect
import re
import sys
import sysconfig
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import Distribution, PackageNotFoundError, distributions, requires, version
from pathlib import Path
from typing import Any

from sysid_bench.errors import SysidBenchError, UsageError
from sysid_bench.experiments.simulated.composed_plant import plant_entries
from sysid_bench.input_files import file_hash
from sysid_bench.models.manifest import find_manifest
from sysid_bench.plugin_names import is_of_package, is_third_party, known
from sysid_bench.signals.log_description import LogDescription, log_description
from sysid_bench.signals.log_reader import KIND as LOG_READER
from sysid_bench.signals.log_reader import package_reader
from sysid_bench.version_fields import PACKAGE_FOLDER
from sysid_bench.words import MOTOR, TERMS


def third_party_parts(argument: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parts of an `argument` of `execute` that run code of others: {data, metrics,
    methods}.

    `data`: True where their plug-ins make the data (motions, effects, pipelines, tasks, log
    readers, terms), `metrics` where they compute some; `methods`: ids of cells with an estimator of
    others.
    """
    foreign = (
        entry["cell"]
        for entry in argument["estimators"]
        if not is_of_package("estimator", entry["use"])
    )
    return {
        "data": any(not is_of_package(*one) for one in _data_plugins(argument)),
        "metrics": bool(argument.get("metrics")),
        "methods": list(foreign),
    }


def _data_plugins(argument: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield (kind, name) of the plug-ins that make the data of an experiment."""
    spec, folder = argument["experiment"], Path(argument["folder"])
    yield "task", spec["task"]
    if spec.get("pipeline") is not None:
        yield "pipeline", spec["pipeline"]["use"]
    log = spec.get("log")
    if log is None:
        yield from ((kind, str(plugin["use"])) for kind, plugin in plant_entries(spec["plant"]))
        yield "simulation", spec["simulation"]["use"]
        for motion in (spec["excitation"], *spec["held_out"]):
            yield "excitation", motion["use"]
        return
    robots = argument.get("robots_dir")
    terms = manifest_terms(spec["robot"], Path(robots) if robots else None, folder)
    yield from (term for term in terms if is_third_party(*term))
    for word in (*(spec["terms"] or ()), *log["choose"]):
        if word.removeprefix(f"{MOTOR}.") not in TERMS:
            yield "term", word.removeprefix(f"{MOTOR}.")
    for written in (*log["train"], *log["test"]):
        with suppress(UsageError):  # reported by the preparation
            yield from log_reader_names(log_description(written, folder))


def manifest_terms(
    robot: str, robots_dir: Path | None, folder: Path | None = None
) -> Iterator[tuple[str, str]]:
    """Yield (kind, name) of what may be features among the `terms` of a robot's manifest; a robot
    that is not found has none, which is reported by its reading."""
    try:
        words = find_manifest(robot, robots_dir, folder).terms
    except SysidBenchError:
        return
    yield from term_names(words)


def term_names(words: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield (kind, name) of what may be features among words of joint terms: a word, and what
    stands in it behind a joint or "motor" ("j2.file:mine.py:Spring")."""
    for word in words:
        _, mark, path = word.partition("file:")
        parts = [mark + path] if mark else [word] if ":" in word else word.split(".")
        yield from (("term", ".".join(parts[first:])) for first in range(len(parts)))


def reader_names(files: Iterable[Path]) -> Iterator[tuple[str, str]]:
    """Yield (kind, name) of the readers of described recordings; invalid descriptions have none."""
    for file in files:
        with suppress(UsageError):  # reported by their reading
            yield from log_reader_names(log_description(str(file), Path()))


def log_reader_names(log: LogDescription) -> Iterator[tuple[str, str]]:
    """Yield (kind, name) of the readers of a log's files.

    Where none is named and the suffix is not ours, these are all installed ones: each is asked for
    its suffixes.
    """
    for part in log.file_entries:
        reader = log.reader_of(part)
        if reader is None:
            yield from reader_candidates(log.file_of(part))
        else:
            yield LOG_READER, reader if isinstance(reader, str) else reader["use"]


def reader_candidates(file: Path) -> Iterator[tuple[str, str]]:
    """Yield (kind, name) of the readers that may read a file for which none is named."""
    built_in = package_reader(file)
    names = known(LOG_READER) if built_in is None else [built_in]
    yield from ((LOG_READER, name) for name in names)


def loaded_sources(modules: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Return {path: SHA-256} of the third-party source files and {distribution: version} of the
    third-party packages among modules (name, file).

    The standard library, this package and the distributions that it requires are left out: they
    are in the fingerprint of every row. Third-party code is loaded in isolated processes alone, so
    that all that is found belongs to the present cell.
    """
    sources = dict[str, str]()
    for name, file in modules:
        path = Path(file).resolve()
        if any(part in ("site-packages", "dist-packages") for part in path.parts):
            top = name.partition(".")[0]
            owners = {owner for entry in sys.path for owner in _owners(entry).get(top, ())}
            own = _required()
            sources |= {owner: version(owner) for owner in owners if _canonical(owner) not in own}
        elif not {PACKAGE_FOLDER, _standard_library()} & set(path.parents):
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
    modules = set[str | None]()
    for line in (distribution.read_text("RECORD") or "").splitlines():
        file = line.partition(",")[0]
        folder, slash, _ = file.partition("/")
        if not slash:
            modules.add(inspect.getmodulename(file))
        elif file.endswith(".py"):  # files of other kinds, such as data, are of no module
            modules.add(folder)
    return filter(None, modules)


@cache
def _required() -> frozenset[str]:
    """Normalised names of this distribution and all that it requires, extras included."""
    found, waiting = set[str](), ["sysid-bench"]
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        found.add(name)
        with suppress(PackageNotFoundError):
            waiting += [_canonical(text) for text in requires(name) or ()]
    return frozenset(found)


def _canonical(requirement: str) -> str:
    """Normalised name of a distribution at the head of a requirement (PEP 503)."""
    match = re.match(r"[A-Za-z0-9._-]+", requirement)
    return re.sub(r"[-_.]+", "-", match[0]).lower() if match else ""
