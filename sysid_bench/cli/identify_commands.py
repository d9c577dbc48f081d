"""Command that identifies one robot: identify."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import click

import sysid_bench
from sysid_bench.cli.options import (
    BAD_ANSWER,
    OK,
    OptionsRecord,
    free_base_option,
    group_options,
    json_option,
    log_options,
    model_options,
    print_result,
    report_errors,
    robots_option,
    sensor_option,
    task_option,
    terms_option,
)
from sysid_bench.commands.progress import read_progress
from sysid_bench.commands.result import Result
from sysid_bench.commands.values import (
    parse_contact,
    parse_names,
    parse_noise,
    parse_payload,
    parse_pipeline,
    parse_prior,
    parse_terms,
    pipeline_name,
)
from sysid_bench.commands.worker_execute import supervise
from sysid_bench.errors import UsageError, WriteError


class _Source(OptionsRecord):
    simulate: bool
    logs: tuple[Path, ...]
    tests: tuple[Path, ...]


class _LogOptions(OptionsRecord):
    candidates: str | None
    position_given: bool
    shared: str | None
    also: str | None
    figure: Path | None
    accept: str | None
    filter_text: str | None
    derivatives: str | None
    moving: float


class _Unknowns(OptionsRecord):
    task: str
    sensor: str | None
    payload: str
    terms: str | None
    free_base: bool | None


class _Method(OptionsRecord):
    prior: str | None
    feasible: str | None
    estimator: str | None
    noise: str | None
    contacts: str | None
    complete: str | None
    pipeline: str | None
    seed: int


class _Output(OptionsRecord):
    model_out: Path | None
    json_out: Path | None
    as_json: bool


_source_options = group_options(
    "source",
    _Source,
    [
        click.option("--simulate", is_flag=True, help="Data from the robot's own simulation."),
        log_options("log", "Data from a recording; several are used together."),
        log_options("test", "Recording to judge on."),
    ],
)

_log_options = group_options(
    "of_logs",
    _LogOptions,
    [
        click.option(
            "--choose",
            "candidates",
            metavar="play,offset,motor.play,...",
            help="Logs: joint terms and features (play, playq, tanh, poly), also of motors "
            "(motor.play, motor.coulomb), that cross-validation in the training data may add.",
        ),
        click.option(
            "--position-given",
            is_flag=True,
            help="Logs, task payload: only its mass is unknown, centre of mass as the log states.",
        ),
        click.option(
            "--share",
            "shared",
            metavar="hip,knee,...",
            help="Logs, task actuators: joints whose names hold the same word, or match the same "
            "pattern ('*_knee'), have equal armature and friction.",
        ),
        click.option(
            "--also",
            metavar="gain,bias,load",
            help="Logs, task actuators: further unknowns. Torque over that of the stated gains, "
            "position less that of the encoder, friction over the torque of the links.",
        ),
        click.option(
            "--figure",
            type=click.Path(path_type=Path),
            metavar="FILE.pdf|svg",
            help="Logs: measured and predicted torque and their difference, joint by joint.",
        ),
        click.option(
            "--accept", metavar="rate,units", help="Contradictions in logs that may pass."
        ),
        click.option(
            "--filter",
            "filter_text",
            metavar="TEXT",
            help="Logs: 'butter 4 10 Hz', ...; of tests, and of the pipeline plain.",
        ),
        click.option(
            "--derivatives",
            type=click.Choice(["from q", "from v"]),
            help="Logs: signal that rates and accelerations come from.",
        ),
        click.option(
            "--moving",
            default=0.0,
            show_default=True,
            type=click.FloatRange(min=0.0),
            help="Logs: leave out samples of a joint slower than this (rad/s, m/s).",
        ),
    ],
)

_unknown_options = group_options(
    "unknowns",
    _Unknowns,
    [
        task_option,
        sensor_option,
        click.option(
            "--payload",
            default="none",
            show_default=True,
            help="Load mounted at the tool: a name, or a table '{ mass = 1.2, com = [0, 0, 0.05], "
            'inertia = "sphere 0.05 m" }\'.',
        ),
        terms_option,
        free_base_option,
    ],
)

_method_options = group_options(
    "method",
    _Method,
    [
        click.option(
            "--estimator",
            metavar="NAME",
            help="Default: ols; wls with logs and for wrench; min-norm for terminal.",
        ),
        click.option(
            "--prior",
            metavar="model|none|TABLE",
            help="Logs: the model file's inertias where they are plausible (default), none, or "
            'their spreads, \'{ mass = "10 %", com = "20 mm" }\'.',
        ),
        click.option(
            "--feasible",
            type=click.Choice(["terms", "bodies"]),
            help="Logs, feasible fits: friction and rotor inertia are not negative either (terms, "
            "the default), or only the bodies are constrained.",
        ),
        click.option(
            "--noise", metavar="tau=0.5 %,q=1e-4 rad", help="Sensor noise; default: none."
        ),
        click.option(
            "--contacts",
            metavar="detect|'10 s to 25 s'",
            help="Samples left out: detected behind a sensor, or in these periods.",
        ),
        click.option(
            "--complete",
            type=click.Choice(["entropic", "euclidean", "pullback"]),
            help="Whole, feasible bodies nearest to the prior in this distance.",
        ),
        click.option(
            "--pipeline",
            metavar="NAME",
            help="Signals and rows of the fit: plain, raw, parallel, or a table "
            '\'{ use = "parallel", cutoff = "6 Hz" }\'. Default: parallel; plain with --filter and '
            "where positions are exact.",
        ),
        click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0)),
    ],
)

_output_options = group_options(
    "output",
    _Output,
    [
        click.option(
            "--model-out",
            type=click.Path(path_type=Path),
            help="The model file again, with identified values.",
        ),
        click.option("--json-out", type=click.Path(path_type=Path), help="The result as a file."),
        json_option,
    ],
)


def _identification(
    model: str,
    source: _Source,
    of_logs: _LogOptions,
    unknowns: _Unknowns,
    method: _Method,
    output: _Output,
) -> Callable[..., Result]:
    """`sysid_bench.identify` with the options as its arguments."""
    return partial(
        sysid_bench.identify,
        model,
        task=unknowns.task,
        payload=parse_payload(unknowns.payload),
        terms=parse_terms(unknowns.terms),
        estimator=method.estimator,
        noise=parse_noise(method.noise),
        log=source.logs,
        test=source.tests,
        simulate=source.simulate,
        model_out=output.model_out,
        json_out=output.json_out,
        seed=method.seed,
        sensor=unknowns.sensor,
        free_base=unknowns.free_base,
        contacts=parse_contact(method.contacts),
        complete=method.complete,
        filter=of_logs.filter_text,
        derivatives=of_logs.derivatives,
        moving=of_logs.moving,
        choose=parse_names(of_logs.candidates),
        position_given=of_logs.position_given,
        share=parse_names(of_logs.shared),
        also=parse_names(of_logs.also),
        accept=parse_names(of_logs.accept),
        figure=of_logs.figure,
        pipeline=parse_pipeline(method.pipeline),
        prior=parse_prior(method.prior),
        feasible=method.feasible,
    )


def _print_of(identification: Callable[[], Result], as_json: bool) -> int:
    """Print a result, also one whose files could not be written; return the exit code."""
    try:
        result = identification()
    except WriteError as error:
        if isinstance(error.result, Result):
            print_result(error.result, as_json)
        raise
    print_result(result, as_json)
    failure = result.get("failure")
    if not failure:
        return OK
    click.echo(f"sysid-bench: {failure}.", err=True)
    return BAD_ANSWER


@click.command()
@click.argument("model", metavar="MODEL", required=False)
@_source_options
@_log_options
@_unknown_options
@_method_options
@_output_options
@model_options("model", free_base=False)
@robots_option
@report_errors
@read_progress()
def identify(
    model: str | None,
    source: _Source,
    of_logs: _LogOptions,
    unknowns: _Unknowns,
    method: _Method,
    output: _Output,
    robots_dir: Path | None,
) -> int:
    """Identify one robot: excite and simulate it, or read recordings; estimate; export.

    Exit code 3 where the answer errs more than zero torque on its test; it is written all the same.
    """
    robot = _given(model)
    code = supervise(_plugins(robot, robots_dir, source, of_logs, unknowns, method))
    if code is not None:
        return code
    call = _identification(robot, source, of_logs, unknowns, method, output)
    return _print_of(partial(call, robots_dir=robots_dir), output.as_json)


def _plugins(
    model: str,
    robots_dir: Path | None,
    source: _Source,
    of_logs: _LogOptions,
    unknowns: _Unknowns,
    method: _Method,
) -> Iterator[tuple[str, str | None]]:
    """Yield (kind, name) of the plug-ins in use."""
    yield from (("estimator", method.estimator), ("task", unknowns.task))
    yield "pipeline", pipeline_name(parse_pipeline(method.pipeline))
    if source.logs:
        from sysid_bench.experiments import third_party

        yield from third_party.term_names(
            (*parse_names(of_logs.candidates), *parse_names(unknowns.terms))
        )
        yield from third_party.manifest_terms(model, robots_dir)
        yield from third_party.reader_names((*source.logs, *source.tests))


def _given(model: str | None) -> str:
    """Robot to identify; raise UsageError with an example where none is given."""
    if model is None:
        raise UsageError(
            "Which robot? Name it or its model file, then its data: sysid-bench identify ur5 "
            "--log run.toml --test other.toml, or: sysid-bench identify ur5 --simulate."
        )
    return model
