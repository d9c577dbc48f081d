"""Catalogue of names: robots, payloads, plug-ins, suites, data sets, words of suites."""

import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from sysid_bench import package_folders, plugin_names
from sysid_bench.apps.surveys.collection import read_collection
from sysid_bench.errors import SysidBenchError, UsageError, unknown_name
from sysid_bench.harness.suite.dataset_tables import read_plant
from sysid_bench.input_files import parse_toml, read_text
from sysid_bench.metrics import METRICS
from sysid_bench.models.data_sets.find_dataset import SCHEME, find_dataset, is_dataset
from sysid_bench.models.manifest import find_manifest, is_model
from sysid_bench.models.model_settings import source_settings
from sysid_bench.models.motor_table import motor, motor_names
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.verbs.plugin_entry import Entry, entry_of_plugin, plugin_entries
from sysid_bench.verbs.result import Result
from sysid_bench.verbs.suite_words import WORDS, entry_with_title


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class ShowResult(Result):
    """Entry of the catalogue; its keys depend on its kind."""

    kind: str
    entry: Entry

    def summary(self) -> str:
        """One line per key."""
        values = self._fields()
        width = max(map(len, values))
        return "\n".join(f"{key:<{width}}  {_value_line(v)}" for key, v in values.items())

    def _fields(self) -> Entry:
        return {"kind": self.kind, **self.entry}


def list_(kind: str, robots_dir: Path | None = None) -> list[Entry]:
    """Return everything of a kind (robots, payloads, tasks, excitations, estimators, suites,
    simulations, plants, model-errors, sensor-errors, pipelines, metrics, log-readers, datasets,
    collections, motors, terms, filters, integrators, executors, statistics, intervals, statuses;
    singular or plural) with name and title; the title of an entry that cannot be read states the
    reason."""
    plural = _plural(kind)
    if plural not in _LISTS:
        raise unknown_name("kind", kind, _LISTS)
    return _LISTS[plural](robots_dir)


def show(name: str, robots_dir: Path | None = None) -> ShowResult:
    """Return a robot's manifest as read, a payload, the settings of a plug-in, a suite, a data set,
    a motor or a collection of models; for a kind, the titles of its names.

    Raises UsageError with the nearest name of any kind.
    """
    plain, settings = source_settings(name)
    if not settings and (name.startswith(SCHEME) or is_dataset(name)):
        return ShowResult("dataset", _dataset(name.removeprefix(SCHEME)))
    if _is_robot(plain, robots_dir):
        return ShowResult("robot", _robot(name, robots_dir))
    if settings:
        raise UsageError(f"{plain!r} is no robot: only robots have {', '.join(settings)}.")
    return _shown_by_kind(name, robots_dir)


def _shown_by_kind(name: str, robots_dir: Path | None) -> ShowResult:
    """A name of any kind but robots and data sets, or a kind with the titles of its names."""
    names = {kind: _names(kind, robots_dir) for kind in _LISTS}  # no plug-in is imported for them
    kind = next((kind for kind in _SHOWS if name in names[kind]), None)
    if kind is not None:
        return ShowResult(_singular(kind), _SHOWS[kind](name))
    if _plural(name) in _LISTS:
        return ShowResult("kind", _titles(_plural(name), robots_dir))
    raise unknown_name("name", name, set().union(*names.values()))


def _is_robot(name: str, robots_dir: Path | None) -> bool:
    """Test for the file or the name of a robot, which need not exist where it is a path."""
    path = "/" in name or name.endswith((".urdf", ".xml"))
    return path or is_model(name) or name in package_folders.robots(robots_dir)


def _names(kind: str, robots_dir: Path | None) -> set[str]:
    own: dict[str, Callable[[], Iterable[str]]] = {
        "robots": partial(package_folders.robots, robots_dir),
        "payloads": partial(iter, PAYLOADS),
        "suites": package_folders.suite_files,
        "plants": package_folders.plant_files,
        "datasets": package_folders.dataset_files,
        "collections": package_folders.collection_files,
        "motors": motor_names,
        "metrics": partial(iter, METRICS),
        **{words: partial(iter, WORDS[words]) for words in WORDS},
    }
    return {*own.get(kind, list)(), *plugin_names.known(_singular(kind))}


def _plural(kind: str) -> str:
    """Kind as it is listed: "log-readers" for "log_reader"."""
    name = kind.replace("_", "-")
    return next((known for known in _LISTS if name in (known, _singular(known))), name)


