"""Verbs on motions: excite."""

import os
from pathlib import Path
from typing import Any

import click

from sysid_bench.cli.common import (
    FAILED,
    INTERRUPTED,
    OK,
    json_option,
    print_json,
    robots_option,
    task_option,
    verb,
)
from sysid_bench.cli.robot_commands import SENSOR


@click.command()
@click.argument("robot", metavar="ROBOT|FILE")
@click.option(
    "--objective",
    default="cond",
    show_default=True,
    help="cond, cond-unit, D, A, E or predict; or weights: D=1,cond=0.2.",
)
@click.option("--period", metavar="S", help="Default: 10 s.")
@click.option("--harmonics", type=click.IntRange(min=1), help="Default: 5.")
@click.option("--cycles", type=click.IntRange(min=1), help="Periods to play. Default: 1.")
@click.option(
    "--family", help="fourier, fourier-polynomial or b-spline; the last two start and end at rest. "
    "Default: fourier, and fourier-polynomial for ros2, damiao and can.",
)  # fmt: skip
@click.option("--joints", metavar="A,B,...", help="Joints that move; default: all.")
@task_option
@click.option("--sensor", metavar="NAME|PLACE", help=SENSOR)
@click.option("--payload", default="none", show_default=True, help="What is mounted at the tool.")
@click.option("--terms", help="Joint terms that are unknown too: viscous,coulomb,...; or none.")
@click.option(
    "--limit",
    "limits",
    multiple=True,
    metavar="v|a|tau=X[,X...]",
    help="Instead of the robot's limits: one number for all joints, or one each.",
)
@click.option("--torque-share", metavar="SHARE", help="Of the torque limits. Default: 90 %.")
@click.option("--clearance", metavar="M", help="Between links. Default: 0.01 m.")
@click.option("--floor", metavar="M", help="Height of a floor that nothing may touch.")
@click.option(
    "--box", "boxes", multiple=True, metavar="BODY=X:X,Y:Y,Z:Z", help="Where a body may go, m."
)
@click.option(
    "--after",
    multiple=True,
    type=click.Path(path_type=Path),
    help="A CSV motion that was recorded before: design what to run next.",
)
@click.option("--iterations", type=click.IntRange(min=1), help="Of the search. Default: 150.")
@click.option("--starts", type=click.IntRange(min=1), help="Of the search. Default: 1.")
@click.option("--export", help="csv (default), ros2, damiao or can.")
@click.option("--motors", metavar="TYPE,TYPE,...|FILE.toml", help="Damiao motors of the joints.")
@click.option("--clamp", default="1 %", show_default=True, help="Samples that motors may clamp.")
@click.option("--rate", default="200 Hz", show_default=True, help="Of the written samples.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@click.option("-o", "out", type=click.Path(path_type=Path), help="The file of the motion.")
@robots_option
@json_option
@verb
def excite(
    robot: str,
    objective: str,
    limits: tuple[str, ...],
    boxes: tuple[str, ...],
    task: str,
    payload: str,
    sensor: str | None,
    terms: str | None,
    after: tuple[Path, ...],
    export: str | None,
    motors: str | None,
    clamp: str,
    rate: str,
    seed: int,
    out: Path | None,
    robots_dir: Path | None,
    as_json: bool,
    **settings: Any,
) -> int:
    """Design the best motion within a robot's limits, and write it for its controller.

    Exit code 1 where a limit is violated, 130 after an interrupt (the best motion so far is
    written).
    """
    # Before NumPy is loaded: a search solves many small problems, and on a busy machine the threads
    # of BLAS wait for each other a hundred times longer than one alone works.
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    from sysid_bench.units import quantity
    from sysid_bench.verbs import excite as designing
    from sysid_bench.verbs.option_parsing import parse_terms
    from sysid_bench.verbs.progress import values

    with values() as tell:
        answer = designing.excite(
            robot,
            designing.parse_objective(objective),
            out=out,
            export=export,
            task=task,
            payload=payload,
            sensor=sensor,
            terms=parse_terms(terms),
            settings=designing.parse_settings(settings, boxes),
            limits=designing.parse_limits(limits),
            motors=None if motors is None else designing.motors_of(motors),
            clamp=quantity(clamp, "1"),
            after=after,
            rate=quantity(rate, "Hz"),
            seed=seed,
            robots_dir=robots_dir,
            tell=tell,
        )
    if as_json:
        print_json(answer)
    else:
        for line in designing.summary(answer):
            click.echo(line)
    if answer["interrupted"]:
        return INTERRUPTED
    return FAILED if answer["violations"] else OK
