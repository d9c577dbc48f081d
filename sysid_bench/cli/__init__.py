"""Command line `sysid-bench`: parse options, call the functions of `sysid_bench`, print results.

Data goes to stdout, errors to stderr in one readable paragraph (a traceback only under --debug).
Functions of `sysid_bench` are imported when a command calls them, so that --help is quick.
"""

import os
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import click

from sysid_bench.cli import completion_commands as completion
from sysid_bench.cli import dataset_commands as datasets
from sysid_bench.cli import diagnose_commands as diagnosis
from sysid_bench.cli import gate_commands as gates
from sysid_bench.cli import identify_commands as identification
from sysid_bench.cli import init_commands as start
from sysid_bench.cli import list_commands as catalogue
from sysid_bench.cli import motion_commands as motions
from sysid_bench.cli import robot_commands as robots
from sysid_bench.cli import run_commands as results
from sysid_bench.cli import site_commands as sites
from sysid_bench.cli import suite_commands as suites
from sysid_bench.cli import survey_commands as surveys
from sysid_bench.cli import twin_commands as twins
from sysid_bench.cli import worker_execute as supervise

if TYPE_CHECKING:
    from sysid_bench.experiments.job_channel import JobChannel

THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Numbers of threads that a user may set; one by default. The matrices of a command are small, and
on a busy machine a second BLAS thread waits longer than it works: crosscheck ur5 took 4.3 s with
two and 2.7 s with one, and a search of excite a hundred times longer."""


class _Group(click.Group):
    """Commands in the order in which a user needs them."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        ctx.meta[supervise.ARGUMENTS] = tuple(args)
        return super().parse_args(ctx, args)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--debug", is_flag=True, help="Show tracebacks.")
@click.version_option(package_name="sysid-bench", prog_name="sysid-bench")
@click.pass_context
def main(ctx: click.Context, debug: bool) -> None:
    """Benchmark of robot dynamic identification, cross-validated with Pinocchio."""
    ctx.obj = debug
    for variable in THREADS:  # read once, when numpy is imported
        os.environ.setdefault(variable, "1")
    if "" not in sys.path:  # "my_lab:Thing" is found in the working folder, as with python -m
        sys.path.insert(0, "")


for _command in (
    robots.crosscheck, robots.frames, robots.basis, robots.lint, surveys.survey,
    identification.identify, diagnosis.diagnose, motions.excite, start.init,
    catalogue.help_, catalogue.list_, catalogue.show, datasets.fetch, twins.twin, twins.transfer,
    suites.plan, suites.run, suites.merge,
    gates.compare, gates.baseline, gates.gate,
    results.status, results.cells, results.cell, results.table, results.claims,
    results.limits, results.report, results.figure, sites.site, results.record, results.view,
    catalogue.check_plugin, catalogue.doctor, completion.completion,
):  # fmt: skip
    main.add_command(_command)


def execute(arguments: list[str], channel: "JobChannel") -> Mapping[str, Any]:
    """Execute a command line in this worker process; return its output and its exit code."""
    return supervise.execute(main, arguments, channel)