def _singular(kind: str) -> str:
    """One of a kind: "log-reader", "status"."""
    return kind.removesuffix("es" if kind.endswith("ses") else "s")


def _titles(kind: str, robots_dir: Path | None) -> Entry:
    """Kind, then the title of each of its names."""
    return {"name": kind} | {entry["name"]: entry["title"] for entry in list_(kind, robots_dir)}


def _value_line(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, default=str)


def _robot(name: str, robots_dir: Path | None) -> Entry:
    manifest = find_manifest(name, robots_dir)
    return {
        "name": manifest.name,
        "title": manifest.title,
        "file": str(manifest.path),
        "assets": None if manifest.assets is None else str(manifest.assets),
        "tool": manifest.tool,
        "free_base": manifest.free_base,
        "gravity": manifest.gravity,
        "terms": list(manifest.terms),
        "limits": _given(manifest.limits),
        "joints": _given(manifest.joints),
        "couplings": manifest.couplings,
        "coupling": {"independent": list(manifest.independent)},
        "sensors": [sensor.model_dump() for sensor in manifest.sensors],
        "licence": manifest.licence,
    }


def _given(by_joint: Mapping[str, BaseModel]) -> Entry:
    """Keys of each joint that the manifest gives."""
    return {joint: table.model_dump(exclude_none=True) for joint, table in by_joint.items()}


def _robots(robots_dir: Path | None) -> list[Entry]:
    entries = []
    for name in package_folders.robots(robots_dir):
        try:
            manifest = find_manifest(name, robots_dir)
            entries.append({"name": name, "title": manifest.title, "free_base": manifest.free_base})
        except SysidBenchError as error:
            entries.append({"name": name, "title": f"cannot be read: {error}"})
    return entries


def _payloads(robots_dir: Path | None) -> list[Entry]:
    return [{"name": name, "title": _payload_title(name)} for name in PAYLOADS]


def _payload_title(name: str) -> str:
    payload = PAYLOADS[name]
    if not payload:
        return "nothing mounted"
    return f"{payload.mass:g} kg at ({', '.join(f'{1e3 * x:g}' for x in payload.com)}) mm"


def _payload(name: str) -> Entry:
    return dataclasses.asdict(PAYLOADS[name])


def _suites(robots_dir: Path | None) -> list[Entry]:
    return [
        {"name": name, "title": _file_title(file)}
        for name, file in package_folders.suite_files().items()
    ]


def _file_title(file: Path) -> str:
    try:
        return str(parse_toml(read_text(file)).get("title", ""))
    except (OSError, ValueError) as error:
        return f"cannot be read: {error}"


def _suite(name: str) -> Entry:
    file = package_folders.suite_files()[name]
    try:
        return {"name": name, "file": str(file), **parse_toml(read_text(file))}
    except (OSError, ValueError) as error:
        raise UsageError(f"The suite {str(file)!r} cannot be read: {error}.") from error


def _plants(robots_dir: Path | None) -> list[Entry]:
    """Plant files with their titles, then effects."""
    files: list[Entry] = [
        {"name": name, "title": _file_title(file)}
        for name, file in package_folders.plant_files().items()
    ]
    return files + plugin_entries("plant")(robots_dir)


def _plant(name: str) -> Entry:
    files = package_folders.plant_files()
    if name in files:
        return {"file": str(files[name]), **read_plant(files[name])}
    return entry_of_plugin("plant")(name)


def _datasets(robots_dir: Path | None) -> list[Entry]:
    """Data sets with their titles; one that cannot be read states the reason."""
    entries = []
    for name in package_folders.dataset_files():
        try:
            entries.append({"name": name, "title": find_dataset(name).described.title})
        except SysidBenchError as error:
            entries.append({"name": name, "title": f"cannot be read: {error}"})
    return entries


def _dataset(name: str) -> Entry:
    """Keys of a data set, with its description, its size (bytes) and what is missing here."""
    found = find_dataset(name)
    described = found.described.model_dump(exclude_none=True)
    absent = [file.path for file in found.missing()]
    return {
        "description": str(found.file),
        **described,
        "bytes": found.described.size,
        "missing": absent,
    }


