"""Samples from a stream of lines: a file that grows, standard input, a socket."""

import json
import math
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Final

from sysid_bench.errors import UsageError

IDLE: Final = 5.0
"""s without a new line after which a file has ended."""

LONGEST: Final = 1 << 16
"""Most bytes of a line: what comes without end must not fill the memory."""

Sample = tuple[float, list[float], list[float]]
"""t (s), q (joints,) and tau (joints,)."""


def stream_samples(source: str, names: Sequence[str]) -> Iterator[Sample]:
    """Yield the samples of a stream; raises UsageError for a line that is not one, naming it.

    A line is JSON, {"t": s, "q": [...], "tau": [...]} in the order of the joints' `names`, or CSV
    below a header with t, NAME.q and NAME.tau, as `excite` writes it; nothing else is read.
    """
    joints = len(names)
    columns: list[int] | None = None  # of CSV
    before = -math.inf
    for number, line in enumerate(_lines(source), start=1):
        where = f"Line {number} of {source}"
        if len(line) >= LONGEST:
            raise UsageError(f"{where} has {LONGEST} bytes or more: it is not a sample.")
        if not line.endswith(b"\n"):
            raise UsageError(f"{where} is cut: the stream ended within it.")
        text = line.decode("utf-8", "replace").strip()
        if number == 1 and not text.startswith("{"):
            header = [word.strip() for word in text.split(",")]
            wanted = ["t", *(f"{name}.{x}" for x in ("q", "tau") for name in names)]
            missing = [name for name in wanted if name not in header]
            if missing:
                raise UsageError(f"{where} has no column {', '.join(missing)}; it has: {text}.")
            columns = [header.index(name) for name in wanted]
            continue
        try:
            if columns is None:
                entry = json.loads(text)
                numbers = [float(x) for x in (entry["t"], *entry["q"], *entry["tau"])]
            else:
                words = text.split(",")
                numbers = [float(words[k]) for k in columns]
        except (ValueError, LookupError, TypeError) as error:
            raise UsageError(
                f"{where} is not a sample: {text[:60]!r} ({type(error).__name__}: {error}). Write "
                '{"t": s, "q": [...], "tau": [...]}, or CSV below a header.'
            ) from error
        if len(numbers) != 2 * joints + 1:
            raise UsageError(
                f"{where} has {len(numbers)} numbers, not t and {joints} of q and tau."
            )
        if not all(map(math.isfinite, numbers)):
            raise UsageError(f"{where} has a value that is not finite: {text[:60]!r}.")
        if numbers[0] <= before:
            raise UsageError(f"{where}: the clock falls, from {before:.6g} to {numbers[0]:.6g} s.")
        before = numbers[0]
        yield before, numbers[1 : joints + 1], numbers[joints + 1 :]


def _lines(source: str) -> Iterator[bytes]:
    if source == "-":
        yield from iter(lambda: sys.stdin.buffer.readline(LONGEST), b"")
    elif source.startswith("tcp://"):
        host, _, port = source.removeprefix("tcp://").rpartition(":")
        try:
            with socket.create_connection((host, int(port))) as connection:
                received = connection.makefile("rb")
                yield from iter(lambda: received.readline(LONGEST), b"")
        except (OSError, ValueError) as error:
            raise UsageError(f"{source} cannot be read: {error}; give tcp://HOST:PORT.") from error
    elif source.startswith("ros2:"):
        raise UsageError(f"{source}: topics are not read; write them as lines to - or a socket.")
    else:
        try:
            with Path(source).open("rb") as file:
                yield from _growing(file)
        except OSError as error:
            raise UsageError(f"{source} cannot be read: {error.strerror}.") from error


def _growing(file: IO[bytes]) -> Iterator[bytes]:
    """Lines of a file, also those that are written meanwhile."""
    part, waited = b"", 0.0
    while waited < IDLE:  # of reading alone: what reads may be slow
        line = file.readline(LONGEST)
        if not line:
            time.sleep(0.01)
            waited += 0.01
            continue
        part, waited = part + line, 0.0
        if part.endswith(b"\n") or len(part) >= LONGEST:
            yield part
            part = b""
    if part:
        yield part
