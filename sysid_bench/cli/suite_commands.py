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
from sysid_bench.commands.progress import run_progress
from sysid_bench.commands.terminal import terminal_output
from sysid_bench.commands.values import parse_condition, parse_entries
from sysid_bench.errors import SysidBenchError

_set_option = click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Change a key of the suite."
)
_select_option = click.option("--select", help="Only cells that meet this expression.")


_large_option = click.option("--large", is_flag=True, help="Admit more than a million cells.")


@click.command()
@click.argument("suite")
@_select_option
@_set_option
@click.option("--no-code", is_flag=True, help="Import no third-party plug-in.")
@_large_option
@robots_option
@json_option
@report_errors
def plan(
    suite: str,
    select: str | None,
    settings: tuple[str, ...],
    no_code: bool,
    large: bool,
    robots_dir: Path | None,
    as_json: bool,
) -> int:
    """Validate a suite and count its cells; none of them runs.

    Third-party plug-ins are imported and made in a process of their own, unless --no-code.
    """
    try:
        result = sysid_bench.plan(
            suite,
            parse_condition(select),
            dict(parse_entries(settings)),
            robots_dir,
            no_code=no_code,
            large=large,
        )
    except SysidBenchError as error:
        if not as_json:
            raise
        counts = {"cells": 0, "experiments": 0, "excluded": {}, "seconds": 0, "seconds_from": ""}
        print_json({**counts, "errors": str(error).splitlines()})
        return USAGE
    if result.code:
        click.echo(result.code, err=True)
    print_result(result, as_json)
    return OK


class _Execution(OptionsRecord):
    out: Path | None
    jobs: int | None
    executor: str
    timeout: str | None
    rerun: Literal["failed", "stale", "all"] | None
    fail_fast: bool
    gate: bool
    baseline: Path | None
    times: bool


class _Selection(OptionsRecord):
    select: str | None
    limit: int | None
    shard: str | None
    large: bool
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
        click.option(
            "--executor",
            default="local",
            metavar="local|dask://HOST:PORT|slurm:FILE",
            help="Where cells are computed; dask+tls:// for other hosts.",
        ),
        click.option("--timeout", metavar="60s", help="Hard limit per cell."),
        click.option(
            "--rerun", type=click.Choice(["failed", "stale", "all"]), help="Run these cells again."
        ),
        click.option("--fail-fast", is_flag=True, help="Stop at the first failure."),
        click.option(
            "--gate", is_flag=True, help="Exit code 1 unless claims with gate = true hold."
        ),
        click.option(
            "--baseline",
            type=click.Path(path_type=Path),
            help="Compare with this baseline; exit code 1 where anything got worse.",
        ),
        click.option("--times", is_flag=True, help="Compare times, too, as ratios within a run."),
    ],
)
@group_options(
    "selection",
    _Selection,
    [
        _select_option,
        click.option("--limit", type=click.IntRange(min=1), help="Only the first N cells."),
        click.option("--shard", metavar="I/N", help="Only part I of N, of equal expected costs."),
        _large_option,
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

    Exit codes: 0 ok, 1 a cross-check or a gate failed or a baseline is not kept, 2 wrong usage or
    suite, or rows cannot be stored, 3 some cells failed, timed out, crashed, are over their memory
    or lost, 4 nothing selected or measured, 5 the scheduler or all workers elsewhere are gone (the
    run is resumable), 130 interrupted and resumable.
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
            shard=selection.shard,
            large=selection.large,
            gate=execution.gate,
            baseline=execution.baseline,
            times=execution.times,
            executor=execution.executor,
        )
    nothing = result.exit_code == INTERRUPTED or not result.counts
    summary = result.summary()
    click.echo(summary if nothing else terminal_output(summary), err=nothing)
    return int(result.exit_code)


@click.command()
@click.argument("runs", metavar="RUN...", nargs=-1, required=True)
@click.option(
    "-o", "--out", required=True, type=click.Path(path_type=Path), help="Folder of the merged run."
)
@click.option("--mixed", is_flag=True, help="Merge rows of different code, too.")
@json_option
@report_errors
def merge(runs: tuple[str, ...], out: Path, mixed: bool, as_json: bool) -> int:
    """Merge runs of one plan, such as shards, into one.

    Exit code 1 where they contradict each other: nothing is written then.
    """
    result = sysid_bench.merge(runs, out, mixed=mixed)
    print_result(result, as_json)
    return int(result.exit_code)
