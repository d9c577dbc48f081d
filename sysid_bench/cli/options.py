"""Options, errors, exit codes and printing of all commands."""

import json
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from sysid_bench.canonical_json import plain
from sysid_bench.cli.terminal import terminal_output
from sysid_bench.errors import SysidBenchError
from sysid_bench.harness.work.supervise import default_interrupt, on_interrupt, without_interrupt
from sysid_bench.models.model_settings import with_settings

if TYPE_CHECKING:
    from sysid_bench import Result

OK, FAILED, USAGE, BAD_ANSWER, NOTHING, INTERRUPTED = 0, 1, 2, 3, 4, 130
_INTERRUPTION = "Interrupted; the same command starts again, and a run goes on where it was."

Command = Callable[..., Any]

robots_option = click.option(
    "--robots", "robots_dir", type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder of your own robots, <name>/robot.toml.",
)  # fmt: skip


def log_options(word: str, words: str) -> Callable[[Command], Command]:
    """`--log` or `--test`: descriptions of recordings, any number of them."""
    return click.option(
        f"--{word}",
        f"{word}s",
        multiple=True,
        type=click.Path(path_type=Path),
        metavar="LOG.toml",
        help=words,
    )


class _Name(click.ParamType[str]):
    """A name of the registry of plug-ins, or one of the user's own."""

    name = "text"

    def __init__(self, kind: str) -> None:
        self.kind = kind

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        names = _known(self.kind)
        return [CompletionItem(name) for name in names if name.startswith(incomplete)]


def _known(kind: str) -> Iterable[str]:
    from sysid_bench.plugin_names import known  # entry points: 30 ms that --help would wait for

    return known(kind)


class _TaskOption(click.Option):
    """Lists the registered tasks in its help, only when it is printed."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        self.help = f"{', '.join(_known('task'))}; or your own, file:mine.py:Class."
        return super().get_help_record(ctx)


task_option = click.option(
    "--task", default="robot", show_default=True, type=_Name("task"), cls=_TaskOption
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
free_base_option = click.option(
    "--free-base", is_flag=True, default=None, help="Let the root body float."
)
assets_option = click.option(
    "--assets",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    metavar="DIR",
    help="Folder that MJCF files may read from; default: each file's own.",
)
tool_option = click.option(
    "--tool",
    metavar="BODY|SITE",
    help="Where payloads are mounted; default: the robot's, or the end of the longest chain.",
)
sensor_option = click.option(
    "--sensor",
    metavar="NAME|PLACE",
    help="Force/torque sensor: a name of the manifest, or a fixed joint, site or body to cut at.",
)
terms_option = click.option(
    "--terms", help="Joint terms that are also unknown: viscous,coulomb,j1.k,...; or none."
)


class OptionsRecord:
    """Values of a group of options, as attributes.

    A plain class: --help would wait 5 ms for as many named tuples, 40 ms for dataclasses.
    """

    def __init__(self, **values: Any) -> None:
        vars(self).update(values)


def model_options(argument: str, free_base: bool = True) -> Callable[[Command], Command]:
    """Decorator that adds --assets, --tool and --free-base, and passes them as settings of the
    models (a source, or several) in an argument; without `free_base` the command has its own."""
    options = [assets_option, tool_option, *([free_base_option] if free_base else [])]
    keys = ("assets", "tool", *(["free_base"] if free_base else []))

    def decorate(command: Command) -> Command:
        @wraps(command)
        def with_models(*args: Any, **values: Any) -> Any:
            settings = {key: values.pop(key) for key in keys}
            given = values[argument]
            if isinstance(given, tuple):
                values[argument] = tuple(with_settings(source, settings) for source in given)
            elif given is not None:
                values[argument] = with_settings(given, settings)
            elif any(value is not None for value in settings.values()):
                words = ", ".join(f"--{key.replace('_', '-')}" for key in keys if settings[key])
                raise click.UsageError(f"{words}: of a model alone; name its file.")
            return command(*args, **values)

        decorated: Command = with_models
        for option in reversed(options):
            decorated = option(decorated)
        return decorated

    return decorate


def group_options(
    name: str, record: type[OptionsRecord], options: Sequence[Callable[[Command], Command]]
) -> Callable[[Command], Command]:
    """Decorator that passes the values of several options as one record, the argument `name`."""
    fields = tuple(record.__annotations__)

    def decorate(command: Command) -> Command:
        @wraps(command)
        def gathered(*args: Any, **values: Any) -> Any:
            parts = record(**{field: values.pop(field) for field in fields})
            return command(*args, **values, **{name: parts})

        decorated: Command = gathered
        for option in reversed(options):
            decorated = option(decorated)
        return decorated

    return decorate


def report_errors(function: Callable[..., int]) -> Callable[..., None]:
    """Run a command and exit with its code; our errors become one paragraph and code 2."""

    @wraps(function)
    def guarded(*args: Any, **options: Any) -> None:
        context = click.get_current_context()
        with on_interrupt(default_interrupt):
            try:
                code = _exit_code(partial(function, *args, **options), context)
            except KeyboardInterrupt:  # a second one, while the first was reported
                without_interrupt()
                code = INTERRUPTED
        context.exit(code)

    return guarded


def _exit_code(command: Callable[[], int], context: click.Context) -> int:
    """Exit code of a command; an error is printed. An interrupted one ignores further signals."""
    try:
        code = command()
    except KeyboardInterrupt:
        without_interrupt()
        click.echo(_INTERRUPTION, err=True)
        code = INTERRUPTED
    except BrokenPipeError:  # the reader of our output has closed it, as `head` does
        sys.stderr.close()
        code = OK
    except (SysidBenchError, OSError) as error:
        if context.find_root().obj:  # --debug
            raise
        click.echo(f"sysid-bench: {_paragraph(error)}", err=True)
        code = USAGE
    if code == INTERRUPTED:
        without_interrupt()
    return code


def _paragraph(error: SysidBenchError | OSError) -> str:
    """Message of an error; for a file that cannot be written, with advice."""
    if isinstance(error, SysidBenchError):
        return str(error)
    file = error.filename or "a file"
    return (
        f"{file}: {error.strerror or error}; choose a folder that can be written (-o), on a disk "
        "with free space."
    )


def print_json(value: Any) -> None:
    """Print a value as JSON; NaN and infinities become null."""
    click.echo(json.dumps(plain(value), indent=2))


def print_result(result: "Result", as_json: bool) -> None:
    """Print a result as JSON, or its summary."""
    if as_json:
        print_json(result)
    else:
        click.echo(terminal_output(result.summary()))
