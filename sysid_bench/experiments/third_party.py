"""Third-party code of an experiment: plug-ins that are not of this package."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from sysid_bench.errors import SysidBenchError, UsageError
from sysid_bench.experiments.simulated.composed_plant import plant_entries
from sysid_bench.models.manifest import find_manifest
from sysid_bench.plugin_names import is_of_package, is_third_party, known
from sysid_bench.signals.log_description import LogDescription, log_description
from sysid_bench.signals.log_reader import KIND as LOG_READER
from sysid_bench.signals.log_reader import package_reader
from sysid_bench.words import MOTOR, TERMS


def has_third_party_data(argument: Mapping[str, Any]) -> bool:
    """True where plug-ins of others make the data: motions, effects, pipelines, tasks, log readers,
    terms."""
    spec = argument["experiment"]
    if spec.get("log") is None:
        names = _simulation_plugins(spec)
    else:
        robots = argument.get("robots_dir")
        names = _log_plugins(spec, Path(robots) if robots else None, Path(argument["folder"]))
    return any(not is_of_package(kind, name) for kind, name in names)


def is_third_party_cell(argument: Mapping[str, Any], entry: Mapping[str, Any]) -> bool:
    """True where an estimator (an `entry` of `argument["estimators"]`) or a metric is of others."""
    return bool(argument.get("metrics")) or not is_of_package("estimator", entry["use"])


def _simulation_plugins(spec: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield (kind, name) of the plug-ins of a simulated experiment."""
    yield "task", spec["task"]
    yield from ((kind, str(plugin["use"])) for kind, plugin in plant_entries(spec["plant"]))
    for kind in ("excitation", "simulation"):
        yield kind, spec[kind]["use"]
    for motion in spec["held_out"]:
        yield "excitation", motion["use"]
    yield from _pipelines(spec)


def _pipelines(spec: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield (kind, name) of the pipeline that is named."""
    if spec.get("pipeline") is not None:
        yield "pipeline", spec["pipeline"]["use"]


def _log_plugins(
    spec: Mapping[str, Any], robots_dir: Path | None, folder: Path
) -> Iterator[tuple[str, str]]:
    """Yield (kind, name) of the plug-ins of an experiment with recordings."""
    yield "task", spec["task"]
    yield from _pipelines(spec)
    yield from filter(_is_foreign, manifest_terms(spec["robot"], robots_dir, folder))
    log = spec["log"]
    for name in (*(spec["terms"] or ()), *log["choose"]):
        if name.removeprefix(f"{MOTOR}.") not in TERMS:
            yield "term", name.removeprefix(f"{MOTOR}.")
    for written in (*log["train"], *log["test"]):
        try:
            yield from log_reader_names(log_description(written, folder))
        except UsageError:  # reported by the preparation
            continue


def _is_foreign(plugin: tuple[str, str]) -> bool:
    return is_third_party(*plugin)


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
        try:
            yield from log_reader_names(log_description(str(file), Path()))
        except UsageError:  # reported by their reading
            continue


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
