"""Commands on a run: status, cell, table, report, record, view."""

import shlex
from pathlib import Path

import click

import sysid_bench
from sysid_bench.cli.options import (
    FAILED,
    OK,
    json_option,
    print_result,
    report_errors,
    robots_option,
)


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
@click.argument("identifier", metavar="ID")
@json_option
@report_errors
def cell(run_folder: str, identifier: str, as_json: bool) -> int:
    """Show one row, its traceback, and the command that reproduces it."""
    print_result(sysid_bench.cell(run_folder, identifier), as_json)
    return OK


@click.command()
@click.argument("run_folder", metavar="RUN")
@click.argument("name")
@click.option("--format", "form", default="md", show_default=True, help="md, csv, latex or json.")
@report_errors
def table(run_folder: str, name: str, form: str) -> int:
    """Print one table of a run."""
    click.echo(sysid_bench.table(run_folder, name, form), nl=False)
    return OK


@click.command()
@click.argument("runs", metavar="RUN...", nargs=-1, required=True)
@click.option("--suite", help="Suite whose claims are tested, in place of those of the runs.")
@click.option("--format", "form", default="md", show_default=True, help="md, csv or latex.")
@click.option("--gate", is_flag=True, help="Exit code 1 unless claims with gate = true hold.")
@json_option
@report_errors
def claims(runs: tuple[str, ...], suite: str | None, form: str, gate: bool, as_json: bool) -> int:
    """Test the claims of runs on their stored rows: holds, fails, open or not testable."""
    result = sysid_bench.claims(*runs, suite=suite)
    if as_json:
        print_result(result, as_json)
    else:
        click.echo(result.text(form), nl=False)
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
