"""Runs a suite of trivial cells, what tests kill. Arguments: suite file, run folder, workers."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "harness"))
import click
from harness_world import NAMES

from sysid_bench.commands.shell import report_errors
from sysid_bench.verbs.runs.run import run


@click.command()
@click.argument("suite")
@click.argument("out", type=click.Path(path_type=Path))
@click.argument("jobs", type=int)
@report_errors
def main(suite: str, out: Path, jobs: int) -> int:
    """Run with the errors, signals and exit codes of the command line."""
    result = run(
        suite, out, jobs=jobs, names=NAMES, call="harness_tasks:execute",
        on_event=lambda kind, data: click.echo(kind),
    )  # fmt: skip
    return result.exit_code


main()
