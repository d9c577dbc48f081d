"""Commands that run third-party code: they execute in a worker process."""

import io
from collections.abc import Iterable, Mapping
from contextlib import redirect_stdout
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, Final

import click

from sysid_bench.errors import UsageError

if TYPE_CHECKING:
    from sysid_bench.experiments.job_channel import JobChannel

ARGUMENTS: Final = "arguments"
"""Key of the typed arguments in `Context.meta`."""
SECONDS: Final = 600.0
"""Time limit of a command that runs third-party code."""
_EXECUTE: Final = "sysid_bench.cli:execute"

_ADVICE: Final[Mapping[str, str]] = {
    "timeout": "A call from Python has no time limit.",
    "failed": "(sysid-bench --debug shows where.)",
}
_apart: ContextVar[bool] = ContextVar("apart", default=False)


def supervised(plugins: Iterable[tuple[str, str | None]]) -> int | None:
    """Execute the present command in a worker process where one of the `plugins` (kind, name) is
    third-party; return its exit code. Return None where it is to be executed here.

    Raises WorkerError where it hangs, crashes, or needs too much memory.
    """
    if _apart.get() or not any(name and _is_third_party(kind, name) for kind, name in plugins):
        return None
    from sysid_bench.harness.work.worker_call import CallWorker, WorkerError

    context = click.get_current_context()
    root = context.find_root()
    worker = CallWorker(SECONDS)
    try:
        with worker:
            arguments, title = list(root.meta[ARGUMENTS]), f"sysid-bench {context.info_name}"
            answer = worker.call(_EXECUTE, arguments, title)
    except WorkerError as error:
        if root.obj:  # --debug
            click.echo(worker.output, err=True, nl=False)
            raise
        raise UsageError(f"{error} {_ADVICE.get(error.status, '')}".rstrip()) from error
    click.echo(worker.output, err=True, nl=False)
    click.echo(answer["output"], nl=False)
    return int(answer["code"])


def execute(main: click.Command, arguments: list[str], channel: "JobChannel") -> Mapping[str, Any]:
    """Execute a command line of `main` in this process; return its output and its exit code."""
    _apart.set(True)
    output = io.StringIO()
    with redirect_stdout(output):
        code = main.main(arguments, prog_name="sysid-bench", standalone_mode=False)
    return {"output": output.getvalue(), "code": code or 0}


def _is_third_party(kind: str, name: str) -> bool:
    from sysid_bench.naming import is_third_party  # entry points: 30 ms that --help would wait for

    return is_third_party(kind, name)
