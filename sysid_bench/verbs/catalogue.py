"""Catalogue of robots, payloads, tasks, excitations, estimators, suites."""

import dataclasses
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from sysid_bench import naming, places
from sysid_bench.errors import SysidBenchError, unknown_name
from sysid_bench.tasks.task import TaskDefinition

Entry = dict[str, Any]


def list_(kind: str, robots_dir: Path | None = None) -> list[Entry]:
    """Everything of a kind (robots, payloads, tasks, excitations, estimators, suites, simulations,
    plants), each with name and title; an entry that cannot be read says so in its title."""
    if kind not in _LISTS:
        raise unknown_name("kind of thing", kind, _LISTS)
    return _LISTS[kind](robots_dir)


def show(name: str, robots_dir: Path | None = None) -> Entry:
    """One thing by its name: a robot's manifest as read, a payload, a plug-in's settings, or a
    suite. Raises UsageError with the nearest name of any kind."""
    from sysid_bench.models.manifest import is_model

    path = "/" in name or name.endswith((".urdf", ".xml"))
    if path or is_model(name) or name in places.robots(robots_dir):
        return _robot(name, robots_dir)
    found = {kind: {entry["name"] for entry in list_(kind, robots_dir)} for kind in _LISTS}
    for kind, make in _SHOWS.items():
        if name in found[kind]:
            return {"kind": kind.removesuffix("s"), **make(name)}
    raise unknown_name("thing", name, {n for names in found.values() for n in names})


def _robot(name: str, robots_dir: Path | None) -> Entry:
    from sysid_bench.models.manifest import find_manifest

    manifest = find_manifest(name, robots_dir)
    return {
        "kind": "robot",
        "name": manifest.name,
        "title": manifest.title,
        "file": str(manifest.path),
        "tool": manifest.tool,
        "free_base": manifest.free_base,
        "gravity": manifest.gravity,
        "terms": list(manifest.terms),
        "limits": {
            j: limits.model_dump(exclude_none=True) for j, limits in manifest.limits.items()
        },
        "joints": {j: terms.model_dump(exclude_none=True) for j, terms in manifest.joints.items()},
        "couplings": manifest.couplings,
        "coupling": {"independent": list(manifest.independent)},
        "sensors": [sensor.model_dump() for sensor in manifest.sensors],
        "licence": manifest.licence,
    }


def _robots(robots_dir: Path | None) -> list[Entry]:
    from sysid_bench.models.manifest import find_manifest

    entries = []
    for name in places.robots(robots_dir):
        try:
            manifest = find_manifest(name, robots_dir)
            entries.append({"name": name, "title": manifest.title, "free_base": manifest.free_base})
        except SysidBenchError as error:
            entries.append({"name": name, "title": f"cannot be read: {error}"})
    return entries


def _payloads(robots_dir: Path | None) -> list[Entry]:
    from sysid_bench.models.payload import PAYLOADS

    return [{"name": name, "title": _payload_title(name)} for name in PAYLOADS]


def _payload_title(name: str) -> str:
    from sysid_bench.models.payload import PAYLOADS

    payload = PAYLOADS[name]
    if not payload:
        return "nothing mounted"
    return f"{payload.mass:g} kg at ({', '.join(f'{1e3 * x:g}' for x in payload.com)}) mm"


def _payload(name: str) -> Entry:
    from sysid_bench.models.payload import PAYLOADS

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
            thing = naming.resolve(kind, name)
        except Exception as error:  # a stranger's entry point that does not import
            return {"name": name, "title": f"cannot be imported: {error}", "settings": {}}
        settings = {}
        if dataclasses.is_dataclass(thing):
            settings = {field.name: _default(field) for field in dataclasses.fields(thing)}
        title = (thing.__doc__ or "").strip().split("\n")[0]
        return {"name": name, "title": title, "at": naming.known(kind)[name], "settings": settings}

    return entry


def _task(name: str) -> Entry:
    """A task with what it declares."""
    entry = _plugin("task")(name)
    definition = naming.resolve("task", name)
    declared = [key for key in TaskDefinition.__annotations__ if key != "name"]
    return {**entry, **{key: getattr(definition, key) for key in declared}}


def _default(field: "dataclasses.Field[Any]") -> Any:
    if field.default is dataclasses.MISSING:
        return None
    unit = field.metadata.get("unit")
    return field.default if unit is None else f"{field.default} {unit}"


def _suites(robots_dir: Path | None) -> list[Entry]:
    return [{"name": name, "title": _suite_title(file)} for name, file in places.suites().items()]


def _suite_title(file: Path) -> str:
    try:
        return str(tomllib.loads(file.read_text(encoding="utf-8")).get("title", ""))
    except (tomllib.TOMLDecodeError, OSError, UnicodeDecodeError) as error:
        return f"cannot be read: {error}"


def _suite(name: str) -> Entry:
    file = places.suites()[name]
    return {"name": name, "file": str(file), **tomllib.loads(file.read_text(encoding="utf-8"))}


_LISTS: Final[Mapping[str, Callable[[Path | None], list[Entry]]]] = {
    "robots": _robots,
    "payloads": _payloads,
    "tasks": _plugins("task"),
    "excitations": _plugins("excitation"),
    "estimators": _plugins("estimator"),
    "simulations": _plugins("simulation"),
    "plants": _plugins("plant"),
    "suites": _suites,
}
_SHOWS: Final[Mapping[str, Callable[[str], Entry]]] = {
    "payloads": _payload,
    "tasks": _task,
    "excitations": _plugin("excitation"),
    "estimators": _plugin("estimator"),
    "simulations": _plugin("simulation"),
    "plants": _plugin("plant"),
    "suites": _suite,
}
