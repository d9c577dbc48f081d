"""The command `sysid-bench`: words in, sysid_bench.verbs called, results printed.

Data goes to stdout, errors to stderr in one readable paragraph (a traceback only under --debug).
Only click is imported here; each verb imports what it needs when it is called.
"""

import os
import sys
from typing import Final

import click

from sysid_bench.cli import catalogue_commands as catalogue
from sysid_bench.cli import init_commands as start
from sysid_bench.cli import motion_commands as motions
from sysid_bench.cli import robot_commands as robots
from sysid_bench.cli import run_commands as results
from sysid_bench.cli import suite_commands as suites

THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""What a user may set; else one. The matrices of a verb are small, and on a busy machine a second
BLAS thread waits longer than it works: crosscheck ur5 took 4.3 s with two and 2.7 s with one."""


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
    for variable in THREADS:  # read once, when numpy is imported
        os.environ.setdefault(variable, "1")
    if "" not in sys.path:  # "my_lab:Thing" means the folder one stands in, as with python -m
        sys.path.insert(0, "")


for _verb in (
    robots.crosscheck, robots.basis, robots.identify, motions.excite, start.init,
    catalogue.list_, catalogue.show,
    suites.plan, suites.run,
    results.status, results.cell, results.table, results.report, results.record, results.view,
    catalogue.check_plugin, catalogue.doctor,
):  # fmt: skip
    main.add_command(_verb)
