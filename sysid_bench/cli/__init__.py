"""The command `sysid-bench`: words in, sysid_bench.verbs called, results printed.

Data goes to stdout, errors to stderr in one readable paragraph (a traceback only under --debug).
Only click is imported here; each verb imports what it needs when it is called.
"""

import sys

import click

from sysid_bench.cli import catalogue, motions, results, robots, suites


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


for _verb in (
    robots.crosscheck, robots.basis, robots.identify, motions.excite,
    catalogue.list_, catalogue.show,
    suites.plan, suites.run,
    results.status, results.cell, results.table, results.report, results.record, results.view,
    catalogue.doctor,
):  # fmt: skip
    main.add_command(_verb)
