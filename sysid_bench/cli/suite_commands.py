"""Commands on a suite: plan, run."""

from pathlib import Path
from typing import Literal

import click

import sysid_bench
from sysid_bench.cli.options import (
    INTERRUPTED,
    OK,
    USAGE,
    OptionsRecord,
    group_options,
    json_option,
    print_json,
    print_result,
    report_errors,
    robots_option,
)
from sysid_bench.cli.progress import run_progress
from sysid_bench.cli.values import parse_condition, parse_entries
from sysid_bench.errors import SysidBenchError

_set_option = click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Change a key of the suite."
)
_select_option = click.option("--select", help="Only cells that meet this expression.")


@click.command()
@click.argument("suite")
@_select_option
@_set_option
@robots_option
@json_option
@report_errors
def plan(
    suite: str,
    select: str | None,
    settings: tuple[str, ...],
    robots_dir: Path | None,
    as_json: bool,
) -> int:
    """Validate a suite and count its cells; nothing runs."""
    try:
        result = sysid_bench.plan(
            suite, parse_condition(select), dict(parse_entries(settings)), robots_dir
        )
    except SysidBenchError as error:
        if not as_json:
            raise
        counts = {"cells": 0, "experiments": 0, "excluded": {}, "seconds": 0}
        print_json({**counts, "errors": str(error).splitlines()})
        return USAGE
    print_result(result, as_json)
    return OK


class _Execution(OptionsRecord):
    out: Path | None
    jobs: int | None
    timeout: str | None
    rerun: Literal["failed", "stale", "all"] | None
    fail_fast: bool


class _Selection(OptionsRecord):
    select: str | None
    limit: int | None
    record: str | None


@click.command()
@click.argument("suite", metavar="SUITE|RUN")
@group_options(
    "execution",
    _Execution,
    [
        click.option(
            "-o",
            "--out",
            type=click.Path(path_type=Path),
            help="Run folder; default reports/<suite>.",
        ),
        click.option(
            "-j", "--jobs", type=click.IntRange(min=1), help="Workers; default one per core."
        ),
        click.option("--timeout", metavar="60s", help="Hard limit per experiment."),
        click.option(
            "--rerun", type=click.Choice(["failed", "stale", "all"]), help="Run these cells again."
        ),
        click.option("--fail-fast", is_flag=True, help="Stop at the first failure."),
    ],
)
@group_options(
    "selection",
    _Selection,
    [
        _select_option,
        click.option("--limit", type=click.IntRange(min=1), help="Only the first N cells."),
        click.option("--record", metavar="SPEC", help="Record cells that meet this expression."),
    ],
)
@_set_option
@robots_option
@report_errors
def run(
    suite: str,
    execution: _Execution,
    selection: _Selection,
    settings: tuple[str, ...],
    robots_dir: Path | None,
) -> int:
    """Run a suite, or resume a run; then write its tables, figures and report.

    Exit codes: 0 ok, 1 a cross-check failed, 2 wrong usage or suite, 3 some cells failed,
    4 nothing selected or measured, 130 interrupted and resumable.
    """
    with run_progress() as on_event:
        result = sysid_bench.run(
            suite,
            execution.out,
            execution.jobs,
            parse_condition(selection.select),
            selection.limit,
            execution.timeout,
            rerun=execution.rerun,
            fail_fast=execution.fail_fast,
            record=parse_condition(selection.record),
            overrides=dict(parse_entries(settings)),
            robots_dir=robots_dir,
            on_event=on_event,
        )
    nothing = result.exit_code == INTERRUPTED or not result.counts
    click.echo(result.summary(), err=nothing)
    return int(result.exit_code)
