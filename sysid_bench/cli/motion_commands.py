"""Command that designs motions: excite."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

import sysid_bench
from sysid_bench.cli.options import (
    FAILED,
    INTERRUPTED,
    OK,
    OptionsRecord,
    group_options,
    json_option,
    model_options,
    print_result,
    report_errors,
    robots_option,
    sensor_option,
    task_option,
    terms_option,
)
from sysid_bench.commands.progress import search_progress
from sysid_bench.commands.values import (
    parse_criterion,
    parse_limits,
    parse_motors,
    parse_settings,
    parse_terms,
)
from sysid_bench.commands.worker_execute import supervise
from sysid_bench.errors import UsageError
from sysid_bench.units import quantity

if TYPE_CHECKING:
    from sysid_bench import CommandsRequest, ExciteRequest


TASK = "actuators"
"""Task of position-commanded robots, whose recording is designed by its commands."""

OF_COMMANDS = ("period", "joints", "iterations", "starts")
"""Settings of a search that the design of commands has, too."""


class _Settings(OptionsRecord):
    """Settings of the excitation `optimised`, as typed."""

    period: str | None
    harmonics: int | None
    cycles: int | None
    family: str | None
    joints: str | None
    torque_share: str | None
    margin: str | None
    clearance: str | None
    floor: str | None
    iterations: int | None
    starts: int | None


class _Unknowns(OptionsRecord):
    task: str
    sensor: str | None
    payload: str
    terms: str | None


class _Bounds(OptionsRecord):
    limits: tuple[str, ...]
    gains: tuple[str, ...]
    boxes: tuple[str, ...]


class _Output(OptionsRecord):
    export: str | None
    motors: str | None
    clamp: str
    rate: str
    out: Path | None
    as_json: bool


_setting_options = group_options(
    "settings",
    _Settings,
    [
        click.option("--period", metavar="S", help="Default: 10 s; of actuators 20 s."),
        click.option("--harmonics", type=click.IntRange(min=1), help="Default: 5."),
        click.option("--cycles", type=click.IntRange(min=1), help="Periods to play. Default: 1."),
        click.option(
            "--family",
            help="fourier, fourier-polynomial or b-spline; the last two start and end at rest. "
            "Default: fourier, and fourier-polynomial for ros2, damiao and can.",
        ),
        click.option("--joints", metavar="A,B,...", help="Joints that move; default: all."),
        click.option(
            "--torque-share", metavar="SHARE", help="Of the torque limits. Default: 90 %."
        ),
        click.option(
            "--margin",
            metavar="SHARE",
            help="Of every limit, which the search leaves. Default: 2 %.",
        ),
        click.option("--clearance", metavar="M", help="Between links. Default: 0.01 m."),
        click.option("--floor", metavar="M", help="Height of a floor that nothing may touch."),
        click.option(
            "--iterations", type=click.IntRange(min=1), help="Of the search. Default: 150."
        ),
        click.option("--starts", type=click.IntRange(min=1), help="Of the search. Default: 1."),
    ],
)

_unknown_options = group_options(
    "unknowns",
    _Unknowns,
    [
        task_option,
        sensor_option,
        click.option(
            "--payload", default="none", show_default=True, help="Load mounted at the tool."
        ),
        terms_option,
    ],
)

_bound_options = group_options(
    "bounds",
    _Bounds,
    [
        click.option(
            "--limit",
            "limits",
            multiple=True,
            metavar="v|a|tau=X[,X...]",
            help="Instead of the robot's limits: one number for all joints, or one each.",
        ),
        click.option(
            "--gain",
            "gains",
            multiple=True,
            metavar="kp|kd=X[,X...]",
            help="Task actuators: gains of the position controller (N m/rad, N m s/rad); one "
            "number for all joints, or one each. Default: those of the model's actuators.",
        ),
        click.option(
            "--box",
            "boxes",
            multiple=True,
            metavar="BODY=X:X,Y:Y,Z:Z",
            help="Where a body may go, m.",
        ),
    ],
)

_output_options = group_options(
    "output",
    _Output,
    [
        click.option("--export", help="csv (default), ros2, damiao or can."),
        click.option(
            "--motors",
            metavar="TYPE,TYPE,...|FILE.toml",
            help="Damiao motors of the joints for --export; for --task actuators names of `list "
            "motors`, one or one each, whose torque and speed are kept.",
        ),
        click.option(
            "--clamp", default="1 %", show_default=True, help="Samples that motors may clamp."
        ),
        click.option("--rate", default="200 Hz", show_default=True, help="Of the written samples."),
        click.option("-o", "out", type=click.Path(path_type=Path), help="File of the motion."),
        json_option,
    ],
)


@click.command()
@click.argument("robot", metavar="ROBOT|FILE")
@click.option(
    "--objective",
    default="cond",
    show_default=True,
    help="cond, cond-unit, D, A, E or predict; or weights: D=1,cond=0.2.",
)
@_setting_options
@_unknown_options
@_bound_options
@click.option(
    "--after",
    multiple=True,
    type=click.Path(path_type=Path),
    help="CSV of a motion already recorded: design the next one.",
)
@_output_options
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@model_options("robot")
@robots_option
@report_errors
def excite(
    robot: str,
    objective: str,
    settings: _Settings,
    unknowns: _Unknowns,
    bounds: _Bounds,
    after: tuple[Path, ...],
    output: _Output,
    seed: int,
    robots_dir: Path | None,
) -> int:
    """Design the best motion within a robot's limits, and write it for its controller.

    Exit code 1 where a limit is violated, 130 after an interrupt (the best motion is written).
    """
    if (code := supervise([("task", unknowns.task)], search_progress)) is not None:
        return code
    if unknowns.task == TASK:
        _check_of_commands(objective, settings, unknowns, bounds, after, output)
        return _excite_commands(robot, settings, bounds, output, seed, robots_dir)
    _refuse_gains(bounds)
    request = sysid_bench.ExciteRequest(
        robot,
        parse_criterion(objective),
        out=output.out,
        export=output.export,
        task=unknowns.task,
        payload=unknowns.payload,
        sensor=unknowns.sensor,
        terms=parse_terms(unknowns.terms),
        settings=parse_settings(vars(settings), bounds.boxes),
        limits=parse_limits(bounds.limits),
        motors=None if output.motors is None else parse_motors(output.motors),
        clamp=quantity(output.clamp, "1"),
        after=after,
        rate=quantity(output.rate, "Hz"),
        seed=seed,
        robots_dir=robots_dir,
    )
    return _designed(request, output)


def _refuse_gains(bounds: _Bounds) -> None:
    if bounds.gains:
        raise UsageError(f"--gain: for --task {TASK} alone, whose robots are position-commanded.")


def _check_of_commands(
    objective: str,
    settings: _Settings,
    unknowns: _Unknowns,
    bounds: _Bounds,
    after: tuple[Path, ...],
    output: _Output,
) -> None:
    """Raise UsageError for options that a design of commands does not have."""
    given = {
        "objective": objective != "cond", "payload": unknowns.payload != "none",
        "sensor": unknowns.sensor, "terms": unknowns.terms, "box": bounds.boxes, "after": after,
        "export": output.export,
        **{name: value for name, value in vars(settings).items() if name not in OF_COMMANDS},
    }  # fmt: skip
    names = [f"--{name.replace('_', '-')}" for name, value in given.items() if value]
    if names:
        raise UsageError(
            f"{', '.join(names)}: not for --task {TASK}, whose commands have "
            f"{', '.join(f'--{name}' for name in OF_COMMANDS)}, --gain, --limit and --motors."
        )


def _excite_commands(
    robot: str,
    settings: _Settings,
    bounds: _Bounds,
    output: _Output,
    seed: int,
    robots_dir: Path | None,
) -> int:
    """Design commands of a position controller."""
    given = parse_settings({name: getattr(settings, name) for name in OF_COMMANDS}, ())
    request = sysid_bench.CommandsRequest(
        robot,
        gains=parse_limits(bounds.gains),
        limits=parse_limits(bounds.limits),
        motors=[name.strip() for name in (output.motors or "").split(",") if name.strip()],
        out=output.out,
        rate=quantity(output.rate, "Hz"),
        seed=seed,
        robots_dir=robots_dir,
        **given,
    )
    return _designed(request, output)


def _designed(request: "ExciteRequest | CommandsRequest", output: _Output) -> int:
    """Design and print; return the exit code."""
    with search_progress() as on_value:
        result = sysid_bench.excite(request, on_value)
    print_result(result, output.as_json)
    if result.interrupted:
        return INTERRUPTED
    return FAILED if result.violations else OK
