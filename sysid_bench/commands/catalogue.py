"""Catalogue of names: robots, payloads, plug-ins, suites, data sets, words of suites."""

import dataclasses
import math
import re
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from sysid_bench import package_folders, plugin_names
from sysid_bench.apps.surveys.collection import read_collection
from sysid_bench.canonical_json import plain
from sysid_bench.errors import SysidBenchError, UsageError, unknown_name
from sysid_bench.experiments.job_channel import JobChannel
from sysid_bench.experiments.tasks.task import TaskDefinition
from sysid_bench.harness.suite.names import SECONDS
from sysid_bench.harness.suite.plugin_entries import read_plant
from sysid_bench.harness.work.worker_call import CallWorker, WorkerError
from sysid_bench.input_files import parse_toml, read_text
from sysid_bench.metrics import METRICS
from sysid_bench.models.data_sets import SCHEME, find_dataset, is_dataset
from sysid_bench.models.manifest import find_manifest, is_model
from sysid_bench.models.motor_table import motor, motor_names
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.models.sources import source_settings
from sysid_bench.reporting.tables import INTERVALS, STATISTICS
from sysid_bench.signals.filter import FORMS
from sysid_bench.units import quantity
from sysid_bench.words import STATUSES, TERMS

Entry = dict[str, Any]

_SENTENCE_END: Final = re.compile(r"(?<=\.) (?=[A-Z`])")
"""A full stop before a capital or a name; "et al. (2010)" and "i.e. x" do not end a sentence."""


def plugin_entries(kind: str) -> Callable[[Path | None], list[Entry]]:
    """Return a function that lists names and titles of the plug-ins of a kind."""

    def entries(robots_dir: Path | None) -> list[Entry]:
        with CallWorker(SECONDS) as worker:
            found = [_plugin(kind, name, worker) for name in plugin_names.known(kind)]
        return [{"name": entry["name"], "title": entry["title"]} for entry in found]

    return entries


def entry_of_plugin(kind: str) -> Callable[[str], Entry]:
    """Return a function that finds the entry of a plug-in of a kind, by name."""

    def entry(name: str) -> Entry:
        with CallWorker(SECONDS) as worker:
            return _plugin(kind, name, worker)

    return entry


def _plugin(kind: str, name: str, worker: CallWorker) -> Entry:
    """Entry of a plug-in; an entry point of another package is imported in a worker."""
    argument = {"kind": kind, "name": name}
    if plugin_names.is_of_package(kind, name):
        return plugin_entry(argument)
    try:
        return dict(worker.call(f"{__name__}:plugin_entry", argument, "cannot be imported"))
    except WorkerError as error:
        return {
            "name": name,
            "title": str(error),
            "at": plugin_names.known(kind)[name],
            "settings": {},
        }


def plugin_entry(argument: Mapping[str, str], channel: JobChannel | None = None) -> Entry:
    """Import a plug-in; return its title, its settings, and what a task declares."""
    kind, name = argument["kind"], argument["name"]
    plugin = plugin_names.resolve(kind, name)
    settings = {}
    if dataclasses.is_dataclass(plugin):
        settings = {field.name: _default(field) for field in dataclasses.fields(plugin)}
    title = _first_sentence(str(plugin.__doc__ or ""))
    entry = {
        "name": name,
        "title": title,
        "at": plugin_names.known(kind)[name],
        "settings": settings,
    }
    return entry | _declared(plugin) if kind == "task" else entry


def _declared(task: Any) -> Entry:
    """Attributes by which a task declares what it supports."""
    keys = [key for key in TaskDefinition.__annotations__ if key != "name"]
    return {key: _json_value(getattr(task, key)) for key in keys}


def _first_sentence(text: str) -> str:
    """First sentence of a docstring on one line; the whole paragraph where no other
    follows."""
    paragraph = " ".join(text.strip().partition("\n\n")[0].split())
    return _SENTENCE_END.split(paragraph, maxsplit=1)[0]


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default is dataclasses.MISSING:
        return None
    unit = field.metadata.get("unit")
    if unit is None or not isinstance(field.default, (int, float)):
        return _json_value(field.default)
    # A default is an SI number: 0.03 of a setting in % reads 3 %.
    return f"{field.default / quantity(1.0, unit):.12g} {unit}"


