"""Verb `survey`: the cross-check of every model of a collection or folder, supervised."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sysid_bench.commands.request import FAILED, INTERRUPTED, OK, Request, argument, option
from sysid_bench.commands.result import Result
from sysid_bench.errors import UsageError

if TYPE_CHECKING:
    from sysid_bench.apps.surveys.survey import Change, SurveyRecord
    from sysid_bench.harness.work.supervise import OnEvent
    from sysid_bench.harness.work.worker_process import Job


class SurveyCommand(Request["SurveyResult"]):
    """Cross-check every model of a collection or folder; count refusals by cause.

    Each model has a time limit and a memory limit in a process of its own. An interrupted survey
    goes on where it was. Collections are fetched first: sysid-bench fetch wild.
    """

    source: str = argument("COLLECTION|FOLDER|example-robot-data", complete="collections folders")
    out: Path | None = option(
        "Folder of rows and report; default: reports/<source>.",
        default=None, flags="-o --out", path="new folder", complete="folders",
    )  # fmt: skip
    samples: int = option("Random states to compare at.", default=10, shown=True)
    workers: int = option("Worker processes.", default=2, flags="-j", shown=True)
    timeout: float = option("Limit of a model.", default=150.0, unit="s", shown="150 s")
    limit: int | None = option("The first N models alone.", default=None, metavar="N", least=1)
    engines: bool = option(
        "Count what each engine reads of a file as it stands, too.",
        default=True, flags="--engines/--no-engines",
    )  # fmt: skip
    baseline: Path | None = option(
        "Exit code 1 where a model got worse than in this file.",
        default=None, path="file", metavar="FILE", complete="files",
    )  # fmt: skip
    save: Path | None = option(
        "Write such a baseline.", default=None, metavar="FILE", complete="files"
    )

    def run(self) -> "SurveyResult":
        """Survey the models; rows go to the folder `out`."""
        return self._surveyed(lambda kind, data: None)

    def _surveyed(self, on_event: "OnEvent") -> "SurveyResult":
        request = SurveyRequest(
            samples=self.samples,
            workers=self.workers,
            engines=self.engines,
            timeout=self.timeout,
            limit=self.limit,
            baseline=self.baseline,
        )
        return survey(self.source, self._folder, request, on_event=on_event)

    @property
    def _folder(self) -> Path:
        return self.out or Path("reports") / Path(self.source).name

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.progress import run_progress
        from sysid_bench.commands.terminal import print_result

        # Refused before the survey, which may take hours.
        if self.save is not None and self.save.is_dir():
            raise UsageError(f"{self.save} for --save is a folder; name a file.")
        if self.save is not None and not self.save.absolute().parent.is_dir():
            raise UsageError(
                f"The folder {self.save.parent} for --save does not exist; make it first."
            )
        with run_progress() as on_event:
            result = self._surveyed(on_event)
        if result.ending != "finished":  # a part is neither a report nor a baseline
            print_result(result, as_json)
            click.echo(f"{result.ending}; the same command goes on", err=True)
            return INTERRUPTED
        command = "sysid-bench " + " ".join(sys.argv[1:])
        result.write_markdown(self._folder / "report.md", f"Survey of {self.source}", command)
        if self.save is not None:
            result.write_baseline(self.save)
        print_result(result, as_json)
        return OK if result.holds_baseline else FAILED


@dataclass(frozen=True)
class SurveyRequest:
    """Settings of a survey. `samples`: random states of each cross-check; `engines`: also count
    what each engine reads of the file as it stands; `workers`: processes; `timeout` (s) and
    `memory` (bytes): limits of each model; `limit`: number of models, the first ones; `baseline`:
    file of values to compare with."""

    samples: int = 10
    workers: int = 2
    engines: bool = True
    timeout: float = 150.0
    memory: float = 4e9
    limit: int | None = None
    baseline: Path | None = None

    def __post_init__(self) -> None:
        if min(self.samples, self.workers) < 1 or min(self.timeout, self.memory) <= 0:
            raise UsageError("samples, workers, timeout and memory of a survey must be positive.")
        if self.limit is not None and self.limit < 1:
            raise UsageError(f"limit is {self.limit}; give 1 or more models, or leave it out.")


@dataclass(frozen=True, eq=False, repr=False)
class SurveyResult(Result):
    """Outcome of a survey. `loadable`: models of which an engine reads moving joints as the file
    stands, `loadable_ok` those of them that are ok; `causes`: number of refusals by cause;
    `changes` from the baseline."""

    source: str
    folder: str
    models: int
    ok: int
    loadable: int
    loadable_ok: int
    causes: dict[str, int]
    refused: list[dict[str, Any]]
    seconds_cpu: float
    ending: str
    changes: list[dict[str, Any]]
    surveyed: "tuple[SurveyRecord, ...]"

    @property
    def holds_baseline(self) -> bool:
        """True where no change from the baseline is for the worse."""
        return not any(change["worse"] for change in self.changes)

    def summary(self) -> str:
        """Counts by cause, and changes from the baseline."""
        from sysid_bench.apps.surveys.survey import counts_text

        words = (("worse" if c["worse"] else "better", c) for c in self.changes)
        changed = (f"{word}: {change['model']}: {change['text']}" for word, change in words)
        return "\n".join([counts_text(self.surveyed), *changed])

    def write_markdown(self, file: str | Path, title: str, command: str) -> None:
        """Write the report, which states the `command` that made it."""
        from sysid_bench.apps.surveys.survey import markdown

        Path(file).write_text(markdown(title, command, self.surveyed), encoding="utf-8")

    def write_baseline(self, file: str | Path) -> None:
        """Write the values that a later survey can be compared with."""
        from sysid_bench.apps.surveys.survey import baseline_text

        # A baseline is replaced whole: an interrupted write must not cost the old one.
        part = Path(file).with_name(f"{Path(file).name}.part")
        part.write_text(baseline_text(self.surveyed), encoding="utf-8")
        part.replace(file)

    def _fields(self) -> dict[str, Any]:
        return {key: value for key, value in super()._fields().items() if key != "surveyed"}


def survey(
    source: str | Path,
    out: str | Path,
    request: SurveyRequest | None = None,
    *,
    on_event: "OnEvent" = lambda kind, data: None,
) -> SurveyResult:
    """Cross-check every model of a collection that was fetched, of a folder, or of the package
    example-robot-data, each in a process with limits; files with equal content count once.

    Rows go to the folder `out`, at once: a survey that was interrupted goes on there, and models
    are computed again where the file or this package has changed. A hang, a crash or too much
    memory costs one model. Raises UsageError for an unknown source, for a collection that is not
    here, and for a folder without models.
    """
    from sysid_bench.apps.surveys.survey import compare_baseline, read_baseline
    from sysid_bench.harness.work.supervise import supervise
    from sysid_bench.harness.work.worker_process import WorkerSettings
    from sysid_bench.models.collection import source_folder

    asked = request or SurveyRequest()
    folder = Path(out)
    known = None if asked.baseline is None else read_baseline(asked.baseline)
    place = source_folder(str(source))
    jobs = _jobs(place, asked)
    open_jobs = _open_jobs(jobs, folder)
    cells = [cell["id"] for job in open_jobs for cell in job.cells]
    on_event("plan", {"seconds": dict.fromkeys(cells, 1.0), "open": len(cells)})
    settings = WorkerSettings(folder, asked.timeout, threads=1, memory=asked.memory)
    ending = supervise(open_jobs, settings, asked.workers, on_event=on_event)
    found = _records(jobs, folder)
    changes: Sequence[Change] = []
    if known is not None and ending == "finished":
        # Models that were not asked for are not gone.
        if asked.limit is not None:  # the part of the baseline with the models of these jobs
            chosen = {job.argument["id"] for job in jobs}
            known = {name: values for name, values in known.items() if name in chosen}
        changes = compare_baseline(known, found)
    return _result(str(source), folder, found, ending, changes)


def _records(jobs: "Sequence[Job]", folder: Path) -> "tuple[SurveyRecord, ...]":
    """Models that have a row, with what the engines read of them."""
    from sysid_bench.apps.surveys.commands.survey_model import ENGINES
    from sysid_bench.apps.surveys.survey import SurveyRecord
    from sysid_bench.harness.work.row_files import read_rows

    rows = read_rows(folder / "cells").rows
    names = [job.argument["id"] for job in jobs]
    return tuple(
        SurveyRecord(name, rows[name], rows.get(ENGINES + name)) for name in names if name in rows
    )


def _jobs(place: Path, asked: SurveyRequest) -> "list[Job]":
    """Jobs of the distinct models below a folder, which may read any file in it."""
    from sysid_bench.apps.surveys.commands.survey_model import CALL, ENGINES
    from sysid_bench.harness.work.worker_process import Job
    from sysid_bench.models.sources import hash_of_files, model_files
    from sysid_bench.version_fields import package_hash

    digests = hash_of_files(model_files(place, scenes=True))
    if not digests:
        raise UsageError(f"{place} holds no URDF or MJCF model; give a folder of models.")
    assets, jobs = str(place.resolve()), []
    for file, digest in islice(digests.items(), asked.limit):
        name = file.relative_to(place).as_posix()
        more = {"code": package_hash(), "model": digest, "samples": asked.samples}
        argument = {"id": name, "file": str(file.resolve()), "assets": assets, "more": more}
        names = (name, ENGINES + name) if asked.engines else (name,)
        # Fields of the row, too: a row of another file, code or number of states does not count.
        cells = tuple({"id": cell, **more} for cell in names)
        jobs.append(Job(CALL, argument, cells))
    return jobs


def _open_jobs(jobs: "Sequence[Job]", folder: Path) -> "list[Job]":
    """Jobs with the cells that have no row of the same file and code."""
    from sysid_bench.harness.work.row_files import read_rows
    from sysid_bench.input_files import is_folder

    stored = read_rows(folder / "cells").rows if is_folder(folder / "cells") else {}

    def is_done(cell: Mapping[str, Any]) -> bool:
        row = stored.get(cell["id"])
        # A lost row, of a worker that crashed, is tried again.
        return row is not None and row["status"] != "lost" and cell.items() <= row.items()

    rest = [job.of({c["id"]: c for c in job.cells if not is_done(c)}) for job in jobs]
    return [job for job in rest if job.cells]


def _result(
    source: str,
    folder: Path,
    found: "tuple[SurveyRecord, ...]",
    ending: str,
    changes: "Sequence[Change]",
) -> SurveyResult:
    from sysid_bench.apps.surveys.survey import counts_by_cause

    loadable = [model for model in found if model.is_loaded]
    refused = [model for model in found if not model.ok]
    return SurveyResult(
        source=source,
        folder=str(folder),
        models=len(found),
        ok=len(found) - len(refused),
        loadable=len(loadable),
        loadable_ok=sum(model.ok for model in loadable),
        causes=dict(counts_by_cause(found)),
        refused=[
            {
                "model": model.name,
                "cause": model.cause,
                "reason": model.row["reason"],
                "loadable": model.is_loaded,
            }
            for model in refused
        ],
        seconds_cpu=sum(model.row.get("seconds_cpu") or 0.0 for model in found),
        ending=ending,
        changes=[asdict(change) for change in changes],
        surveyed=found,
    )
