"""The command `sysid-bench`: words in, sysid_bench.verbs called, results printed.

Data goes to stdout, errors to stderr in one readable paragraph (a traceback only under --debug).
Only click is imported here; each verb imports what it needs when it is called.
"""

import json
import sys
from collections.abc import Callable, Mapping
from functools import wraps
from pathlib import Path
from typing import Any

import click

from sysid_bench.errors import SysidBenchError

OK, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130

robots_option = click.option(
    "--robots", "robots_dir", type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="A folder of your own robots, <name>/robot.toml.",
)  # fmt: skip
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


class _Group(click.Group):
    """Verbs in the order of a user's day."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--debug", is_flag=True, help="Show tracebacks.")
@click.version_option(package_name="sysid-bench", prog_name="sysid-bench")
@click.pass_context
def main(ctx: click.Context, debug: bool) -> None:
    """Benchmark of robot dynamic identification, cross-validated with Pinocchio."""
    ctx.obj = debug
    if "" not in sys.path:  # "my_lab:Thing" means the folder one stands in, as with python -m
        sys.path.insert(0, "")


def verb(function: Callable[..., int]) -> Callable[..., None]:
    """Runs a verb and leaves with its exit code; our errors become one paragraph and code 2."""

    @wraps(function)
    def guarded(*args: Any, **options: Any) -> None:
        debug = bool(click.get_current_context().find_root().obj)
        try:
            code = function(*args, **options)
        except KeyboardInterrupt:
            code = INTERRUPTED
        except BrokenPipeError:  # the reader of our output has left, as `head` does
            sys.stderr.close()
            code = OK
        except SysidBenchError as error:
            if debug:
                raise
            click.echo(f"sysid-bench: {error}", err=True)
            code = USAGE
        except OSError as error:
            if debug:
                raise
            place = error.filename or "a file"
            click.echo(
                f"sysid-bench: {place}: {error.strerror or error}; choose a folder that can be "
                "written (-o), with room on its disk.",
                err=True,
            )
            code = USAGE
        click.get_current_context().exit(code)

    return guarded


def _json(value: Any) -> None:
    from sysid_bench.harness.canonical import plain

    click.echo(json.dumps(plain(value), indent=2))


@main.command()
@click.argument("robots", nargs=-1, required=True, metavar="ROBOT|FILE...")
@click.option("--samples", default=50, show_default=True, help="Random states to compare at.")
@click.option("--free-base", is_flag=True, default=None, help="Let the root body float.")
@robots_option
@json_option
@verb
def crosscheck(
    robots: tuple[str, ...],
    samples: int,
    free_base: bool | None,
    robots_dir: Path | None,
    as_json: bool,
) -> int:
    """Compare a robot's regressor between MuJoCo and Pinocchio.

    Exit code 1 where a robot is above tolerance or cannot be loaded.
    """
    from sysid_bench.verbs.crosscheck import crosscheck as check

    verdicts = check(*robots, samples=samples, free_base=free_base, robots_dir=robots_dir)
    if as_json:
        _json(verdicts)
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
    for repair in verdict["repairs"]:
        click.echo(f"  repaired: {repair}")
    if verdict["reason"]:
        click.echo(f"sysid-bench: {verdict['robot']}: {verdict['reason']}", err=True)


@main.command()
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
        _json(answer)
        return OK
    for line in (bases.paper if paper else bases.summary)(answer):
        click.echo(line)
    return OK


@main.command()
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
        _json(answer)
        return OK
    for line in identification.summary(answer):
        click.echo(line)
    return OK


@main.command(name="list")
@click.argument("kind", metavar="robots|payloads|excitations|estimators|suites|simulations|plants")
@robots_option
@json_option
@verb
def list_(kind: str, robots_dir: Path | None, as_json: bool) -> int:
    """List what can be named."""
    from sysid_bench.verbs.catalogue import list_ as entries_of

    entries = entries_of(kind, robots_dir)
    if as_json:
        _json(entries)
    else:
        width = max((len(entry["name"]) for entry in entries), default=0)
        for entry in entries:
            click.echo(f"{entry['name']:<{width}}  {entry['title']}".rstrip())
    return OK


@main.command()
@click.argument("name")
@robots_option
@json_option
@verb
def show(name: str, robots_dir: Path | None, as_json: bool) -> int:
    """Show one robot, payload, plug-in or suite."""
    from sysid_bench.verbs.catalogue import show as shown

    thing = shown(name, robots_dir)
    if as_json:
        _json(thing)
    else:
        for key, value in thing.items():
            text = value if isinstance(value, str) else json.dumps(value, default=str)
            click.echo(f"{key:<12} {text}")
    return OK


@main.command()
@click.argument("suite")
@click.option("--select", help="Only cells that meet this expression.")
@click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Change a key of the suite."
)
@robots_option
@json_option
@verb
def plan(
    suite: str,
    select: str | None,
    settings: tuple[str, ...],
    robots_dir: Path | None,
    as_json: bool,
) -> int:
    """Validate a suite and count its cells; nothing runs."""
    from sysid_bench.verbs.runs import plan as planned

    try:
        made = planned(suite, select, _pairs(settings), robots_dir)
    except SysidBenchError as error:
        if not as_json:
            raise
        _json(
            {
                "cells": 0,
                "experiments": 0,
                "excluded": {},
                "seconds": 0,
                "errors": str(error).splitlines(),
            }
        )
        return USAGE
    if as_json:
        counts = {"cells": len(made.cells), "experiments": len(made.experiments)}
        more = {"excluded": dict(made.excluded), "seconds": made.seconds, "errors": []}
        _json({**counts, **more, "notes": list(made.notes)})
        return OK
    click.echo(
        f"{len(made.cells)} cells in {len(made.experiments)} experiments, "
        f"about {made.seconds:.0f} s of one core"
    )
    for reason, count in made.excluded.items():
        click.echo(f"{count} cells excluded: {reason}")
    for note in made.notes:
        click.echo(note)
    return OK


@main.command()
@click.argument("suite", metavar="SUITE|RUN")
@click.option(
    "-o", "--out", type=click.Path(path_type=Path), help="Run folder; default reports/<suite>."
)
@click.option("-j", "--jobs", type=click.IntRange(min=1), help="Workers; default one per core.")
@click.option("--select", help="Only cells that meet this expression.")
@click.option("--limit", type=click.IntRange(min=1), help="Only the first N cells.")
@click.option("--timeout", metavar="60s", help="Hard limit per experiment.")
@click.option(
    "--rerun", type=click.Choice(["failed", "stale", "all"]), help="Run these cells again."
)
@click.option("--record", metavar="SPEC", help="Record cells that meet this expression.")
@click.option("--fail-fast", is_flag=True, help="Stop at the first failure.")
@click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Change a key of the suite."
)
@robots_option
@verb
def run(
    suite: str,
    out: Path | None,
    jobs: int | None,
    select: str | None,
    limit: int | None,
    timeout: str | None,
    rerun: Any,
    record: str | None,
    fail_fast: bool,
    settings: tuple[str, ...],
    robots_dir: Path | None,
) -> int:
    """Run a suite, or go on with a run; then write its tables, figures and report.

    Exit codes: 0 ok, 1 a cross-check failed, 2 wrong usage or suite, 3 some cells failed,
    4 nothing selected or measured, 130 interrupted and resumable.
    """
    from sysid_bench.verbs.progress import progress
    from sysid_bench.verbs.runs import run as execute

    with progress() as on_event:
        result = execute(
            suite, out, jobs, select, limit, timeout, rerun, fail_fast, record, _pairs(settings),
            robots_dir, on_event,
        )  # fmt: skip
    _print_result(result)
    return int(result.exit_code)


def _print_result(result: Any) -> None:
    from sysid_bench.verbs.reports import printed_tables

    folder = result.folder.path
    if result.exit_code == INTERRUPTED:
        click.echo(f"Interrupted; the same command goes on. Rows are in {folder}.", err=True)
        return
    if not result.counts:
        click.echo("No cell was selected; see 'sysid-bench plan'.", err=True)
        return
    for text in printed_tables(folder):
        click.echo(text)
    counts = ", ".join(f"{count} {status}" for status, count in result.counts.items())
    click.echo(f"{counts}" + (f", {result.open} open" if result.open else ""))
    for note in result.notes:
        click.echo(note)
    click.echo(f"report: {folder / 'report.html'}")


def _pairs(settings: tuple[str, ...]) -> dict[str, str]:
    pairs = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals or not key:
            raise click.BadParameter(f"{setting!r} is no KEY=VALUE.", param_hint="--set")
        pairs[key.strip()] = value.strip()
    return pairs


@main.command()
@click.argument("run_folder", metavar="RUN")
@json_option
@verb
def status(run_folder: str, as_json: bool) -> int:
    """How far a run is, and what failed."""
    from sysid_bench.verbs.runs import status as status_of

    state = status_of(run_folder)
    if as_json:
        _json(state)
        return OK
    counts = ", ".join(f"{count} {kind}" for kind, count in state["statuses"].items()) or "no rows"
    click.echo(f"{state['cells']} cells: {counts}, {state['open']} open")
    for reason in state["reasons"]:
        click.echo(f"  {reason['cells']} {reason['status']}: {reason['reason']}")
    return OK


@main.command()
@click.argument("run_folder", metavar="RUN")
@click.argument("identifier", metavar="ID")
@json_option
@verb
def cell(run_folder: str, identifier: str, as_json: bool) -> int:
    """One row, its traceback, and the command that reproduces it."""
    from sysid_bench.verbs.runs import cell as cell_of

    row = cell_of(run_folder, identifier)
    if as_json:
        _json(row)
        return OK
    for key, value in row.items():
        if key in ("joints", "parameters_table", "traceback"):
            continue
        click.echo(f"{key:<22} {value if isinstance(value, str) else json.dumps(value)}")
    if row.get("traceback"):
        click.echo(f"\n{row['traceback']}")
    return OK


@main.command()
@click.argument("run_folder", metavar="RUN")
@click.argument("name")
@click.option("--format", "form", default="md", show_default=True, help="md, csv or latex.")
@verb
def table(run_folder: str, name: str, form: str) -> int:
    """Print one table of a run."""
    from sysid_bench.verbs.reports import table as text_of

    click.echo(text_of(run_folder, name, form), nl=False)
    return OK


@main.command()
@click.argument("run_folder", metavar="RUN")
@verb
def report(run_folder: str) -> int:
    """Write a run's tables, figures and report.html again."""
    from sysid_bench.verbs.reports import report as write

    click.echo(str(write(run_folder)))
    return OK


