"""Commands on a robot model: crosscheck, frames, basis, lint."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

import sysid_bench
from sysid_bench.cli.options import (
    FAILED,
    OK,
    OptionsRecord,
    free_base_option,
    group_options,
    json_option,
    model_options,
    print_json,
    print_result,
    report_errors,
    robots_option,
    sensor_option,
    task_option,
    terms_option,
)
from sysid_bench.cli.values import parse_numbers, parse_terms
from sysid_bench.cli.worker_execute import supervise
from sysid_bench.errors import UsageError

if TYPE_CHECKING:
    from sysid_bench import CrosscheckResult


@click.command()
@click.argument("robots", nargs=-1, required=True, metavar="ROBOT|FILE...")
@click.option("--samples", default=50, show_default=True, help="Random states to compare at.")
@model_options("robots")
@robots_option
@json_option
@report_errors
def crosscheck(
    robots: tuple[str, ...],
    samples: int,
    robots_dir: Path | None,
    as_json: bool,
) -> int:
    """Compare a robot's regressor between MuJoCo and Pinocchio.

    Exit code 1 where a robot is above tolerance or cannot be loaded.
    """
    verdicts = sysid_bench.crosscheck(*robots, samples=samples, robots_dir=robots_dir)
    if as_json:
        print_json(verdicts)
    else:
        for verdict in verdicts:
            _print_verdict(verdict)
    return OK if all(verdict.ok for verdict in verdicts) else FAILED


def _print_verdict(verdict: "CrosscheckResult") -> None:
    figures = "\n".join(verdict.figures())
    word, colour = ("agrees", "green") if verdict.ok else ("DIFFERS", "red")
    if figures:
        click.echo(figures.replace(f": {word} ", f": {click.style(word, fg=colour)} ", 1))
    if verdict.reason:
        click.echo(f"sysid-bench: {verdict.robot}: {verdict.reason}", err=True)


@click.command()
@click.argument("robot", metavar="ROBOT|FILE")
@click.option(
    "--at",
    multiple=True,
    metavar="JOINT=X",
    help="Position of a joint, rad or m; others stay at the reference. Repeat it for each.",
)
@model_options("robot")
@robots_option
@json_option
@report_errors
def frames(robot: str, at: tuple[str, ...], robots_dir: Path | None, as_json: bool) -> int:
    """Print the forward kinematics: origin and rotation of every body and of the tool in the world,
    and gravity there."""
    result = sysid_bench.frames(robot, parse_numbers("at", at, "elbow=0.5"), robots_dir)
    print_result(result, as_json)
    return OK


class _Paper(OptionsRecord):
    paper: bool
    zero: str | None
    values: Path | None


@click.command()
@click.argument("robot", metavar="ROBOT|FILE")
@task_option
@terms_option
@sensor_option
@free_base_option
@model_options("robot", free_base=False)
@group_options(
    "printing",
    _Paper,
    [
        click.option(
            "--paper", is_flag=True, help="Combinations alone, one per line, singles first."
        ),
        click.option(
            "--zero", metavar="NAMES", help="With --paper: parameters taken for zero; or none."
        ),
        click.option(
            "--values",
            type=click.Path(path_type=Path),
            metavar="FILE.json",
            help="With --paper: values of the combinations, from identify --json-out; impossible "
            "ones are marked.",
        ),
    ],
)
@robots_option
@json_option
@report_errors
def basis(
    robot: str,
    task: str,
    terms: str | None,
    sensor: str | None,
    free_base: bool | None,
    printing: _Paper,
    robots_dir: Path | None,
    as_json: bool,
) -> int:
    """Print the base parameters: number, combinations, identifiability of each parameter."""
    _check_paper(printing)
    code = supervise([("task", task)])
    if code is not None:
        return code
    whole = free_base is None and sensor is None
    table = (robot, task, parse_terms(terms), printing, robots_dir, as_json)
    if printing.paper and whole and _print_paper(*table):
        return OK
    result = sysid_bench.basis(robot, task, parse_terms(terms), free_base, robots_dir, sensor)
    if printing.paper and not as_json:
        click.echo("\n".join(result.expressions()))
    else:
        print_result(result, as_json)
    return OK


def _check_paper(printing: _Paper) -> None:
    """Raise UsageError for options that belong to --paper alone."""
    if not printing.paper and (printing.zero, printing.values) != (None, None):
        raise UsageError("--zero and --values belong to --paper.")


def _print_paper(
    robot: str,
    task: str,
    terms: tuple[str, ...] | None,
    printing: _Paper,
    robots_dir: Path | None,
    as_json: bool,
) -> bool:
    """Print the table of a whole robot; return False for a task that has none."""
    from sysid_bench.verbs.model import base_table

    if not base_table.supports_task(task):
        return False
    zero = parse_terms(printing.zero)
    table = sysid_bench.paper_table(robot, terms, zero, printing.values, robots_dir)
    if as_json:
        print_json(table)
    else:
        click.echo("\n".join(base_table.lines(table)))
    return True


@click.command()
@click.argument("models", nargs=-1, required=True, metavar="MODEL...")
@model_options("models")
@robots_option
@json_option
@report_errors
def lint(models: tuple[str, ...], robots_dir: Path | None, as_json: bool) -> int:
    """Report what is wrong with model files as models of dynamics; folders, and collections that
    were fetched, are searched.

    Impossible and placeholder inertias, masses and moments that do not fit the size of a link,
    units, limits, rotor inertias, left and right limbs that differ. Exit code 1 where a finding is
    an error; [lint] ignore = [...] in robot.toml suppresses findings.
    """
    result = sysid_bench.lint(models, robots_dir)
    print_result(result, as_json)
    return OK if result.ok else FAILED
