"""Verbs on a suite: plan, run."""

from pathlib import Path
from typing import Any

import click

from sysid_bench.cli.common import (
    INTERRUPTED,
    OK,
    USAGE,
    json_option,
    print_json,
    robots_option,
    verb,
)
from sysid_bench.errors import SysidBenchError


@click.command()
@click.argument("suite")
@click.option("--select", help="Only cells that meet this expression.")
@click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Change a key of the suite."
)
@robots_option
@json_option
@verb
def plan(
    suite: str,
    select: str | None,
    settings: tuple[str, ...],
    robots_dir: Path | None,
    as_json: bool,
) -> int:
    """Validate a suite and count its cells; nothing runs."""
    from sysid_bench.verbs.runs import plan as planned

    try:
        made = planned(suite, select, _pairs(settings), robots_dir)
    except SysidBenchError as error:
        if not as_json:
            raise
        print_json(
            {
                "cells": 0,
                "experiments": 0,
                "excluded": {},
                "seconds": 0,
                "errors": str(error).splitlines(),
            }
        )
        return USAGE
    if as_json:
        counts = {"cells": len(made.cells), "experiments": len(made.experiments)}
        more = {"excluded": dict(made.excluded), "seconds": made.seconds, "errors": []}
        print_json({**counts, **more, "notes": list(made.notes)})
        return OK
    click.echo(
        f"{len(made.cells)} cells in {len(made.experiments)} experiments, "
        f"about {made.seconds:.0f} s of one core"
    )
    for reason, count in made.excluded.items():
        click.echo(f"{count} cells excluded: {reason}")
    for note in made.notes:
        click.echo(note)
    return OK


@click.command()
@click.argument("suite", metavar="SUITE|RUN")
@click.option(
    "-o", "--out", type=click.Path(path_type=Path), help="Run folder; default reports/<suite>."
)
@click.option("-j", "--jobs", type=click.IntRange(min=1), help="Workers; default one per core.")
@click.option("--select", help="Only cells that meet this expression.")
@click.option("--limit", type=click.IntRange(min=1), help="Only the first N cells.")
@click.option("--timeout", metavar="60s", help="Hard limit per experiment.")
@click.option(
    "--rerun", type=click.Choice(["failed", "stale", "all"]), help="Run these cells again."
)
@click.option("--record", metavar="SPEC", help="Record cells that meet this expression.")
@click.option("--fail-fast", is_flag=True, help="Stop at the first failure.")
@click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Change a key of the suite."
)
@robots_option
@verb
def run(
    suite: str,
    out: Path | None,
    jobs: int | None,
    select: str | None,
    limit: int | None,
    timeout: str | None,
    rerun: Any,
    record: str | None,
    fail_fast: bool,
    settings: tuple[str, ...],
    robots_dir: Path | None,
) -> int:
    """Run a suite, or go on with a run; then write its tables, figures and report.

    Exit codes: 0 ok, 1 a cross-check failed, 2 wrong usage or suite, 3 some cells failed,
    4 nothing selected or measured, 130 interrupted and resumable.
    """
    from sysid_bench.verbs.progress import progress
    from sysid_bench.verbs.runs import run as execute

    with progress() as on_event:
        result = execute(
            suite, out, jobs, select, limit, timeout, rerun, fail_fast, record, _pairs(settings),
            robots_dir, on_event,
        )  # fmt: skip
    _print_result(result)
    return int(result.exit_code)


def _print_result(result: Any) -> None:
    from sysid_bench.verbs.reports import printed_tables

    folder = result.folder.path
    if result.exit_code == INTERRUPTED:
        click.echo(f"Interrupted; the same command goes on. Rows are in {folder}.", err=True)
        return
    if not result.counts:
        why = " ".join(result.notes)
        click.echo(f"No cell was selected; see 'sysid-bench plan'. {why}".rstrip(), err=True)
        return
    for text in printed_tables(folder):
        click.echo(text)
    counts = ", ".join(f"{count} {status}" for status, count in result.counts.items())
    click.echo(f"{counts}" + (f", {result.open} open" if result.open else ""))
    for note in result.notes:
        click.echo(note)
    click.echo(f"report: {folder / 'report.html'}")


def _pairs(settings: tuple[str, ...]) -> dict[str, str]:
    pairs = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals or not key:
            raise click.BadParameter(f"{setting!r} is no KEY=VALUE.", param_hint="--set")
        pairs[key.strip()] = value.strip()
    return pairs
