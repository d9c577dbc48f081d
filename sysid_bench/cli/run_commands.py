"""Commands on a run: status, cells, cell, limits, table, report, record, view."""

import shlex
from pathlib import Path

import click

import sysid_bench
from sysid_bench.cli.options import (
    FAILED,
    NOTHING,
    OK,
    json_option,
    print_result,
    report_errors,
    robots_option,
)
from sysid_bench.commands.terminal import print_table, terminal_lines, terminal_output
from sysid_bench.commands.values import parse_condition, parse_names


@click.command()
@click.argument("run_folder", metavar="RUN")
@json_option
@report_errors
def status(run_folder: str, as_json: bool) -> int:
    """Show the progress of a run, and the reasons of failures."""
    print_result(sysid_bench.status(run_folder), as_json)
    return OK


@click.command()
@click.argument("run_folder", metavar="RUN")
@json_option
@report_errors
def limits(run_folder: str, as_json: bool) -> int:
    """Print the best error of each recorded robot of a run, and how much is left to win."""
    print_result(sysid_bench.limits(run_folder), as_json)
    return OK


@click.command()
@click.argument("run_folder", metavar="RUN")
@click.argument("identifier", metavar="ID")
@json_option
@report_errors
def cell(run_folder: str, identifier: str, as_json: bool) -> int:
    """Show one row, its traceback, and the command that reproduces it."""
    print_result(sysid_bench.cell(run_folder, identifier), as_json)
    return OK


@click.command()
@click.argument("run_folder", metavar="RUN")
@click.option("--select", help="Only cells that meet this expression of cells, status and metrics.")
@click.option("--sort", metavar="FIELD", help="Order; -FIELD from the largest.")
@click.option("--show", metavar="FIELD,...", help="Further columns.")
@click.option("--long", "is_long", is_flag=True, help="Reason and reproduce command of each cell.")
@click.option("--limit", type=click.IntRange(min=1), help="Only the first N; a screen by default.")
@click.option("--sample", type=click.IntRange(min=1), help="So many of them, drawn by their ids.")
@click.option(
    "--last-bits",
    "repeats",
    type=click.IntRange(min=0),
    default=0,
    help="Repeat each N times on data whose last bits differ; show what that changes.",
)
@json_option
@report_errors
def cells(
    run_folder: str,
    select: str | None,
    sort: str | None,
    show: str | None,
    is_long: bool,
    limit: int | None,
    sample: int | None,
    repeats: int,
    as_json: bool,
) -> int:
    """List the cells of a run with their ids.

    Exit code 4 where none is selected.
    """
    result = sysid_bench.cells(
        run_folder, parse_condition(select), sort, parse_names(show), sample=sample, repeats=repeats
    )
    if as_json:
        print_result(result, as_json)
    else:
        text = result.text(limit or (None if is_long else terminal_lines()), long=is_long)
        click.echo(terminal_output(text))
    return OK if result.cells else NOTHING


@click.command()
@click.argument("run_folder", metavar="RUN")
@click.argument("name")
@click.option("--format", "form", help="md, csv, latex or json; default: drawn, piped as md.")
@report_errors
def table(run_folder: str, name: str, form: str | None) -> int:
    """Print one table of a run."""
    print_table(sysid_bench.table(run_folder, name, form or "md"), form)
    return OK


@click.command()
@click.argument("runs", metavar="RUN...", nargs=-1, required=True)
@click.option("--suite", help="Suite whose claims are tested, in place of those of the runs.")
@click.option("--format", "form", help="md, csv or latex; default: drawn, piped as md.")
@click.option("--gate", is_flag=True, help="Exit code 1 unless claims with gate = true hold.")
@json_option
@report_errors
def claims(
    runs: tuple[str, ...], suite: str | None, form: str | None, gate: bool, as_json: bool
) -> int:
    """Test the claims of runs on their stored rows: holds, fails, open or not testable."""
    result = sysid_bench.claims(*runs, suite=suite)
    if as_json:
        print_result(result, as_json)
    else:
        print_table(result.text(form or "md"), form)
    return FAILED if gate and not result.ok else OK


@click.command()
@click.argument("run_folder", metavar="RUN")
@report_errors
def report(run_folder: str) -> int:
    """Write a run's tables, figures and report.html again."""
    click.echo(str(sysid_bench.report(run_folder)))
    return OK


@click.command()
@click.argument("run_folder", metavar="RUN")
@click.argument("name", required=False)
@click.option(
    "--size",
    type=click.Choice(("single", "double")),
    default="single",
    show_default=True,
    help="Columns of the page.",
)
@click.option("-o", "--out", type=click.Path(), help="Folder; default: figures/ of the run.")
@json_option
@report_errors
def figure(run_folder: str, name: str | None, size: str, out: str | None, as_json: bool) -> int:
    """Write a figure of a run, or "all", as PDF and PNG; without a name, list them."""
    print_result(sysid_bench.figure(run_folder, name, size, out), as_json)
    return OK


@click.command()
@click.argument("run_folder", metavar="RUN")
@click.argument("what", metavar="ID|SPEC")
@robots_option
@report_errors
def record(run_folder: str, what: str, robots_dir: Path | None) -> int:
    """Execute a cell again and write its recording for the Rerun viewer."""
    for path in sysid_bench.record(run_folder, what, robots_dir):
        click.echo(str(path))
        hint = f"sysid-bench view {shlex.quote(run_folder)} {path.parent.name}"
        click.echo(f"look at it: {hint}", err=True)  # stdout holds paths alone
    return OK


@click.command()
@click.argument("run_folder", metavar="RUN")
@click.argument("identifier", metavar="ID")
@click.option("--web", is_flag=True, help="In the browser, served on this machine alone.")
@report_errors
def view(run_folder: str, identifier: str, web: bool) -> int:
    """Open the recording of a cell."""
    return int(sysid_bench.view(run_folder, identifier, web).wait())
