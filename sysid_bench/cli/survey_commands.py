"""Command about many models: survey."""

import sys
from pathlib import Path

import click

import sysid_bench
from sysid_bench.cli.options import (
    FAILED,
    INTERRUPTED,
    OK,
    OptionsRecord,
    group_options,
    json_option,
    print_result,
    report_errors,
)
from sysid_bench.commands.progress import run_progress
from sysid_bench.errors import UsageError


class _Limits(OptionsRecord):
    workers: int
    timeout: str
    memory: str
    limit: int | None
    engines: bool


class _Files(OptionsRecord):
    baseline: Path | None
    save: Path | None
    title: str | None


@click.command()
@click.argument("source", metavar="COLLECTION|FOLDER|example-robot-data")
@click.option(
    "-o",
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder of rows and report; default: reports/<source>.",
)
@click.option("--samples", default=10, show_default=True, help="Random states to compare at.")
@group_options(
    "limits",
    _Limits,
    [
        click.option("-j", "workers", default=2, show_default=True, help="Worker processes."),
        click.option("--timeout", default="150 s", show_default=True, help="Limit of a model."),
        click.option("--memory", default="4 GB", show_default=True, help="Limit of a process."),
        click.option(
            "--limit", type=click.IntRange(min=1), metavar="N", help="The first N models alone."
        ),
        click.option(
            "--engines/--no-engines",
            default=True,
            help="Count what each engine reads of a file as it stands, too.",
        ),
    ],
)
@group_options(
    "files",
    _Files,
    [
        click.option(
            "--baseline",
            type=click.Path(path_type=Path, exists=True, dir_okay=False),
            metavar="FILE",
            help="Exit code 1 where a model got worse than in this file.",
        ),
        click.option(
            "--save",
            type=click.Path(path_type=Path, dir_okay=False),
            metavar="FILE",
            help="Write such a baseline.",
        ),
        click.option("--title", help="Title of the report."),
    ],
)
@json_option
@report_errors
def survey(
    source: str, out: Path | None, samples: int, limits: _Limits, files: _Files, as_json: bool
) -> int:
    """Cross-check every model of a collection or folder; count refusals by cause.

    Each model has a time limit and a memory limit in a process of its own. An interrupted survey
    goes on where it was. Collections are fetched first: sysid-bench fetch wild.
    """
    from sysid_bench.units import quantity  # numpy, which --help does without

    _check_save(files)
    folder = out or Path("reports") / Path(source).name
    request = sysid_bench.SurveyRequest(
        samples=samples,
        workers=limits.workers,
        engines=limits.engines,
        timeout=quantity(limits.timeout, "s"),
        memory=quantity(limits.memory, "B"),
        limit=limits.limit,
        baseline=files.baseline,
    )
    with run_progress() as on_event:
        result = sysid_bench.survey(source, folder, request, on_event=on_event)
    if result.ending != "finished":  # a part is neither a report nor a baseline
        print_result(result, as_json)
        click.echo(f"{result.ending}; the same command goes on", err=True)
        return INTERRUPTED
    command = "sysid-bench " + " ".join(sys.argv[1:])
    result.write_markdown(folder / "report.md", files.title or f"Survey of {source}", command)
    if files.save is not None:
        result.write_baseline(files.save)
    print_result(result, as_json)
    return OK if result.holds_baseline else FAILED


def _check_save(files: _Files) -> None:
    """Raise UsageError, before the survey, for a baseline whose folder is absent."""
    if files.save is not None and not files.save.absolute().parent.is_dir():
        raise UsageError(
            f"The folder {files.save.parent} for --save does not exist; make it first."
        )
