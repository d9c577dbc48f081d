"""Commands that run third-party code: they execute in a worker process."""

import io
import signal
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, redirect_stdout
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
_EXECUTE: Final = "sysid_bench.commands.main:execute"
INTERRUPT_SECONDS: Final = 30.0
"""Time for an interrupted command to write what it has; a second interrupt ends it."""
OnValue = Callable[[int, float], None]

_ADVICE: Final[Mapping[str, str]] = {
    "timeout": "A call from Python has no time limit.",
    "failed": "(sysid-bench --debug shows where.)",
}
_PROGRESS_SECONDS: Final = 0.1
_channel: ContextVar["JobChannel | None"] = ContextVar("channel", default=None)


def supervise(
    plugins: Iterable[tuple[str, str | None]],
    progress: Callable[[], AbstractContextManager[OnValue]],
) -> int | None:
    """Execute the present command in a worker process where one of the `plugins` (kind, name) is
    third-party; return its exit code. Return None where it is to be executed here. `progress`
    yields the listener of a search, which hears of that of the worker.

    Raises WorkerError where it hangs, crashes, or needs too much memory.
    """
    named = [(kind, name) for kind, name in plugins if name]
    # In a worker already: it executes, or each would start another one.
    if _channel.get() or not named:
        return None
    from sysid_bench.experiments.spec import refuse_beside_seeds
    from sysid_bench.harness.work.worker_call import CallWorker, WorkerError
    from sysid_bench.plugin_names import is_third_party

    foreign = [name for kind, name in named if is_third_party(kind, name)]
    if not foreign:
        return None
    refuse_beside_seeds(str(foreign[0]))

    context = click.get_current_context()
    root = context.find_root()
    worker = CallWorker(SECONDS, interrupt_timeout=INTERRUPT_SECONDS)
    try:
        with worker, progress() as on_value:
            arguments, title = list(root.meta[ARGUMENTS]), f"sysid-bench {context.info_name}"

            def listen(values: Any) -> None:
                match values:
                    case [int(count), int(value) | float(value)]:
                        on_value(count, value)

            answer = worker.call(_EXECUTE, arguments, title, listen)
    except WorkerError as error:
        if root.obj:  # --debug
            click.echo(worker.output, err=True, nl=False)
            raise
        raise UsageError(f"{error} {_ADVICE.get(error.status, '')}".rstrip()) from error
    click.echo(worker.output, err=True, nl=False)
    # stdout as a whole, at the end: what failed has printed no half of a result.
    click.echo(answer["output"], nl=False)
    return int(answer["code"])


def execute(main: click.Command, arguments: list[str], channel: "JobChannel") -> Mapping[str, Any]:
    """Execute a command line of `main` in this process; return its output and its exit code."""
    _channel.set(channel)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # it comes from the caller alone
    output = io.StringIO()
    with redirect_stdout(output):
        code = main.main(arguments, prog_name="sysid-bench", standalone_mode=False)
    return {"output": output.getvalue(), "code": code or 0}


def worker_progress() -> OnValue | None:
    """Return a listener of a search that reports to the caller of this worker; None elsewhere."""
    channel = _channel.get()
    if channel is None:
        return None
    latest = -_PROGRESS_SECONDS

    def send(count: int, value: float) -> None:
        nonlocal latest
        now = time.monotonic()
        # A search may have thousands of evaluations a second, and each report is a line in a pipe.
        if now - latest >= _PROGRESS_SECONDS:
            latest = now
            channel.progress([count, value])

    return send
