"""Verbs that write a first file: init."""

from pathlib import Path

import click

from sysid_bench.cli.common import OK, json_option, print_json, verb


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
    help="A Denavit-Hartenberg table: link, joint, prev, a, alpha, d, theta, ...",
)
@click.option("-o", "--out", type=click.Path(path_type=Path), help="Folder; default: the name.")
@click.option("--name", help="Default: that of the table.")
@click.option("--modified", is_flag=True, help="Craig's convention; default: the standard one.")
@click.option(
    "--frames",
    default="joint",
    show_default=True,
    type=click.Choice(["joint", "link"]),
    help="Where parameters are taken: at the joint before the link, or in its DH frame.",
)
@click.option("--base", default="0 0 0", show_default=True, help="Roll pitch yaw of frame 0.")
@click.option("--gravity", default="0 0 -9.81", show_default=True, help="In the world.")
@click.option("--massless", default="", metavar="4,5,6", help="Links that weigh nothing.")
@json_option
@verb
def robot(
    table: Path,
    out: Path | None,
    name: str | None,
    modified: bool,
    frames: str,
    base: str,
    gravity: str,
    massless: str,
    as_json: bool,
) -> int:
    """A robot folder from a Denavit-Hartenberg table."""
    from sysid_bench.verbs import init_robot as first

    light = tuple(word.strip() for word in massless.split(",") if word.strip())
    answer = first.init_robot(
        table, out, name, modified, frames,
        first.parse_numbers(base, "--base"), first.parse_numbers(gravity, "--gravity"), light,
    )  # fmt: skip
    if as_json:
        print_json(answer)
        return OK
    for line in first.summary(answer):
        click.echo(line)
    return OK
