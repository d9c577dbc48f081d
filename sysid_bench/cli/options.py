"""Options, errors, exit codes and printing of all commands."""

from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from sysid_bench.commands.request import BAD_ANSWER, FAILED, INTERRUPTED, NOTHING, OK, USAGE
from sysid_bench.commands.shell import report_errors
from sysid_bench.commands.terminal import print_json, print_result
from sysid_bench.models.sources import with_settings

__all__ = [
    "BAD_ANSWER",
    "FAILED",
    "INTERRUPTED",
    "NOTHING",
    "OK",
    "USAGE",
    "print_json",
    "print_result",
]
__all__ += ["report_errors"]

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
