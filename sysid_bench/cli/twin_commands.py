"""Commands about twins of recorded robots: twin, transfer."""

from functools import partial
from pathlib import Path

import click

import sysid_bench
from sysid_bench.cli.options import (
    OK,
    OptionsRecord,
    group_options,
    json_option,
    log_options,
    model_options,
    print_result,
    report_errors,
    robots_option,
)
from sysid_bench.commands.result import Result
from sysid_bench.commands.values import parse_names
from sysid_bench.errors import UsageError


class _Single(OptionsRecord):
    logs: tuple[Path, ...]
    tests: tuple[Path, ...]
    null: bool
    out: Path | None
    figure: Path | None
    accept: str | None
    robots_dir: Path | None

    def of(self, key: str) -> object:
        """The value of an option by its word."""
        return {"log": self.logs, "test": self.tests}.get(key) or vars(self).get(key)


jobs_option = click.option(
    "-j", "--jobs", default=1, type=click.IntRange(min=1), help="Processes, of several sets."
)
figure_option = click.option(
    "--figure",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Draw the comparison: .png, .pdf or .svg.",
)
_single_options = group_options(
    "single",
    _Single,
    [
        log_options("log", "Recording to fit; default: the training motions of the data set."),
        log_options("test", "Recording to compare the residual on."),
        click.option("--null", is_flag=True, help="No effects: noise of the same residual alone."),
        click.option(
            "-o",
            "--out",
            type=click.Path(path_type=Path),
            help="Plant file; its robot is written beside it.",
        ),
        figure_option,
        click.option("--accept", metavar="rate,units", help="Contradictions that may pass."),
        robots_option,
    ],
)


@click.command()
@click.argument("models", nargs=-1, required=True, metavar="MODEL|SET...")
@_single_options
@click.option(
    "--truth",
    type=click.Choice(["wls", "lmi"]),
    help="Identified model: wls with its bodies completed (default), or lmi; of several sets both.",
)
@model_options("models")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@jobs_option
@json_option
@report_errors
def twin(
    models: tuple[str, ...], truth: str | None, seed: int, jobs: int, as_json: bool,
    single: _Single,
) -> int:  # fmt: skip
    """Fit the effects of a robot's plant from a recording, and compare its replay.

    MODEL with --log, or the name or folder of a data set. Of several sets: a table of twins and
    null twins.
    """
    if len(models) == 1:
        result: Result = sysid_bench.twin(
            models[0],
            log=single.logs,
            test=single.tests,
            truth=truth or "wls",
            null=single.null,
            out=single.out,
            figure=single.figure,
            seed=seed,
            accept=parse_names(single.accept),
            robots_dir=single.robots_dir,
        )
    else:
        _check_several(single)
        truths = ("wls", "lmi") if truth is None else (truth,)
        notice = partial(click.echo, err=True)
        result = sysid_bench.twin_table(models, truth=truths, seed=seed, jobs=jobs, progress=notice)
    print_result(result, as_json)
    return OK


def _check_several(single: _Single) -> None:
    """Raise UsageError for options that one robot alone has."""
    given = [
        f"--{key}" for key in ("log", "test", "null", "out", "figure", "accept") if single.of(key)
    ]
    if given:
        raise UsageError(f"{', '.join(given)}: for one robot alone; of several, name data sets.")


@click.command()
@click.argument("sets", nargs=-1, required=True, metavar="SET...")
@click.option("--truth", metavar="wls,lmi", help="Identified models that move; default: both.")
@click.option("--methods", metavar="A,B,...", help="Estimators to compare.")
@click.option("--levels", metavar="L0,L1,...", help="Plants to replay; default: all levels.")
@click.option(
    "--draws", default=3, show_default=True, type=click.IntRange(min=1), help="Of the noise."
)
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@figure_option
@jobs_option
@json_option
@report_errors
def transfer(
    sets: tuple[str, ...], truth: str | None, methods: str | None, levels: str | None,
    draws: int, seed: int, figure: Path | None, jobs: int, as_json: bool,
) -> int:  # fmt: skip
    """Compare methods on recorded robots and on replays: what does simulation predict?"""
    written = {"truth": truth, "methods": methods, "levels": levels}
    given = {key: parse_names(text) for key, text in written.items()}
    result = sysid_bench.transfer(
        sets,
        draws=draws,
        seed=seed,
        figure=figure,
        jobs=jobs,
        progress=partial(click.echo, err=True),
        **{key: names for key, names in given.items() if names},
    )
    print_result(result, as_json)
    return OK