@main.command()
@click.argument("run_folder", metavar="RUN")
@click.argument("what", metavar="ID|SPEC")
@robots_option
@verb
def record(run_folder: str, what: str, robots_dir: Path | None) -> int:
    """Execute a cell again and write its recording for the Rerun viewer."""
    from sysid_bench.verbs.recordings import record as write

    for path in write(run_folder, what, robots_dir):
        click.echo(str(path))
    return OK


@main.command()
@click.argument("run_folder", metavar="RUN")
@click.argument("identifier", metavar="ID")
@click.option("--web", is_flag=True, help="In the browser, served on this machine alone.")
@verb
def view(run_folder: str, identifier: str, web: bool) -> int:
    """Open the recording of a cell."""
    from sysid_bench.verbs.recordings import view as open_viewer

    return int(open_viewer(run_folder, identifier, web).wait())


@main.command()
@json_option
@verb
def doctor(as_json: bool) -> int:
    """Check this machine."""
    from sysid_bench.verbs.doctor import doctor as examine

    findings = examine()
    if as_json:
        _json(findings)
    else:
        for check in findings["checks"]:
            word = "ok" if check["ok"] else ("MISSING" if check["needed"] else "absent (optional)")
            click.echo(f"{check['name']:<20} {word:<18} {check['detail']}")
    return OK if findings["ok"] else FAILED


if __name__ == "__main__":
    main()
