"""Third-party code of a suite: the modules and files of plug-ins that are not of this package."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path

from sysid_bench.errors import UsageError
from sysid_bench.experiments.simulated.composed_plant import plant_entries
from sysid_bench.experiments.third_party import log_reader_names, manifest_terms, term_names
from sysid_bench.harness.suite.model import LogEntry, Suite
from sysid_bench.harness.suite.plugin_entries import Plugin
from sysid_bench.plugin_names import is_third_party, known
from sysid_bench.signals.log_description import log_description


def third_party_names(suite: Suite, robots_dir: Path | None = None) -> tuple[tuple[str, str], ...]:
    """Return (kind, name) of each third-party plug-in that a suite names, once each; `robots_dir`:
    folder of robots instead of the suite's own."""
    folder = robots_dir or suite.robots_folder
    return tuple(dict.fromkeys(used for used in _plugins(suite, folder) if is_third_party(*used)))


def code_note(plugins: Iterable[tuple[str, str]]) -> str:
    """Return "runs code: file:x.py, mylab.methods"; empty without third-party plug-ins."""
    modules = (known(kind).get(name, name).rpartition(":")[0] for kind, name in plugins)
    text = ", ".join(dict.fromkeys(modules))
    return f"runs code: {text}" if text else ""


def _plugins(suite: Suite, robots_dir: Path | None) -> Iterator[tuple[str, str]]:
    axes = suite.defaults
    entries: Iterable[Plugin] = (
        *suite.estimator, *suite.metric, *axes.excitation, *chain.from_iterable(axes.held_out),
        *axes.simulation, *(axes.pipeline or ()),
    )  # fmt: skip
    yield from ((entry.kind, entry.use) for entry in entries)
    for plant in axes.plant:
        yield from ((kind, str(spec["use"])) for kind, spec in plant_entries(plant.spec))
    yield from (("task", task) for task in axes.task)
    for log in suite.log:
        yield from _log_plugins(suite, log, robots_dir)


def _log_plugins(suite: Suite, log: LogEntry, robots_dir: Path | None) -> Iterator[tuple[str, str]]:
    yield "task", log.task
    yield from ((entry.kind, entry.use) for entry in log.pipeline or ())
    yield from term_names(chain.from_iterable(filter(None, (*log.terms, *log.choose))))
    yield from manifest_terms(log.robot, robots_dir, suite.folder)
    for written in (*log.train, *log.test):
        with suppress(UsageError):  # a frozen suite whose files are gone: reported by its cells
            yield from log_reader_names(log_description(written, suite.folder))
