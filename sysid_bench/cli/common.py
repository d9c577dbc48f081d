"""What every verb shares: its options, its errors, its exit codes."""

import json
import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from sysid_bench import naming
from sysid_bench.errors import SysidBenchError

OK, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130

robots_option = click.option(
    "--robots", "robots_dir", type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="A folder of your own robots, <name>/robot.toml.",
)  # fmt: skip


class _Name(click.ParamType):
    """A name of the registry of plug-ins, or one of the user's own."""

    name = "text"

    def __init__(self, kind: str) -> None:
        self.kind = kind

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        names = naming.known(self.kind)
        return [CompletionItem(name) for name in names if name.startswith(incomplete)]


class _TaskOption(click.Option):
    """Lists the registered tasks in its help, once somebody asks for it."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        self.help = f"{', '.join(naming.known('task'))}; or your own, file:mine.py:Class."
        return super().get_help_record(ctx)


task_option = click.option(
    "--task", default="robot", show_default=True, type=_Name("task"), cls=_TaskOption
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


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


def print_json(value: Any) -> None:
    from sysid_bench.canonical_json import plain

    click.echo(json.dumps(plain(value), indent=2))
