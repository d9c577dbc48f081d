"""Catalogue of names: robots, payloads, plug-ins, suites, data sets, words of suites."""

import dataclasses
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from sysid_bench import package_folders, plugin_names
from sysid_bench.canonical_json import plain
from sysid_bench.errors import SysidBenchError, UsageError, unknown_name
from sysid_bench.experiments.job_channel import JobChannel
from sysid_bench.experiments.tasks.task import TaskDefinition
from sysid_bench.harness.suite.plugin_entries import read_plant
from sysid_bench.harness.work.worker_call import CallWorker, WorkerError
from sysid_bench.harness.worker_names import SECONDS
from sysid_bench.input_files import parse_toml, read_text
from sysid_bench.metrics import METRICS
from sysid_bench.models.collection import read_collection
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


def entries_of_kind(kind: str | None, robots_dir: Path | None = None) -> list[Entry]:
    """Return everything of a kind, singular or plural, with name and title; None: the kinds."""
    if kind is None:
        return [{"name": one, "title": f"sysid-bench list {one}"} for one in KINDS]
    kinds, plural = _kinds(robots_dir), _plural(kind)
    if plural not in kinds:
        raise unknown_name("kind", kind, kinds)
    found: list[Entry] = []
    for name in kinds[plural].names():
        try:
            found.append({"name": name, **kinds[plural].line(name)})
        except (SysidBenchError, OSError, ValueError) as error:
            # One damaged file must not hide all other names of its kind.
            found.append({"name": name, "title": f"cannot be read: {error}"})
    registered = plugin_names.known(_singular(plural))
    with CallWorker(SECONDS, is_confined=True) as worker:
        plugins = [_plugin(_singular(plural), name, worker) for name in registered]
    shown = ("name", "title", "frame_dependent")
    return found + [{key: one[key] for key in shown if key in one} for one in plugins]


def find_entry(name: str, robots_dir: Path | None = None) -> tuple[str, Entry]:
    """Return (kind, entry) of a name; raises UsageError with the nearest name of any kind."""
    plain_name, settings = source_settings(name)
    if not settings and (name.startswith(SCHEME) or is_dataset(name)):
        return ("dataset", _dataset(name.removeprefix(SCHEME)))
    if _is_robot(plain_name, robots_dir):
        return ("robot", _robot(name, robots_dir))
    if settings:
        raise UsageError(f"{plain_name!r} is not a robot: only robots have {', '.join(settings)}.")
    names: set[str] = set()  # no plug-in is imported for them
    for kind, one in _kinds(robots_dir).items():
        own, registered = {*one.names()}, plugin_names.known(_singular(kind))
        if name in own:
            return (_singular(kind), one.entry(name))
        if name in registered:
            with CallWorker(SECONDS, is_confined=True) as worker:
                return (_singular(kind), _plugin(_singular(kind), name, worker))
        names |= own | registered.keys()
    if _plural(name) in KINDS:
        # Titles import plug-ins: only where no name was found.
        titles = {entry["name"]: entry["title"] for entry in entries_of_kind(name, robots_dir)}
        return ("kind", {"name": _plural(name)} | titles)
    raise unknown_name("name", name, names)


def _is_robot(name: str, robots_dir: Path | None) -> bool:
    """True for a model file, a model of a collection and a robot of a folder."""
    is_path = "/" in name or name.endswith((".urdf", ".xml"))
    return is_path or is_model(name) or name in package_folders.robots(robots_dir)


# --- Plug-ins -----------------------------------------------------------------------------------


def _plugin(kind: str, name: str, worker: CallWorker) -> Entry:
    """Entry of a plug-in; an entry point of another package is imported in a worker."""
    kind = kind.replace("-", "_")
    argument = {"kind": kind, "name": name}
    if plugin_names.is_of_package(kind, name):
        return plugin_entry(argument)
    try:
        return dict(worker.call(f"{__name__}:plugin_entry", argument, "cannot be imported"))
    except WorkerError as error:
        target = plugin_names.known(kind)[name]
        return {"name": name, "title": str(error), "at": target, "settings": {}}


def plugin_entry(argument: Mapping[str, str], channel: JobChannel | None = None) -> Entry:
    """Import a plug-in; return its title, its settings, and what a task declares."""
    kind, name = argument["kind"], argument["name"]
    plugin = plugin_names.resolve(kind, name)
    settings = {}
    if dataclasses.is_dataclass(plugin):
        settings = {field.name: _default(field) for field in dataclasses.fields(plugin)}
    paragraph = " ".join(str(plugin.__doc__ or "").strip().partition("\n\n")[0].split())
    entry = {
        "name": name,
        "title": _SENTENCE_END.split(paragraph, maxsplit=1)[0],
        "at": plugin_names.known(kind)[name],
        "settings": settings,
    }
    if reason := getattr(plugin, "frame_dependent", ""):
        entry["frame_dependent"] = reason
    if kind == "task":
        declared = (key for key in TaskDefinition.__annotations__ if key != "name")
        entry |= {key: _json_value(getattr(plugin, key)) for key in declared}
    return entry


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


