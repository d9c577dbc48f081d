"""Verbs on a run: status, cell, table, report, record, view."""

import json
from pathlib import Path

import click

from sysid_bench.cli.common import (
    OK,
    json_option,
    print_json,
    robots_option,
    verb,
)


@click.command()
@click.argument("run_folder", metavar="RUN")
@json_option
@verb
def status(run_folder: str, as_json: bool) -> int:
    """How far a run is, and what failed."""
    from sysid_bench.verbs.runs import status as status_of

    state = status_of(run_folder)
    if as_json:
        print_json(state)
        return OK
    counts = ", ".join(f"{count} {kind}" for kind, count in state["statuses"].items()) or "no rows"
    click.echo(f"{state['cells']} cells: {counts}, {state['open']} open")
    for reason in state["reasons"]:
        click.echo(f"  {reason['cells']} {reason['status']}: {reason['reason']}")
    return OK


@click.command()
@click.argument("run_folder", metavar="RUN")
@click.argument("identifier", metavar="ID")
@json_option
@verb
def cell(run_folder: str, identifier: str, as_json: bool) -> int:
    """One row, its traceback, and the command that reproduces it."""
    from sysid_bench.verbs.runs import cell as cell_of

    row = cell_of(run_folder, identifier)
    if as_json:
        print_json(row)
        return OK
    for key, value in row.items():
        if key in ("joints", "parameters_table", "traceback"):
            continue
        click.echo(f"{key:<22} {value if isinstance(value, str) else json.dumps(value)}")
    if row.get("traceback"):
        click.echo(f"\n{row['traceback']}")
    return OK


@click.command()
@click.argument("run_folder", metavar="RUN")
@click.argument("name")
@click.option("--format", "form", default="md", show_default=True, help="md, csv or latex.")
@verb
def table(run_folder: str, name: str, form: str) -> int:
    """Print one table of a run."""
    from sysid_bench.verbs.reports import table as text_of

    click.echo(text_of(run_folder, name, form), nl=False)
    return OK


@click.command()
@click.argument("run_folder", metavar="RUN")
@verb
def report(run_folder: str) -> int:
    """Write a run's tables, figures and report.html again."""
    from sysid_bench.verbs.reports import report as write

    click.echo(str(write(run_folder)))
    return OK


@click.command()
@click.argument("run_folder", metavar="RUN")
@click.argument("what", metavar="ID|SPEC")
@robots_option
@verb
def record(run_folder: str, what: str, robots_dir: Path | None) -> int:
    """Execute a cell again and write its recording for the Rerun viewer."""
    from sysid_bench.verbs.recordings import record as write

    for path in write(run_folder, what, robots_dir):
        click.echo(str(path))
    return OK


@click.command()
@click.argument("run_folder", metavar="RUN")
@click.argument("identifier", metavar="ID")
@click.option("--web", is_flag=True, help="In the browser, served on this machine alone.")
@verb
def view(run_folder: str, identifier: str, web: bool) -> int:
    """Open the recording of a cell."""
    from sysid_bench.verbs.recordings import view as open_viewer

    return int(open_viewer(run_folder, identifier, web).wait())
