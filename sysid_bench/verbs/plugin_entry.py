"""Entries of plug-ins in lists of names: titles, settings, defaults."""

import dataclasses
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from sysid_bench import plugin_names
from sysid_bench.canonical_json import plain
from sysid_bench.experiments.job_channel import JobChannel
from sysid_bench.experiments.tasks.task import TaskDefinition
from sysid_bench.harness.work.worker_call import CallWorker, WorkerError
from sysid_bench.harness.worker_names import SECONDS
from sysid_bench.units import quantity

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
