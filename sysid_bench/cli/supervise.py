"""Commands that run third-party code: they execute in a worker process."""

from collections.abc import Iterable, Mapping
from contextvars import ContextVar
from typing import Final

import click

from sysid_bench.errors import UsageError

ARGUMENTS: Final = "arguments"
"""Key of the typed arguments in `Context.meta`."""
SECONDS: Final = 600.0
"""Time limit of a command that runs third-party code."""

_EXECUTE: Final = "sysid_bench.cli.worker_command:execute"
"""Function that the worker calls; that module imports all commands."""

_ADVICE: Final[Mapping[str, str]] = {
    "timeout": "A call from Python has no time limit.",
    "failed": "(sysid-bench --debug shows where.)",
}
IN_WORKER: Final = ContextVar("in_worker", default=False)
"""True in the worker process of a command."""


def supervised(plugins: Iterable[tuple[str, str | None]]) -> int | None:
    """Execute the present command in a worker process where one of the `plugins` (kind, name) is
    third-party; return its exit code. Return None where it is to be executed here.

    Raises WorkerError where it hangs, crashes, or needs too much memory.
    """
    if IN_WORKER.get() or not any(name and _is_third_party(kind, name) for kind, name in plugins):
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


def _is_third_party(kind: str, name: str) -> bool:
    from sysid_bench.naming import is_third_party  # entry points: 30 ms that --help would wait for

    return is_third_party(kind, name)
