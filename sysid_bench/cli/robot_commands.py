"""Verbs on one robot: crosscheck, basis, identify."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from sysid_bench.cli.common import (
    FAILED,
    OK,
    json_option,
    print_json,
    robots_option,
    task_option,
    verb,
)

SENSOR = "Force/torque sensor: a name of the manifest, or a fixed joint, site or body to cut at."


@click.command()
@click.argument("robots", nargs=-1, required=True, metavar="ROBOT|FILE...")
@click.option("--samples", default=50, show_default=True, help="Random states to compare at.")
@click.option("--free-base", is_flag=True, default=None, help="Let the root body float.")
@click.option(
    "--assets",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    metavar="DIR",
    help="The folder that MJCF files may read below; default: each file's own.",
)
@robots_option
@json_option
@verb
def crosscheck(
    robots: tuple[str, ...],
    samples: int,
    free_base: bool | None,
    assets: Path | None,
    robots_dir: Path | None,
    as_json: bool,
) -> int:
    """Compare a robot's regressor between MuJoCo and Pinocchio.

    Exit code 1 where a robot is above tolerance or cannot be loaded.
    """
    from sysid_bench.verbs.crosscheck import crosscheck as check

    verdicts = check(
        *robots, samples=samples, free_base=free_base, robots_dir=robots_dir, assets=assets
    )
    if as_json:
        print_json(verdicts)
    else:
        for verdict in verdicts:
            _print_verdict(verdict)
    return OK if all(verdict["ok"] for verdict in verdicts) else FAILED


def _print_verdict(verdict: Mapping[str, Any]) -> None:
    if verdict["nv"] is None:
        click.echo(f"sysid-bench: {verdict['robot']}: {verdict['reason']}", err=True)
        return
    native = verdict["native_gap"]
    told = (
        f"native gap {native:.1e}" if native is not None else f"native: {verdict['native_reason']}"
    )
    word = click.style("agrees", fg="green") if verdict["ok"] else click.style("DIFFERS", fg="red")
    click.echo(
        f"{verdict['robot']}: {word}  gap {verdict['gap']:.1e}  "
        f"closure {verdict['closure']:.1e}  {told}\n"
        f"  {verdict['nv']} degrees of freedom, {verdict['bodies']} bodies, "
        f"{verdict['base_parameters']} base parameters"
        + (f" ({verdict['near_degenerate']} near-degenerate)" if verdict["near_degenerate"] else "")
    )
    if verdict["coupling"] is not None:
        coupling = verdict["coupling"]
        followers = coupling["dependent"]
        names = ", ".join(followers[:6]) + (", ..." if len(followers) > 6 else "")
        click.echo(
            f"  coupled, {len(followers)} followers ({names}): gap {coupling['gap']:.1e}  "
            f"closure {coupling['closure']:.1e}, "
            f"{coupling['coupled_base_parameters']} base parameters"
        )
    for repair in verdict["repairs"]:
        click.echo(f"  {'doubtful' if repair.endswith('?') else 'repaired'}: {repair}")
    if verdict["reason"]:
        click.echo(f"sysid-bench: {verdict['robot']}: {verdict['reason']}", err=True)


@click.command()
@click.argument("robot", metavar="ROBOT|FILE")
@task_option
@click.option("--terms", help="Joint terms that are unknown too: viscous,coulomb,...; or none.")
@click.option("--sensor", metavar="NAME|PLACE", help=SENSOR)
@click.option("--free-base", is_flag=True, default=None, help="Let the root body float.")
@click.option("--paper", is_flag=True, help="The sums alone, one per line, single ones first.")
@click.option("--zero", metavar="NAMES", help="With --paper: parameters taken for zero; or none.")
@click.option(
    "--values",
    type=click.Path(path_type=Path),
    metavar="FILE.json",
    help="With --paper: values of the sums, from identify --json-out; impossible ones are marked.",
)
@robots_option
@json_option
@verb
def basis(
    robot: str,
    task: str,
    terms: str | None,
    sensor: str | None,
    free_base: bool | None,
    paper: bool,
    zero: str | None,
    values: Path | None,
    robots_dir: Path | None,
    as_json: bool,
) -> int:
    """Base parameters: how many, which sums, and what can be told of each parameter."""
    from sysid_bench.errors import UsageError
    from sysid_bench.tasks.task import named_task
    from sysid_bench.verbs import base_table as papers
    from sysid_bench.verbs import basis as bases
    from sysid_bench.verbs.option_parsing import parse_terms

    if (zero is not None or values is not None) and not paper:
        raise UsageError("--zero and --values belong to --paper.")
    if paper and named_task(task).identifies_whole_robot and free_base is None and sensor is None:
        names = None if zero is None else tuple(w.strip() for w in zero.split(",") if w.strip())
        names = () if names == ("none",) else names
        table = papers.paper_table(robot, parse_terms(terms), names, values, robots_dir)
        if as_json:
            print_json(table)
            return OK
        for line in papers.lines(table):
            click.echo(line)
        return OK
    answer = bases.basis(robot, task, parse_terms(terms), free_base, robots_dir, sensor)
    if as_json:
        print_json(answer)
        return OK
    for line in (bases.paper if paper else bases.summary)(answer):
        click.echo(line)
    return OK


@click.command()
@click.argument("model", metavar="MODEL")
@click.option("--simulate", is_flag=True, help="Data from the robot's own simulation.")
@click.option(
    "--log",
    "logs",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="LOG.toml",
    help="Data from a recording; several are used together.",
)
@click.option(
    "--test",
    "tests",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="LOG.toml",
    help="A recording to judge on.",
)
@click.option(
    "--choose",
    "candidates",
    metavar="play,offset,motor.play,...",
    help="Of logs: joint terms and features (play, playq, tanh, poly), of motors too (motor.play, "
    "motor.coulomb), that cross-validation in the training data may add.",
)
@click.option(
    "--position-given",
    is_flag=True,
    help="Of logs, task payload: its mass alone is unknown, centre of mass as the log says.",
)
@click.option(
    "--figure",
    type=click.Path(path_type=Path),
    metavar="FILE.pdf|svg",
    help="Of logs: measured and predicted torque and their difference, joint by joint.",
)
@click.option("--accept", metavar="rate,units", help="Contradictions in logs that may pass.")
@click.option("--filter", "filter_text", metavar="TEXT", help="Of logs: 'butter 4 10 Hz', ...")
@click.option("--derivatives", type=click.Choice(["from q", "from v"]), help="Of logs.")
@click.option(
    "--moving",
    default=0.0,
    show_default=True,
    type=click.FloatRange(min=0.0),
    help="Of logs: leave out samples of a joint slower than this (rad/s, m/s).",
)
@task_option
@click.option("--sensor", metavar="NAME|PLACE", help=SENSOR)
@click.option(
    "--payload", default="none", show_default=True,
    help="What is mounted at the tool: a name, or a table '{ mass = 1.2, com = [0, 0, 0.05], "
    "inertia = \"sphere 0.05 m\" }'.",
)  # fmt: skip
@click.option("--terms", help="Joint terms that are unknown too: viscous,coulomb,j1.k...; or none.")
@click.option("--free-base", is_flag=True, default=None, help="Let the root body float.")
@click.option(
    "--estimator",
    metavar="NAME",
    help="Default: ols; wls with logs and for wrench; min-norm for terminal.",
)
@click.option("--noise", metavar="tau=0.5 %,q=1e-4 rad", help="Sensor noise; default: none.")
@click.option(
    "--contacts",
    metavar="detect|'10 s to 25 s'",
    help="Samples left out: found behind a sensor, or in these periods.",
)
@click.option(
    "--model-out", type=click.Path(path_type=Path), help="The model again, with identified values."
)
@click.option(
    "--complete",
    type=click.Choice(["entropic", "euclidean", "pullback"]),
    help="Whole bodies that can exist, nearest to the prior in this distance.",
)
@click.option("--json-out", type=click.Path(path_type=Path), help="The answer as a file.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@robots_option
@json_option
@verb
def identify(
    model: str,
    simulate: bool,
    logs: tuple[Path, ...],
    tests: tuple[Path, ...],
    candidates: str | None,
    position_given: bool,
    figure: Path | None,
    accept: str | None,
    filter_text: str | None,
    derivatives: str | None,
    moving: float,
    task: str,
    sensor: str | None,
    payload: str,
    terms: str | None,
    free_base: bool | None,
    estimator: str | None,
    noise: str | None,
    contacts: str | None,
    model_out: Path | None,
    complete: str | None,
    json_out: Path | None,
    seed: int,
    robots_dir: Path | None,
    as_json: bool,
) -> int:
    """Identify one robot: parse, excite, simulate (or read recordings), solve, export."""
    from sysid_bench.errors import UsageError
    from sysid_bench.verbs import identify as identification
    from sysid_bench.verbs import identify_logs as recordings
    from sysid_bench.verbs.option_parsing import (
        parse_contacts,
        parse_noise,
        parse_payload_option,
        parse_terms,
    )

    if simulate == bool(logs):
        raise UsageError(
            "Where do the data come from? Say --log LOG.toml for a recording, or --simulate for "
            "the robot's simulation."
        )
    if logs and (noise is not None or payload != "none"):
        raise UsageError("--noise and --payload belong to --simulate; a log states its payload.")
    if logs and any(word is not None for word in (sensor, complete, contacts)):
        raise UsageError(
            "--sensor, --contacts and --complete belong to --simulate: logs hold positions and "
            "torques, and no force/torque sensor."
        )
    of_logs = (tests, figure, accept, candidates, position_given, filter_text, derivatives, moving)
    if simulate and any(of_logs):
        raise UsageError(
            "--test, --accept, --choose, --position-given, --filter, --derivatives, --moving and "
            "--figure belong to --log."
        )
    if logs:
        passed, more = (
            tuple(word.strip() for word in (words or "").split(",") if word.strip())
            for words in (accept, candidates)
        )
        if json_out is not None and not json_out.parent.is_dir():
            raise UsageError(f"There is no folder {str(json_out.parent)!r} to write the answer to.")
        answer = recordings.identify_logs(
            model, logs, tests, task, parse_terms(terms), estimator, filter_text, derivatives,
            moving, more, position_given, passed, model_out,
            figure, robots_dir,
        )  # fmt: skip
        if json_out is not None:
            json_out.write_text(json.dumps(answer, indent=2) + "\n", encoding="utf-8")
    else:
        answer = identification.identify(
            model, task, parse_payload_option(payload), parse_terms(terms), estimator,
            parse_noise(noise), model_out, seed, robots_dir, complete, sensor, json_out, free_base,
            parse_contacts(contacts),
        )  # fmt: skip
    if as_json:
        print_json(answer)
        return OK
    for line in (recordings if logs else identification).summary(answer):
        click.echo(line)
    return OK
