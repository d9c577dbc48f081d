"""Command that writes a site of results: site."""

from collections.abc import Mapping
from typing import Any

import click

import sysid_bench
from sysid_bench.cli.options import FAILED, OK, json_option, print_result, report_errors
from sysid_bench.units import quantity


@click.command()
@click.argument("runs", metavar="[RUN...]", nargs=-1)
@click.option("-o", "--out", type=click.Path(file_okay=False), help="Folder of the site.")
@click.option(
    "--check",
    "submissions",
    metavar="FOLDER",
    multiple=True,
    help="A submission: a share of its cells runs again; with -o it joins the site.",
)
@click.option("--seed", type=click.IntRange(min=0), help="Seed of that draw; default: a new one.")
@click.option("--share", default="5 %", show_default=True, help="Cells that run again.")
@click.option("-j", "--jobs", type=click.IntRange(min=1), help="Workers; default one per core.")
@json_option
@report_errors
def site(
    runs: tuple[str, ...],
    out: str | None,
    submissions: tuple[str, ...],
    seed: int | None,
    share: str,
    jobs: int | None,
    as_json: bool,
) -> int:
    """Write a static site of runs: suites, robots, methods, leaderboard.json.

    Exit code 1 where a submission is refused: nothing is written then.
    """
    result = sysid_bench.site(
        runs, out, submissions, seed, share=quantity(share, "1"), jobs=jobs, on_event=_print_code
    )
    print_result(result, as_json)
    return OK if result.ok else FAILED


def _print_code(kind: str, data: Mapping[str, Any]) -> None:
    """Name the third-party code of a submission before it runs."""
    if kind == "code":
        click.echo(data["note"], err=True)
