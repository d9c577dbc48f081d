"""Commands that run third-party code: they execute in a worker process."""

import io
from collections.abc import Iterable, Mapping
from contextlib import redirect_stdout
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, Final

import click

if TYPE_CHECKING:
    from sysid_bench.experiments.job_channel import JobChannel

ARGUMENTS: Final = "arguments"
"""Key of the typed arguments in `Context.meta`."""
SECONDS: Final = 600.0
"""Time limit of a command that runs third-party code."""

_apart: ContextVar[bool] = ContextVar("apart", default=False)


def supervised(plugins: Iterable[tuple[str, str | None]]) -> int | None:
    """Execute the present command in a worker process where one of the `plugins` (kind, name) is
    third-party; return its exit code. Return None where it is to be executed here.

    Raises WorkerError where it hangs, crashes, or needs too much memory.
    """
    if _apart.get() or not any(name and _is_third_party(kind, name) for kind, name in plugins):
        return None
    from sysid_bench.harness.work.worker_call import CallWorker, WorkerError

    root = click.get_current_context().find_root()
    worker = CallWorker(SECONDS)
    try:
        with worker:
            title = f"sysid-bench {click.get_current_context().command.name}"
            answer = worker.call(f"{__name__}:execute", list(root.meta[ARGUMENTS]), title)
    except WorkerError as error:
        if error.status == "timeout":
            error.args = (f"{error} A call from Python has no time limit.",)
        raise
    finally:
        click.echo(worker.output, err=True, nl=False)
    click.echo(answer["output"], nl=False)
    return int(answer["code"])


def execute(arguments: list[str], channel: "JobChannel") -> Mapping[str, Any]:
    """Execute a command line in this process; return its output and its exit code."""
    from sysid_bench.cli import main

    _apart.set(True)
    output = io.StringIO()
    with redirect_stdout(output):
        code = main.main(arguments, prog_name="sysid-bench", standalone_mode=False)
    return {"output": output.getvalue(), "code": code or 0}


def _is_third_party(kind: str, name: str) -> bool:
    from sysid_bench.naming import is_third_party  # entry points: 30 ms that --help would wait for

    return is_third_party(kind, name)
