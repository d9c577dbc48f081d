"""Executors: where the jobs of a run are computed. Each is a plug-in of the kind `executor`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

from sysid_bench import plugin_names
from sysid_bench.errors import UsageError
from sysid_bench.harness.work.supervise import Ending, OnEvent, supervise
from sysid_bench.harness.work.worker_process import Job, WorkerSettings


@dataclass(frozen=True)
class Work:
    """Jobs of a run, and what executing them takes.

    `settings` hold the run folder and the limits of each cell; `seconds` the expected cost of each
    cell; `folders` those of the suite and of the robots, whose files a machine elsewhere lacks;
    `workers` the most processes of this machine.
    """

    jobs: Sequence[Job]
    settings: WorkerSettings
    seconds: Mapping[str, float]
    folders: tuple[Path, ...]
    workers: int
    fail_fast: bool = False


class RunEnd(NamedTuple):
    """End of the work, and notes for the user on the machines that did it."""

    ending: Ending
    notes: tuple[str, ...] = ()


class Executor(Protocol):
    """Computes jobs. The row of each of their cells is in `settings.folder`/cells exactly once when
    `work` returns "finished", whatever happened to the cell; limits are hard."""

    def work(self, work: Work, on_event: OnEvent) -> RunEnd:
        """Compute all jobs, and report events as `supervise` does. "interrupted" and "lost" leave
        cells without a row, which a resumed run computes."""
        ...


def executor_of(text: str) -> Executor:
    """Return the executor of "local", "dask://HOST:PORT", "dask+tls://HOST:PORT", "slurm:FILE",
    "NAME:ADDRESS" of another plug-in by name, "module:Class" or "file:x.py:Class".

    Raises UsageError for an unknown name and for settings that the executor does not take.
    """
    scheme, _, rest = text.partition(":")
    name, _, security = scheme.partition("+")
    address = rest.removeprefix("//")
    settings = {"address": address} if address else {}
    if "+" in scheme:
        settings["security"] = security
        if not security:
            raise UsageError(f"{text!r} has a '+' without a word; write 'dask+tls://HOST:PORT'.")
    # "my_lab.engine:Class" has a dot; a registered name with one has precedence.
    if scheme == "file" or ("." in scheme and name not in plugin_names.known("executor")):
        return plugin_names.build("executor", {"use": text})  # type: ignore[no-any-return]
    return plugin_names.build("executor", {"use": name, **settings})  # type: ignore[no-any-return]


@dataclass(frozen=True)
class Local:
    """Computes on at most `work.workers` processes of this machine."""

    def work(self, work: Work, on_event: OnEvent) -> RunEnd:
        """Supervise worker processes until all jobs have their rows."""
        ending = supervise(work.jobs, work.settings, work.workers, work.fail_fast, on_event)
        return RunEnd(ending)
