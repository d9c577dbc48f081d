"""Verbs on one robot: crosscheck, basis, identify."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from sysid_bench.cli.frame import (
    FAILED,
    OK,
    json_option,
    print_json,
    robots_option,
    verb,
)


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
@click.option("--task", default="robot", show_default=True, help="robot, payload, link, terminal.")
@click.option("--terms", help="Joint terms that are unknown too: viscous,coulomb,...; or none.")
@click.option("--free-base", is_flag=True, default=None, help="Let the root body float.")
@click.option("--paper", is_flag=True, help="The sums alone, one per line, single ones first.")
@robots_option
@json_option
@verb
def basis(
    robot: str,
    task: str,
    terms: str | None,
    free_base: bool | None,
    paper: bool,
    robots_dir: Path | None,
    as_json: bool,
) -> int:
    """Base parameters: how many, which sums, and what can be told of each parameter."""
    from sysid_bench.verbs import basis as bases
    from sysid_bench.verbs.chosen import chosen_terms

    answer = bases.basis(robot, task, chosen_terms(terms), free_base, robots_dir)
    if as_json:
        print_json(answer)
        return OK
    for line in (bases.paper if paper else bases.summary)(answer):
        click.echo(line)
    return OK


@click.command()
@click.argument("model", metavar="MODEL")
@click.option("--simulate", is_flag=True, help="Data from the robot's own simulation.")
@click.option("--task", default="robot", show_default=True, help="robot, payload, link, terminal.")
@click.option("--payload", default="none", show_default=True, help="What is mounted at the tool.")
@click.option("--terms", help="Joint terms that are unknown too: viscous,coulomb,...; or none.")
@click.option("--estimator", metavar="NAME", help="Default: ols; min-norm for the task terminal.")
@click.option("--noise", metavar="tau=0.5 %,q=1e-4 rad", help="Sensor noise; default: none.")
@click.option(
    "--model-out", type=click.Path(path_type=Path), help="The model again, with identified values."
)
@click.option("--json-out", type=click.Path(path_type=Path), help="The answer as a file.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@robots_option
@json_option
@verb
def identify(
    model: str,
    simulate: bool,
    task: str,
    payload: str,
    terms: str | None,
    estimator: str | None,
    noise: str | None,
    model_out: Path | None,
    json_out: Path | None,
    seed: int,
    robots_dir: Path | None,
    as_json: bool,
) -> int:
    """Identify one robot: parse, excite, simulate, solve, export."""
    from sysid_bench.errors import UsageError
    from sysid_bench.verbs import identify as identification
    from sysid_bench.verbs.chosen import chosen_noise, chosen_terms

    if not simulate:
        raise UsageError("Where do the data come from? Say --simulate for the robot's simulation.")
    if json_out is not None and not json_out.parent.is_dir():
        raise UsageError(f"There is no folder {str(json_out.parent)!r} to write the answer to.")
    answer = identification.identify(
        model, task, payload, chosen_terms(terms), estimator, chosen_noise(noise), model_out, seed,
        robots_dir,
    )  # fmt: skip
    if json_out is not None:
        json_out.write_text(json.dumps(answer, indent=2) + "\n", encoding="utf-8")
    if as_json:
        print_json(answer)
        return OK
    for line in identification.summary(answer):
        click.echo(line)
    return OK
