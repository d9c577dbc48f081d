"""Survey of model files: the cross-check of every model of a collection or folder, supervised."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sysid_bench.apps.surveys.collection import source_folder
from sysid_bench.apps.surveys.survey import (
    Change,
    SurveyRecord,
    baseline_text,
    compare_baseline,
    counts_by_cause,
    counts_text,
    markdown,
    read_baseline,
)
from sysid_bench.commands.result import Result
from sysid_bench.errors import UsageError
from sysid_bench.harness.work.row_files import read_rows
from sysid_bench.harness.work.supervise import OnEvent, no_progress, supervise
from sysid_bench.harness.work.worker_process import Job, WorkerSettings
from sysid_bench.input_files import is_folder
from sysid_bench.models.sources import hash_of_files, model_files
from sysid_bench.types import Row
from sysid_bench.verbs.model.survey_model import CALL, ENGINES
from sysid_bench.version_fields import package_hash


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
    surveyed: tuple[SurveyRecord, ...]

    @property
    def holds_baseline(self) -> bool:
        """True where no change from the baseline is for the worse."""
        return not any(change["worse"] for change in self.changes)

    def summary(self) -> str:
        """Counts by cause, and changes from the baseline."""
        words = (("worse" if c["worse"] else "better", c) for c in self.changes)
        changed = (f"{word}: {change['model']}: {change['text']}" for word, change in words)
        return "\n".join([counts_text(self.surveyed), *changed])

    def write_markdown(self, file: str | Path, title: str, command: str) -> None:
        """Write the report, which states the `command` that made it."""
        Path(file).write_text(markdown(title, command, self.surveyed), encoding="utf-8")

    def write_baseline(self, file: str | Path) -> None:
        """Write the values that a later survey can be compared with."""
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
    on_event: OnEvent = no_progress,
) -> SurveyResult:
    """Cross-check every model of a collection that was fetched, of a folder, or of the package
    example-robot-data, each in a process with limits; files with equal content count once.

    Rows go to the folder `out`, at once: a survey that was interrupted goes on there, and models
    are computed again where the file or this package has changed. A hang, a crash or too much
    memory costs one model. Raises UsageError for an unknown source, for a collection that is not
    here, and for a folder without models.
    """
    asked = request or SurveyRequest()
    folder = Path(out)
    known = None if asked.baseline is None else read_baseline(asked.baseline)
    place = source_folder(str(source))
    jobs = _jobs(find_model_files(place), place, asked)
    open_jobs = _open_jobs(jobs, folder)
    cells = _cells(open_jobs)
    on_event("plan", {"seconds": dict.fromkeys(cells, 1.0), "open": len(cells)})
    settings = WorkerSettings(folder, asked.timeout, threads=1, memory=asked.memory)
    ending = supervise(open_jobs, settings, asked.workers, on_event=on_event)
    found = _surveyed(jobs, read_rows(folder / "cells").rows)
    if known is None or ending != "finished":
        return _result(str(source), folder, found, ending, [])
    if asked.limit is not None:
        known = _of_jobs(known, jobs)
    return _result(str(source), folder, found, ending, compare_baseline(known, found))


def _of_jobs(known: Mapping[str, Any], jobs: Sequence[Job]) -> dict[str, Any]:
    """The part of a baseline with the models of these jobs."""
    chosen = {job.argument["id"] for job in jobs}
    return {name: values for name, values in known.items() if name in chosen}


def find_model_files(folder: Path) -> dict[str, Path]:
    """Return the distinct models below a folder by name: their path in it."""
    files = hash_of_files(model_files(folder, scenes=True))
    if not files:
        raise UsageError(f"{folder} holds no URDF or MJCF model; give a folder of models.")
    return {file.relative_to(folder).as_posix(): file for file in files}


def _jobs(models: Mapping[str, Path], place: Path, asked: SurveyRequest) -> list[Job]:
    """Jobs of models, which may read any file below `place`."""
    assets = str(place.resolve())
    chosen = list(models.items())[: asked.limit]
    digests = hash_of_files([file for _, file in chosen])
    jobs = []
    for name, file in chosen:
        more = {"code": package_hash(), "model": digests[file], "samples": asked.samples}
        argument = {"id": name, "file": str(file.resolve()), "assets": assets, "more": more}
        names = (name, ENGINES + name) if asked.engines else (name,)
        cells = tuple({"id": cell, **more} for cell in names)
        jobs.append(Job(CALL, argument, cells))
    return jobs


def _open_jobs(jobs: Sequence[Job], folder: Path) -> list[Job]:
    """Jobs with the cells that have no row of the same file and code."""
    cells = folder / "cells"
    stored = read_rows(cells).rows if is_folder(cells) else {}
    rest = [job.of(_open_cells(job, stored)) for job in jobs]
    return [job for job in rest if job.cells]


def _open_cells(job: Job, stored: Mapping[str, Row]) -> dict[str, Any]:
    return {c["id"]: c for c in job.cells if not _is_done(c, stored.get(c["id"]))}


def _is_done(cell: Mapping[str, Any], row: Row | None) -> bool:
    return row is not None and row["status"] != "lost" and cell.items() <= row.items()


def _cells(jobs: Iterable[Job]) -> list[str]:
    return [cell["id"] for job in jobs for cell in job.cells]


def _surveyed(jobs: Iterable[Job], rows: Mapping[str, Row]) -> tuple[SurveyRecord, ...]:
    names = [job.argument["id"] for job in jobs]
    return tuple(
        SurveyRecord(name, rows[name], rows.get(ENGINES + name)) for name in names if name in rows
    )


def _result(
    source: str,
    folder: Path,
    found: tuple[SurveyRecord, ...],
    ending: str,
    changes: Sequence[Change],
) -> SurveyResult:
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
        refused=list(map(_refusal, refused)),
        seconds_cpu=sum(map(_cpu_seconds, found)),
        ending=ending,
        changes=[asdict(change) for change in changes],
        surveyed=found,
    )


def _cpu_seconds(model: SurveyRecord) -> float:
    return model.row.get("seconds_cpu") or 0.0


def _refusal(model: SurveyRecord) -> dict[str, Any]:
    kept = {"cause": model.cause, "reason": model.row["reason"], "loadable": model.is_loaded}
    return {"model": model.name, **kept}