# --- Words of suites ----------------------------------------------------------------------------

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


WORDS: Final[Mapping[str, Mapping[str, str]]] = {
    "terms": {name: _TERM_TITLES[name] for name in TERMS},
    "filters": {form: str(kind.__doc__).partition("\n")[0] for form, kind in FORMS.items()},
    "integrators": _INTEGRATOR_TITLES,
    "statistics": {name: f"{text.capitalize()}." for name, text in STATISTICS.items()},
    "intervals": {name: f"{text.capitalize()}." for name, text in INTERVALS.items()},
    "statuses": {name: _STATUS_TITLES[name] for name in STATUSES},
}
"""Meaning of each word, by its kind."""


# --- Kinds --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Kind:
    """A kind of names: those that are no plug-ins, the fields of `list` of one of them, and the
    entry that `show` prints."""

    names: Callable[[], Iterable[str]] = lambda: ()
    line: Callable[[str], Entry] = lambda name: {}
    entry: Callable[[str], Entry] = lambda name: {}


def _kinds(robots_dir: Path | None) -> dict[str, _Kind]:
    """All kinds, in the order in which a name is looked for."""

    def robot_line(name: str) -> Entry:
        manifest = find_manifest(name, robots_dir)
        return {"title": manifest.title, "free_base": manifest.free_base}

    def word(kind: str, name: str) -> Entry:
        return {"name": name, "title": WORDS[kind][name]}

    folders, plugins = package_folders, _Kind()
    robots = partial(folders.robots, robots_dir)
    return {
        "robots": _Kind(robots, robot_line, partial(_robot, robots_dir=robots_dir)),
        "payloads": _Kind(partial(iter, PAYLOADS), _payload_line, _payload),
        "tasks": plugins,
        "excitations": plugins,
        "estimators": plugins,
        "simulations": plugins,
        "plants": _Kind(folders.plant_files, partial(_file_line, folders.plant_files), _plant),
        "model-errors": plugins,
        "sensor-errors": plugins,
        "pipelines": plugins,
        "metrics": _Kind(partial(iter, METRICS), _metric, _metric),
        "log-readers": plugins,
        "suites": _Kind(folders.suite_files, partial(_file_line, folders.suite_files), _suite),
        "datasets": _Kind(folders.dataset_files, _dataset_line, _dataset),
        "collections": _Kind(folders.collection_files, _collection_line, _collection),
        "motors": _Kind(motor_names, _motor_line, _motor),
        "executors": plugins,
        **{
            kind: _Kind(partial(iter, WORDS[kind]), partial(word, kind), partial(word, kind))
            for kind in WORDS
        },
    }


def _plural(kind: str) -> str:
    """Kind as it is listed: "log-readers" for "log_reader"."""
    name = kind.replace("_", "-")
    return next((known for known in KINDS if name in (known, _singular(known))), name)


def _singular(kind: str) -> str:
    """One of a kind: "log-reader", "status"."""
    return kind.removesuffix("es" if kind.endswith("ses") else "s")


def _robot(name: str, robots_dir: Path | None) -> Entry:
    def given(by_joint: Mapping[str, BaseModel]) -> Entry:
        """Keys of each joint that the manifest gives."""
        return {joint: table.model_dump(exclude_none=True) for joint, table in by_joint.items()}

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
        "limits": given(manifest.limits),
        "joints": given(manifest.joints),
        "couplings": manifest.couplings,
        "coupling": {"independent": list(manifest.independent)},
        "sensors": [sensor.model_dump() for sensor in manifest.sensors],
        "licence": manifest.licence,
    }


def _payload_line(name: str) -> Entry:
    payload = PAYLOADS[name]
    if not payload:
        return {"title": "nothing mounted"}
    place = ", ".join(f"{1e3 * x:g}" for x in payload.com)
    return {"title": f"{payload.mass:g} kg at ({place}) mm"}


def _payload(name: str) -> Entry:
    return dataclasses.asdict(PAYLOADS[name])


def _file_line(files: Callable[[], Mapping[str, Path]], name: str) -> Entry:
    return {"title": str(parse_toml(read_text(files()[name])).get("title", ""))}


def _suite(name: str) -> Entry:
    file = package_folders.suite_files()[name]
    try:
        return {"name": name, "file": str(file), **parse_toml(read_text(file))}
    except (OSError, ValueError) as error:
        raise UsageError(f"The suite {str(file)!r} cannot be read: {error}.") from error


def _plant(name: str) -> Entry:
    file = package_folders.plant_files()[name]
    return {"file": str(file), **read_plant(file)}


def _dataset_line(name: str) -> Entry:
    return {"title": find_dataset(name).described.title}


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


def _collection_line(name: str) -> Entry:
    return {"title": read_collection(package_folders.collection_files()[name]).title}


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


def _motor_line(name: str) -> Entry:
    return {"title": motor_names()[name].keys.title}


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


def _metric(name: str) -> Entry:
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


KINDS: Final = tuple(_kinds(None))
"""Kinds that can be listed."""
