"""Names whose third-party plug-ins are imported and built in a worker process, one for a suite."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from sysid_bench import plugin_names
from sysid_bench.canonical_json import canonical
from sysid_bench.errors import UsageError
from sysid_bench.experiments.job_channel import JobChannel
from sysid_bench.harness.suite.names import (
    CheckedName,
    Names,
    PlannedTask,
    default_names,
    name_error,
)
from sysid_bench.harness.work.worker_call import CallWorker, WorkerError
from sysid_bench.metrics import metric_of_plugin, metric_record

SECONDS: Final = 60.0
"""Time limit of importing and building one plug-in."""
_BUILD: Final = "sysid_bench.harness.worker_names:build_plugin"


@contextmanager
def worker_names(robots_dir: Path | None = None) -> Iterator[Names]:
    """Yield the names of this installation; third-party code stays out of this process."""
    own = default_names(robots_dir)
    with CallWorker(SECONDS) as worker:
        look_up = _LookUp(worker)
        plugin, task = partial(look_up.plugin, own.plugin), partial(look_up.task, own.task)
        yield replace(own, plugin=plugin, task=task)


@dataclass(frozen=True)
class _LookUp:
    """Look-ups in a worker, once each."""

    worker: CallWorker
    answers: dict[str, Mapping[str, Any]] = field(default_factory=dict)

    def plugin(
        self, build: Callable[[str, Mapping[str, Any]], object], kind: str, spec: Mapping[str, Any]
    ) -> object:
        """Build a plug-in; the record of a third-party metric, None for any other of others."""
        use = spec.get("use")
        if not isinstance(use, str) or not plugin_names.is_third_party(kind, use):
            return build(kind, spec)
        return self._ask(kind, use, {"spec": dict(spec)}).get("metric")

    def task(
        self, find: Callable[[str, Path | None], PlannedTask], name: str, folder: Path | None
    ) -> PlannedTask:
        """Facts of a task."""
        if not plugin_names.is_third_party("task", name):
            return find(name, folder)
        answer = self._ask("task", name, {"folder": None if folder is None else str(folder)})
        return CheckedName(name, supports_recordings=answer["supports_recordings"])

    def _ask(self, kind: str, use: str, more: Mapping[str, Any]) -> Mapping[str, Any]:
        argument = {"kind": kind, "use": use, **more}
        key = canonical(argument)
        if key not in self.answers:
            try:
                self.answers[key] = self.worker.call(_BUILD, argument, f"making {kind} {use!r}")
            except WorkerError as error:
                self.answers[key] = {"error": str(error)}
        answer = self.answers[key]
        if "error" in answer:
            raise UsageError(answer["error"])
        return answer


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