def _json_value(value: Any) -> Any:
    """Value of a plug-in as JSON, its text where it is of another type."""
    try:
        return plain(value)
    except TypeError:
        return str(value)


_TERM_TITLES: Final[Mapping[str, str]] = {
    "viscous": "Viscous friction fv of a joint: torque fv v, and fv.OTHER of coupled joints.",
    "coulomb": "Coulomb friction fc of a joint: torque fc sign(v).",
    "offset": "Constant torque of a joint, as of a current sensor or of the grease.",
    "armature": "Inertia Ia of rotor and gear, seen at the joint: torque Ia a.",
    "spring": "Stiffness k of a spring in the joint: torque k (q - reference).",
}
_INTEGRATOR_TITLES: Final[Mapping[str, str]] = {
    "auto": "Semi-implicit Euler where the torque is held over the control period, else "
    "implicitfast.",
    "euler": "Semi-implicit Euler of MuJoCo, implicit in the damping of joints.",
    "implicitfast": "Implicit in velocity without Coriolis derivatives, of MuJoCo.",
    "implicit": "Implicit in velocity with all derivatives, of MuJoCo.",
    "rk4": "Runge-Kutta of fourth order, of MuJoCo.",
}
_STATUS_TITLES: Final[Mapping[str, str]] = {
    "ok": "The cell has its scores.",
    "failed": "The method or the simulation ended without a result; the row has the reason.",
    "timeout": "The cell took longer than `run.timeout`.",
    "crash": "The process of the cell ended by a signal, as of a fault in a library.",
    "memory": "The process of the cell needed more than `run.memory`.",
    "lost": "The machine failed: the process was killed from outside, or storage was full.",
    "unsupported": "The method does not serve this robot, task or recording: a valid result.",
    "skipped": "The robot failed its cross-check, or what the cell needs failed.",
}


def _first_line(thing: type) -> str:
    return str(thing.__doc__).partition("\n")[0]


WORDS: Final[Mapping[str, Mapping[str, str]]] = {
    "terms": {name: _TERM_TITLES[name] for name in TERMS},
    "filters": {form: _first_line(kind) for form, kind in FORMS.items()},
    "integrators": _INTEGRATOR_TITLES,
    "statistics": {name: f"{text.capitalize()}." for name, text in STATISTICS.items()},
    "intervals": {name: f"{text.capitalize()}." for name, text in INTERVALS.items()},
    "statuses": {name: _STATUS_TITLES[name] for name in STATUSES},
}
"""Meaning of each word, by its kind."""


def entry_with_title(kind: str, name: str) -> dict[str, str]:
    """Return a word of a kind with its meaning, as `title`."""
    return {"name": name, "title": WORDS[kind][name]}


def entries_of_kind(kind: str, robots_dir: Path | None = None) -> list[Entry]:
    """Return everything of a kind, singular or plural, with name and title."""
    plural = _plural(kind)
    if plural not in _LISTS:
        raise unknown_name("kind", kind, _LISTS)
    return _LISTS[plural](robots_dir)


def find_entry(name: str, robots_dir: Path | None = None) -> tuple[str, Entry]:
    """Return (kind, entry) of a name; raises UsageError with the nearest name of any kind."""
    plain, settings = source_settings(name)
    if not settings and (name.startswith(SCHEME) or is_dataset(name)):
        return ("dataset", _dataset(name.removeprefix(SCHEME)))
    if _is_robot(plain, robots_dir):
        return ("robot", _robot(name, robots_dir))
    if settings:
        raise UsageError(f"{plain!r} is no robot: only robots have {', '.join(settings)}.")
    return _shown_by_kind(name, robots_dir)


def _shown_by_kind(name: str, robots_dir: Path | None) -> tuple[str, Entry]:
    """A name of any kind but robots and data sets, or a kind with the titles of its names."""
    names = {kind: _names(kind, robots_dir) for kind in _LISTS}  # no plug-in is imported for them
    kind = next((kind for kind in _SHOWS if name in names[kind]), None)
    if kind is not None:
        return (_singular(kind), _SHOWS[kind](name))
    if _plural(name) in _LISTS:
        return ("kind", _titles(_plural(name), robots_dir))
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
    return {"name": kind} | {
        entry["name"]: entry["title"] for entry in entries_of_kind(kind, robots_dir)
    }


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
