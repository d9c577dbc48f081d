"""Commands about names and this machine: list, show, help, check-plugin, doctor."""

from pathlib import Path

import click

import sysid_bench
from sysid_bench.cli.options import (
    FAILED,
    OK,
    json_option,
    model_options,
    print_json,
    print_result,
    report_errors,
    robots_option,
)
from sysid_bench.cli.terminal import print_entries, print_markdown
from sysid_bench.cli.worker_execute import supervise

_CHECKED = (
    *("estimator", "excitation", "plant", "simulation", "metric", "log-reader", "task"),
    *("model-error", "sensor-error", "pipeline", "executor"),
)
"""Kinds with a conformance kit; spelled out, because the kits take a second to load."""


@click.command(name="list")
@click.argument("kind", metavar="KIND")
@click.option("--all", "is_whole", is_flag=True, help="More than the screen holds.")
@robots_option
@json_option
@report_errors
def list_(kind: str, is_whole: bool, robots_dir: Path | None, as_json: bool) -> int:
    """List the names of a KIND.

    One of robots, payloads, tasks, terms, plants, excitations, simulations, pipelines, filters,
    estimators, metrics, suites, datasets, model-errors, sensor-errors, log-readers, executors,
    integrators, statistics, intervals, statuses, collections, motors.
    """
    entries = sysid_bench.list_(kind, robots_dir)
    if as_json:
        print_json(entries)
    else:
        print_entries(entries, "" if is_whole else f"sysid-bench list {kind} --all")
    return OK


@click.command(name="help")
@click.argument("topic", metavar="[TOPIC|NAME]", nargs=-1)
@json_option
@report_errors
def help_(topic: tuple[str, ...], as_json: bool) -> int:
    """Print the reference: a topic, or what has a name in any.

    Without argument it lists the topics.
    """
    result = sysid_bench.help_(" ".join(topic) or None)
    if as_json:
        print_json(result)
    else:
        print_markdown(result.summary())
    return OK


@click.command()
@click.argument("name")
@model_options("name")
@robots_option
@json_option
@report_errors
def show(name: str, robots_dir: Path | None, as_json: bool) -> int:
    """Show one robot, payload, plug-in, suite, data set or motor.

    --assets, --tool and --free-base are for robots alone.
    """
    print_result(sysid_bench.show(name, robots_dir), as_json)
    return OK


@click.command(name="check-plugin")
@click.argument("name", metavar="PKG:OBJ")
@click.option(
    "--kind",
    type=click.Choice(_CHECKED),
    default="estimator",
    show_default=True,
    help="Kind of plug-in.",
)
@click.option(
    "--file",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Recorded file for a log reader of a format that the check cannot write.",
)
@robots_option
@json_option
@report_errors
def check_plugin(
    name: str, kind: str, file: Path | None, robots_dir: Path | None, as_json: bool
) -> int:
    """Check a plug-in against the laws of its kind.

    Exit code 1 where it breaks one.
    """
    code = supervise([(kind, name)])
    if code is not None:
        return code
    result = sysid_bench.check_plugin(name, robots_dir, kind, file)
    print_result(result, as_json)
    return OK if result.ok else FAILED


@click.command()
@json_option
@report_errors
def doctor(as_json: bool) -> int:
    """Check this machine."""
    result = sysid_bench.doctor()
    print_result(result, as_json)
    return OK if result.ok else FAILED
