"""Functions that a worker calls: (argument, channel) -> JSON."""

import os
import signal
import time
from typing import Any

from sysid_bench.errors import UsageError


def double(argument: Any, channel: Any) -> Any:
    print("doubled")
    return 2 * argument


def process(argument: Any, channel: Any) -> int:
    return os.getpid()


def hang(argument: Any, channel: Any) -> None:
    time.sleep(1e6)


def abort(argument: Any, channel: Any) -> None:
    os.abort()


def leave(argument: Any, channel: Any) -> None:
    os._exit(0)


def end_by_kill(argument: Any, channel: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def refuse(argument: Any, channel: Any) -> None:
    raise UsageError("not this one")


def interrupt(argument: Any, channel: Any) -> None:
    raise KeyboardInterrupt


def answer_object(argument: Any, channel: Any) -> object:
    return object()


def allocate(argument: Any, channel: Any) -> int:
    return len(bytearray(8 << 30))


def fork(argument: Any, channel: Any) -> int:
    os.fork()
    return 1
