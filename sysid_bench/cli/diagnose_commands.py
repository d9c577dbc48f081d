"""Command that diagnoses recordings: diagnose."""

from pathlib import Path

import click

import sysid_bench
from sysid_bench.cli.options import (
    FAILED,
    OK,
    json_option,
    model_options,
    print_result,
    report_errors,
    robots_option,
)
from sysid_bench.commands.values import parse_names
from sysid_bench.commands.worker_execute import supervise

_file = click.Path(path_type=Path)


@click.command()
@click.argument("logs", nargs=-1, required=True, type=_file, metavar="LOG.toml...")
@click.option("--model", required=True, metavar="MODEL", help="Robot: a name or a model file.")
@click.option("--accept", metavar="rate,gain", help="Contradictions behind which the checks go on.")
@click.option("--html", type=_file, metavar="FILE.html", help="A page with figures.")
@click.option("--json-out", type=_file, help="The result as a file.")
@model_options("model")
@robots_option
@json_option
@report_errors
def diagnose(
    logs: tuple[Path, ...],
    model: str,
    accept: str | None,
    html: Path | None,
    json_out: Path | None,
    robots_dir: Path | None,
    as_json: bool,
) -> int:
    """Find what is wrong with recordings: signs, units, columns, gains, time, missing terms.

    Exit code 1 where a recording contradicts its model or physics.
    """
    from sysid_bench.experiments.third_party import reader_names

    code = supervise(reader_names(logs))
    if code is not None:
        return code
    result = sysid_bench.diagnose(
        sysid_bench.DiagnoseRequest(
            logs=logs,
            model=model,
            accept=tuple(parse_names(accept)),
            html=html,
            json_out=json_out,
            robots_dir=robots_dir,
        )
    )
    print_result(result, as_json)
    return OK if result.ok else FAILED
