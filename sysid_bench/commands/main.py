"""Command line `sysid-bench`: data goes to stdout, errors to stderr in one readable paragraph (a
traceback only under --debug). A verb is imported when it is asked for, so that --help is quick."""

import os
import sys
from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

import click
from click.shell_completion import CompletionItem

from sysid_bench.commands import worker_execute
from sysid_bench.commands.request import USAGE
from sysid_bench.commands.shell import GRAVITY, click_command
from sysid_bench.commands.table import FIRST, GROUPS, Verb, all_verbs, find_verb
from sysid_bench.errors import unknown_name

if TYPE_CHECKING:
    from sysid_bench.experiments.job_channel import JobChannel

THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Numbers of threads that a user may set; one by default. The matrices of a command are small, and
on a busy machine a second BLAS thread waits longer than it works: crosscheck ur5 took 4.3 s with
two and 2.7 s with one, and a search of excite a hundred times longer."""


# click starts in 0.09 s (typer: 0.3 s) and names the nearest option, which argparse does not.
class Verbs(click.Group):
    """Verbs of the table whose names begin with the words of `prefix`."""

    def __init__(self, *args: Any, prefix: str = "", **words: Any) -> None:
        super().__init__(*args, **words)
        self.prefix = prefix

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if not self.prefix:
            ctx.meta[worker_execute.ARGUMENTS] = tuple(args)
        return super().parse_args(ctx, args)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self._verbs())

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        name = self.prefix + cmd_name
        verb = find_verb(name)
        if verb is None:
            return None
        if not verb.target:
            return Verbs(cmd_name, prefix=f"{name} ", help=verb.sentence)
        module, _, attribute = verb.target.partition(":")
        try:
            # Here, and not at the start: all verbs together import for seconds.
            made = getattr(import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            raise click.UsageError(f"The verb {name!r} cannot be imported: {error}.") from error
        return click_command(made, cmd_name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0][:1].isalpha() and self.get_command(ctx, args[0]) is None:
            advice = f"All: {ctx.command_path} --help."
            error = unknown_name("verb", args[0], self._verbs(), advice)
            click.echo(f"sysid-bench: {error}", err=True)
            ctx.exit(USAGE)
        return super().resolve_command(ctx, args)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        verbs = [
            CompletionItem(name, help=verb.sentence)
            for name, verb in self._verbs().items()
            if name.startswith(incomplete)
        ]
        return [*verbs, *click.Command.shell_complete(self, ctx, incomplete)]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        verbs = self._verbs()
        width = max(map(len, verbs), default=0)
        for key, title in GROUPS.items():
            names = [name for name in verbs if verbs[name].group == key]
            if names:
                with formatter.section("Verbs" if self.prefix else title):
                    rows = [(f"{name:<{width}}", verbs[name].sentence) for name in names]
                    formatter.write_dl(rows, col_max=width)

    def format_help_text(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        super().format_help_text(ctx, formatter)
        if not self.prefix:
            formatter.write_paragraph()
            with formatter.indentation():
                formatter.write_text(f"Begin with {', '.join(FIRST)}.")

    def _verbs(self) -> dict[str, Verb]:
        """Verbs one word below the prefix, by that word."""
        found = all_verbs().items()
        inner = {k.removeprefix(self.prefix): v for k, v in found if k.startswith(self.prefix)}
        return {name: verb for name, verb in inner.items() if " " not in name}


@click.group(cls=Verbs, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--debug", is_flag=True, help="Show tracebacks.")
@click.option(
    "--confidence",
    type=click.FloatRange(0, 1, True, True),
    metavar="0.95",
    help="Level of all intervals, in place of that of a suite; default: 0.95.",
)
@click.option(
    "--gravity",
    metavar="X,Y,Z",
    help="Gravity in the base frame (m/s^2) of the models that the verb is given.",
)
@click.version_option(package_name="sysid-bench", prog_name="sysid-bench")
@click.pass_context
def main(ctx: click.Context, debug: bool, confidence: float | None, gravity: str | None) -> None:
    """Benchmark of robot dynamic identification, cross-validated with Pinocchio."""
    ctx.obj = debug
    ctx.meta[GRAVITY] = gravity
    if confidence is not None:
        from sysid_bench.evaluation.intervals import at_level  # numpy, which --help does not need

        ctx.with_resource(at_level(confidence))
    for variable in THREADS:  # read once, when numpy is imported
        os.environ.setdefault(variable, "1")
    if "" not in sys.path:  # "my_lab:Thing" is found in the working folder
        # Behind all others: a file numpy.py there, as of a submission, is not NumPy.
        sys.path.append("")


def execute(arguments: list[str], channel: "JobChannel") -> Mapping[str, Any]:
    """Execute a command line in this worker process; return its output and its exit code."""
    return worker_execute.execute(main, arguments, channel)
