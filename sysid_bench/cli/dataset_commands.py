"""Command about data sets and collections of models: fetch."""

from functools import partial
from pathlib import Path

import click

import sysid_bench
from sysid_bench.cli.options import OK, json_option, print_result, report_errors


@click.command()
@click.argument("name", metavar="NAME|FOLDER")
@click.option(
    "-o",
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    help="Copy all files below this folder, for SYSID_BENCH_DATA; default: a cache.",
)
@json_option
@report_errors
def fetch(name: str, out: Path | None, as_json: bool) -> int:
    """Bring a data set of recorded robots, or a collection of models, here and check its files.

    Its licence is printed first. Files that are here are not loaded again. A collection, as "wild",
    is a list of packages with models, loaded by pip without what they depend on.
    """
    result = sysid_bench.fetch(name, out, notice=partial(click.echo, err=True))
    print_result(result, as_json)
    return OK
