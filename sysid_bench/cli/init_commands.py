"""Commands that write a first file: init."""

from pathlib import Path

import click

import sysid_bench
from sysid_bench.cli.options import (
    OK,
    OptionsRecord,
    group_options,
    json_option,
    print_result,
    report_errors,
)
from sysid_bench.cli.values import parse_names


class _Conventions(OptionsRecord):
    modified: bool
    frames: str
    base: str
    gravity: str
    massless: str


@click.group()
def init() -> None:
    """Write a first file of your own: init robot."""


@init.command()
@click.option(
    "--dh",
    "table",
    required=True,
    type=click.Path(path_type=Path),
    metavar="TABLE.csv",
    help="Denavit-Hartenberg table: link, joint, prev, a, alpha, d, theta, ...",
)
@click.option("-o", "--out", type=click.Path(path_type=Path), help="Folder; default: the name.")
@click.option("--name", help="Default: that of the table.")
@group_options(
    "conventions",
    _Conventions,
    [
        click.option(
            "--modified", is_flag=True, help="Craig's convention; default: the standard one."
        ),
        click.option(
            "--frames",
            default="joint",
            show_default=True,
            type=click.Choice(["joint", "link"]),
            help="Where parameters are taken: at the joint before the link, or in its DH frame.",
        ),
        click.option(
            "--base", default="0 0 0", show_default=True, help="Roll pitch yaw of frame 0."
        ),
        click.option(
            "--gravity", default="0 0 -9.81", show_default=True, help="In the world frame."
        ),
        click.option("--massless", default="", metavar="4,5,6", help="Links without mass."),
    ],
)
@json_option
@report_errors
def robot(
    table: Path, out: Path | None, name: str | None, conventions: _Conventions, as_json: bool
) -> int:
    """Write a robot folder from a Denavit-Hartenberg table."""
    result = sysid_bench.init_robot(
        table,
        out,
        name,
        modified=conventions.modified,
        frames=conventions.frames,
        base=conventions.base,
        gravity=conventions.gravity,
        massless=parse_names(conventions.massless),
    )
    print_result(result, as_json)
    return OK
