"""Commands that compare runs: compare, baseline save, baseline update, gate."""

from pathlib import Path

import click

import sysid_bench
from sysid_bench.cli.options import (
    FAILED,
    OK,
    OptionsRecord,
    group_options,
    json_option,
    print_result,
    report_errors,
)
from sysid_bench.commands.terminal import print_table
from sysid_bench.commands.values import parse_metrics, parse_numbers

_baseline_file = click.Path(path_type=Path, dir_okay=False)

_times_option = click.option(
    "--times", is_flag=True, help="Times, too, as ratios within the run (three repeats or more)."
)


class _Files(OptionsRecord):
    junit: Path | None
    markdown: Path | None
    annotations: bool


@click.group()
def baseline() -> None:
    """Write the values of a run into a small file that later runs are compared with."""


@baseline.command()
@click.argument("run_folder", metavar="RUN")
@click.option("-o", "--out", required=True, type=_baseline_file, help="JSON file to write.")
@click.option("--metrics", metavar="NAME,...", help="Metrics in place of the default ones.")
@click.option(
    "--tolerance",
    "tolerances",
    metavar="METRIC=SIZE",
    multiple=True,
    help="Factor for an error, difference for a gap; in place of the default.",
)
@_times_option
@json_option
@report_errors
def save(
    run_folder: str,
    out: Path,
    metrics: str | None,
    tolerances: tuple[str, ...],
    times: bool,
    as_json: bool,
) -> int:
    """Save the baseline of a run: sorted, a line per cell, with versions and tolerances."""
    names, sizes = parse_metrics(metrics), parse_numbers("tolerance", tolerances)
    saved = sysid_bench.baseline_save(run_folder, out, metrics=names, tolerances=sizes, times=times)
    print_result(saved, as_json)
    return OK


@baseline.command()
@click.argument("run_folder", metavar="RUN")
@click.option("-o", "--out", required=True, type=_baseline_file, help="Baseline to replace.")
@json_option
@report_errors
def update(run_folder: str, out: Path, as_json: bool) -> int:
    """Take the changes of a run over into its baseline; values within their tolerance stay, and so
    do tolerances and metrics."""
    print_result(sysid_bench.baseline_update(run_folder, out), as_json)
    return OK


@click.command()
@click.argument("run_folder", metavar="RUN")
@click.option(
    "--baseline", "file", required=True, type=click.Path(path_type=Path), help="Baseline file."
)
@click.option(
    "--partial", is_flag=True, help="Let cells of the baseline count that have a row, and no other."
)
@group_options(
    "files",
    _Files,
    [
        click.option("--junit", type=_baseline_file, help="Write JUnit XML, a case per cell."),
        click.option("--markdown", type=_baseline_file, help="Append the summary to this file."),
        click.option("--annotations", is_flag=True, help="Print failures as hosted CI reads them."),
    ],
)
@_times_option
@json_option
@report_errors
def gate(
    run_folder: str, file: Path, partial: bool, files: _Files, times: bool, as_json: bool
) -> int:
    """Compare a run with a baseline; exit code 1 where anything got worse.

    Worse are: another status, a value beyond its tolerance, other base parameters of a robot, cells
    that are gone, and with --times slower parts. Improvements are reported; `baseline update` takes
    them over.
    """
    result = sysid_bench.gate(run_folder, file, partial=partial, times=times)
    if files.junit is not None:
        result.write_junit(files.junit)
    if files.markdown is not None:
        result.write_markdown(files.markdown)
    print_result(result, as_json)
    if files.annotations:
        click.echo(result.annotations(), nl=False, err=as_json)
    return OK if result.ok else FAILED


@click.command()
@click.argument("before", metavar="A")
@click.argument("after", metavar="B")
@click.option("--metrics", metavar="NAME,...", help="Metrics in place of the default ones.")
@click.option("--format", "form", help="md, csv, latex or json; default: drawn, piped as md.")
@click.option("--html", type=_baseline_file, help="Write a page with all changes.")
@report_errors
def compare(
    before: str, after: str, metrics: str | None, form: str | None, html: Path | None
) -> int:
    """Compare two runs of a suite; each is a run folder or a baseline.

    Metrics as ratios over robots with intervals, cells that changed beyond their tolerance,
    appeared or vanished, and what differs in code and libraries.
    """
    result = sysid_bench.compare(before, after, parse_metrics(metrics))
    if html is not None:
        result.write_html(html)
    print_table(result.text(form or "md"), form)
    return OK