def _collections(robots_dir: Path | None) -> list[Entry]:
    """Collections of models with their titles; one that cannot be read states the reason."""
    entries = []
    for name, file in package_folders.collection_files().items():
        try:
            entries.append({"name": name, "title": read_collection(file).title})
        except SysidBenchError as error:
            entries.append({"name": name, "title": f"cannot be read: {error}"})
    return entries


def _collection(name: str) -> Entry:
    """Title of a collection of models, its size (bytes), and its packages with their licences."""
    file = package_folders.collection_files()[name]
    found = read_collection(file)
    return {
        "description": str(file),
        "name": found.name,
        "title": found.title,
        "bytes": found.size,
        "packages": {f"{one.package} {one.version}": one.licence for one in found.wheel},
    }


def _motors(robots_dir: Path | None) -> list[Entry]:
    """Motors of all tables with their titles."""
    return [{"name": name, "title": one.keys.title} for name, one in motor_names().items()]


def _motor(name: str) -> Entry:
    """Table entry of a motor, its armature and the torque at rest of its line of torque over speed,
    where these follow from it."""
    found = motor(name)
    derived = {"armature": found.armature, "stall_torque": found.stall_torque}
    return {
        "name": name,
        "file": str(found.file),
        **found.keys.model_dump(exclude_none=True),
        **{key: value for key, value in derived.items() if math.isfinite(value)},
    }


def _metrics(robots_dir: Path | None) -> list[Entry]:
    """Built-in metrics with unit, direction and formula, then plug-ins of installed packages."""
    return [*map(_builtin_metric, METRICS), *plugin_entries("metric")(robots_dir)]


def _builtin_metric(name: str) -> Entry:
    metric = METRICS[name]
    heading = f"{metric.heading} {metric.arrow}".strip()
    return {
        "name": metric.name,
        "title": ": ".join(filter(None, (heading, metric.formula))),
        "unit": metric.unit,
        "scale": metric.scale,
        "better": metric.better,
        "level": metric.level,
        "needs": list(metric.needs),
        "formula": metric.formula,
    }


def _metric(name: str) -> Entry:
    return _builtin_metric(name) if name in METRICS else entry_of_plugin("metric")(name)


def _words(kind: str) -> Callable[[Path | None], list[Entry]]:
    return lambda robots_dir: [entry_with_title(kind, name) for name in WORDS[kind]]


def _terms(robots_dir: Path | None) -> list[Entry]:
    """Joint terms, then the features that recordings may have in their place."""
    return [*_words("terms")(robots_dir), *plugin_entries("term")(robots_dir)]


def _term(name: str) -> Entry:
    return (
        entry_with_title("terms", name) if name in WORDS["terms"] else entry_of_plugin("term")(name)
    )


_LISTS: Final[Mapping[str, Callable[[Path | None], list[Entry]]]] = {
    "robots": _robots,
    "payloads": _payloads,
    "tasks": plugin_entries("task"),
    "excitations": plugin_entries("excitation"),
    "estimators": plugin_entries("estimator"),
    "simulations": plugin_entries("simulation"),
    "plants": _plants,
    "model-errors": plugin_entries("model_error"),
    "sensor-errors": plugin_entries("sensor_error"),
    "pipelines": plugin_entries("pipeline"),
    "metrics": _metrics,
    "log-readers": plugin_entries("log_reader"),
    "suites": _suites,
    "datasets": _datasets,
    "collections": _collections,
    "motors": _motors,
    "executors": plugin_entries("executor"),
    **{kind: _words(kind) for kind in WORDS},
    "terms": _terms,
}
_SHOWS: Final[Mapping[str, Callable[[str], Entry]]] = {
    "payloads": _payload,
    "tasks": entry_of_plugin("task"),
    "excitations": entry_of_plugin("excitation"),
    "estimators": entry_of_plugin("estimator"),
    "simulations": entry_of_plugin("simulation"),
    "plants": _plant,
    "model-errors": entry_of_plugin("model_error"),
    "sensor-errors": entry_of_plugin("sensor_error"),
    "pipelines": entry_of_plugin("pipeline"),
    "metrics": _metric,
    "log-readers": entry_of_plugin("log_reader"),
    "suites": _suite,
    "datasets": _dataset,
    "collections": _collection,
    "motors": _motor,
    "executors": entry_of_plugin("executor"),
    **{kind: partial(entry_with_title, kind) for kind in WORDS},
    "terms": _term,
}
KINDS: Final = tuple(_LISTS)
"""Kinds that can be listed."""
