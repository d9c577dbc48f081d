"""Catalogue of names: robots, payloads, excitations, estimators, suites, simulations, plants."""

import dataclasses
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from sysid_bench import naming, places
from sysid_bench.errors import SysidBenchError, UsageError, unknown_name
from sysid_bench.input_files import parse_toml, read_text
from sysid_bench.metrics import METRICS
from sysid_bench.models.manifest import find_manifest, is_model
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.tasks.task import TaskDefinition
from sysid_bench.verbs.result import Result

Entry = dict[str, Any]

_SENTENCE_END: Final = re.compile(r"(?<=\.) (?=[A-Z`])")
"""A full stop before a capital or a name; "et al. (2010)" and "i.e. x" do not end a sentence."""


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
    simulations, plants, model-errors, sensor-errors, metrics, log-readers; singular or plural) with
    name and title; the title of an entry that cannot be read states the reason."""
    plural = _plural(kind)
    if plural not in _LISTS:
        raise unknown_name("kind", kind, _LISTS)
    return _LISTS[plural](robots_dir)


def show(name: str, robots_dir: Path | None = None) -> ShowResult:
    """Return a robot's manifest as read, a payload, the settings of a plug-in, or a suite; for a
    kind, the titles of its names.

    Raises UsageError with the nearest name of any kind.
    """
    if _is_robot(name, robots_dir):
        return ShowResult("robot", _robot(name, robots_dir))
    names = {kind: _names(kind, robots_dir) for kind in _LISTS}
    kind = next((kind for kind in _SHOWS if name in names[kind]), None)
    if kind is not None:
        return ShowResult(kind.removesuffix("s"), _SHOWS[kind](name))
    if _plural(name) in _LISTS:
        return ShowResult("kind", _titles(_plural(name), robots_dir))
    raise unknown_name("name", name, set().union(*names.values()))


def _is_robot(name: str, robots_dir: Path | None) -> bool:
    """Test for the file or the name of a robot, which need not exist where it is a path."""
    path = "/" in name or name.endswith((".urdf", ".xml"))
    return path or is_model(name) or name in places.robots(robots_dir)


def _names(kind: str, robots_dir: Path | None) -> set[str]:
    return {entry["name"] for entry in list_(kind, robots_dir)}


def _plural(kind: str) -> str:
    """Kind as it is listed: "log-readers" for "log_reader"."""
    return kind.replace("_", "-").removesuffix("s") + "s"


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
    for name in places.robots(robots_dir):
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


def _plugins(kind: str) -> Callable[[Path | None], list[Entry]]:
    def entries(robots_dir: Path | None) -> list[Entry]:
        return [
            {"name": name, "title": _plugin(kind)(name)["title"]} for name in naming.known(kind)
        ]

    return entries


def _plugin(kind: str) -> Callable[[str], Entry]:
    def entry(name: str) -> Entry:
        try:
            plugin = naming.resolve(kind, name)
        except Exception as error:  # an entry point of another package that does not import
            return {"name": name, "title": f"cannot be imported: {error}", "settings": {}}
        settings = {}
        if dataclasses.is_dataclass(plugin):
            settings = {field.name: _default(field) for field in dataclasses.fields(plugin)}
        title = _first_sentence(plugin.__doc__ or "")
        return {"name": name, "title": title, "at": naming.known(kind)[name], "settings": settings}

    return entry


def _first_sentence(text: str) -> str:
    """First sentence of a docstring on one line; the whole paragraph where no other
    follows."""
    paragraph = " ".join(text.strip().partition("\n\n")[0].split())
    return _SENTENCE_END.split(paragraph, maxsplit=1)[0]


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default is dataclasses.MISSING:
        return None
    unit = field.metadata.get("unit")
    return field.default if unit is None else f"{field.default} {unit}"


def _suites(robots_dir: Path | None) -> list[Entry]:
    return [
        {"name": name, "title": _suite_title(file)} for name, file in places.suite_files().items()
    ]


def _suite_title(file: Path) -> str:
    try:
        return str(parse_toml(read_text(file)).get("title", ""))
    except (OSError, ValueError) as error:
        return f"cannot be read: {error}"


def _suite(name: str) -> Entry:
    file = places.suite_files()[name]
    try:
        return {"name": name, "file": str(file), **parse_toml(read_text(file))}
    except (OSError, ValueError) as error:
        raise UsageError(f"The suite {str(file)!r} cannot be read: {error}.") from error


def _task(name: str) -> Entry:
    """A task with what it declares."""
    definition = naming.resolve("task", name)
    declared = [key for key in TaskDefinition.__annotations__ if key != "name"]
    return {**_plugin("task")(name), **{key: getattr(definition, key) for key in declared}}


def _metrics(robots_dir: Path | None) -> list[Entry]:
    """Built-in metrics with unit, direction and formula, then plug-ins of installed packages."""
    built_in = [
        {
            "name": metric.name,
            "title": ": ".join(
                filter(None, (f"{metric.heading} {metric.arrow}".strip(), metric.formula))
            ),
            "unit": metric.unit,
            "better": metric.better,
            "level": metric.level,
            "needs": list(metric.needs),
            "formula": metric.formula,
        }
        for metric in METRICS.values()
    ]
    return built_in + _plugins("metric")(robots_dir)


def _metric(name: str) -> Entry:
    return next(entry for entry in _metrics(None) if entry["name"] == name)


_LISTS: Final[Mapping[str, Callable[[Path | None], list[Entry]]]] = {
    "robots": _robots,
    "payloads": _payloads,
    "tasks": _plugins("task"),
    "excitations": _plugins("excitation"),
    "estimators": _plugins("estimator"),
    "simulations": _plugins("simulation"),
    "plants": _plugins("plant"),
    "model-errors": _plugins("model_error"),
    "sensor-errors": _plugins("sensor_error"),
    "metrics": _metrics,
    "log-readers": _plugins("log_reader"),
    "suites": _suites,
}
_SHOWS: Final[Mapping[str, Callable[[str], Entry]]] = {
    "payloads": _payload,
    "tasks": _task,
    "excitations": _plugin("excitation"),
    "estimators": _plugin("estimator"),
    "simulations": _plugin("simulation"),
    "plants": _plugin("plant"),
    "model-errors": _plugin("model_error"),
    "sensor-errors": _plugin("sensor_error"),
    "metrics": _metric,
    "log-readers": _plugin("log_reader"),
    "suites": _suite,
}
