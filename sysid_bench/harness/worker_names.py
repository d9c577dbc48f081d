"""Names whose third-party plug-ins are imported and built in a worker process, one for a suite.

It is confined as a method is that is scored: planning gives third-party code nothing to read.
"""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench import plugin_names
from sysid_bench.canonical_json import canonical
from sysid_bench.errors import UsageError
from sysid_bench.experiments.job_channel import JobChannel
from sysid_bench.experiments.spec import SEEDS
from sysid_bench.harness.suite.names import (
    CheckedName,
    Names,
    default_names,
    name_error,
    static_names,
)
from sysid_bench.harness.work.worker_call import CallWorker, WorkerError
from sysid_bench.metrics import metric_of_plugin, metric_record

if TYPE_CHECKING:
    from sysid_bench.experiments.tasks.task import TaskDefinition

SECONDS: Final = 60.0
"""Time limit of importing and building one plug-in."""


@contextmanager
def worker_names(robots_dir: Path | None = None) -> Iterator[Names]:
    """Yield the names of this installation; third-party code stays out of this process.

    Where secret seeds are here, it runs nowhere: its source alone is read.
    """
    if os.environ.get(SEEDS):
        yield static_names(robots_dir)
        return
    own, answers = default_names(robots_dir), dict[str, Mapping[str, Any]]()

    def ask(argument: Mapping[str, Any]) -> Mapping[str, Any]:
        key = canonical(argument)
        # Sweeps name a plug-in many times; one call answers all of them.
        if key not in answers:
            title = f"making {argument['kind']} {argument['use']!r}"
            try:
                answers[key] = worker.call(f"{__name__}:build_plugin", argument, title)
            except WorkerError as error:
                answers[key] = {"error": str(error)}
        if "error" in answers[key]:
            raise UsageError(answers[key]["error"])
        return answers[key]

    def plugin(kind: str, spec: Mapping[str, Any]) -> object:
        use = spec.get("use")
        if not isinstance(use, str) or not plugin_names.is_third_party(kind, use):
            return own.plugin(kind, spec)
        return ask({"kind": kind, "use": use, "spec": dict(spec)}).get("metric")

    def task(name: str, folder: Path | None) -> "TaskDefinition | CheckedName":
        if not plugin_names.is_third_party("task", name):
            return own.task(name, folder)
        place = None if folder is None else str(folder)
        answer = ask({"kind": "task", "use": name, "folder": place})
        return CheckedName(name, supports_recordings=answer["supports_recordings"])

    with CallWorker(SECONDS, is_confined=True) as worker:
        yield replace(own, plugin=plugin, task=task)


def build_plugin(argument: Mapping[str, Any], channel: JobChannel) -> dict[str, Any]:
    """Import and build one plug-in; return what planning needs of it, or {error}."""
    kind, folder = argument["kind"], argument.get("folder")
    try:
        if kind == "task":
            task = default_names().task(argument["use"], None if folder is None else Path(folder))
            return {"supports_recordings": bool(task.supports_recordings)}
        thing = plugin_names.build(kind, argument["spec"])
        return {"metric": metric_record(metric_of_plugin(thing))} if kind == "metric" else {}
    except (Exception, SystemExit) as error:  # the file of a plug-in may call sys.exit()
        return {"error": name_error(error)}
