"""Commands that write a first file: init."""

from pathlib import Path

import click

import sysid_bench
from sysid_bench.cli.options import (
    OK,
    OptionsRecord,
    group_options,
    json_option,
    model_options,
    print_result,
    report_errors,
    robots_option,
)
from sysid_bench.commands.progress import read_progress
from sysid_bench.commands.values import parse_names
from sysid_bench.commands.worker_execute import supervise
from sysid_bench.errors import UsageError


class _Conventions(OptionsRecord):
    modified: bool
    frames: str
    base: str
    gravity: str
    massless: str


@click.group()
def init() -> None:
    """Write a first file of your own, with guesses and doubts as comments."""


_force_option = click.option("--force", is_flag=True, help="Write over an existing file.")


@init.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--model", required=True, help="Robot: a name, a URDF or an MJCF file.")
@click.option("-o", "--out", type=click.Path(path_type=Path), help="Default: FILE.toml beside it.")
@model_options("model")
@robots_option
@_force_option
@json_option
@report_errors
def log(
    files: tuple[Path, ...],
    model: str,
    out: Path | None,
    robots_dir: Path | None,
    force: bool,
    as_json: bool,
) -> int:
    """Write the description of a recording: its columns, units and time are guessed."""
    from sysid_bench.experiments.third_party import reader_candidates

    code = supervise([plugin for file in files for plugin in reader_candidates(file)])
    if code is not None:
        return code
    with read_progress():
        result = sysid_bench.init_log(files, model, out, force=force, robots_dir=robots_dir)
    print_result(result, as_json)
    return OK


@init.command()
@click.option("--robot", "of", default="ur5", show_default=True, help="A name or a model file.")
@click.option(
    "-o", "--out", default="suite.toml", show_default=True, type=click.Path(path_type=Path)
)
@model_options("of")
@_force_option
@json_option
@report_errors
def suite(of: str, out: Path, force: bool, as_json: bool) -> int:
    """Write a suite of one robot and two methods."""
    print_result(sysid_bench.init_suite(of, out, force=force), as_json)
    return OK


@init.command()
@click.argument("name", default="Mine")
@click.option("-o", "--out", type=click.Path(path_type=Path), help="Default: name.py.")
@_force_option
@json_option
@report_errors
def estimator(name: str, out: Path | None, force: bool, as_json: bool) -> int:
    """Write an estimator of one's own, with the class NAME."""
    print_result(sysid_bench.init_estimator(name, out, force=force), as_json)
    return OK


@init.command()
@click.argument("model", required=False, metavar="MODEL")
@click.option(
    "--dh",
    "table",
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
@model_options("model")
@_force_option
@json_option
@report_errors
def robot(
    model: str | None,
    table: Path | None,
    out: Path | None,
    name: str | None,
    conventions: _Conventions,
    force: bool,
    as_json: bool,
) -> int:
    """Write a robot folder from a URDF or MJCF file, or from a Denavit-Hartenberg table."""
    if model is not None and table is None:
        print_result(sysid_bench.init_model(model, out, name, force=force), as_json)
        return OK
    if table is None or model is not None:
        raise UsageError(
            "Which robot? Name its model file, sysid-bench init robot my.urdf, or its table of "
            "Denavit-Hartenberg parameters: sysid-bench init robot --dh my.csv."
        )
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
