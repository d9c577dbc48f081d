"""Mutation fuzzer of everything that is read: each input in a process with limits.

python -m tests.faults.fuzz [--seed 0] [--count 100] [--kind urdf] [--show refused]
"""

import argparse
import contextlib
import json
import math
import os
import random
import resource
import select
import shutil
import signal
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

from sysid_bench.errors import SysidBenchError
from tests.faults.fuzz_kind import Kind
from tests.faults.fuzz_kinds import KINDS
from tests.faults.mutations import mutated, replaced

SECONDS: Final = 30
"""CPU seconds of one input; a loaded machine gives them late, but gives them."""

MEMORY: Final = 1_000 * 2**20
"""Bytes that reading a file of some kilobytes may add."""

LONGEST: Final = 4_000
"""Letters of a message."""

HARMLESS: Final = ("accepted", "refused")
_REPLACED: Final = 0.06
"""Share of inputs in which something else than a file stands in its place."""


@dataclass(frozen=True)
class Verdict:
    """Outcome of one input: accepted, refused, or traceback, crash, hang, memory, message."""

    kind: str
    case: int
    outcome: str
    text: str
    seconds: float


def fuzz(kind: Kind, cases: range, seed: int) -> Iterator[Verdict]:
    """Yield a verdict for each mutated input of a kind; equal seeds give equal inputs."""
    sound = Path(_made(kind.make).name) / "sound"
    verdict = isolated(lambda: kind.read(_copied(sound)))
    assert verdict[0] == "accepted", f"{kind.name}: the sound input gives {verdict}"
    if kind.warm:
        kind.read(_copied(sound))
    for case in cases:
        folder = _copied(sound)
        damage(kind, folder, random.Random(f"{seed} {kind.name} {case}"))
        start = time.monotonic()
        outcome, text = isolated(lambda: kind.read(folder))  # noqa: B023 - called at once
        yield Verdict(kind.name, case, outcome, text, time.monotonic() - start)


@cache
def _made(make: Callable[[Path], object]) -> "tempfile.TemporaryDirectory[str]":
    """Make sound files, once for all kinds that damage them."""
    temporary = tempfile.TemporaryDirectory()
    sound = Path(temporary.name) / "sound"
    sound.mkdir()
    made = isolated(lambda: make(sound))
    assert made[0] == "accepted", made
    return temporary


def _copied(sound: Path) -> Path:
    """Return a fresh copy beside the sound files, always at the same path."""
    folder = sound.with_name("input")
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(sound, folder)
    return folder


def damage(kind: Kind, folder: Path, rng: random.Random) -> None:
    """Mutate one of the files of a kind."""
    path = rng.choice(sorted(p for pattern in kind.damaged for p in folder.glob(pattern)))
    if kind.places and rng.random() < _REPLACED:
        replaced(path, rng)
    else:
        path.write_bytes(mutated(path.read_bytes(), rng))


def isolated(work: Callable[[], object], seconds: int = SECONDS) -> tuple[str, str]:
    """Return outcome and message of work done in a process with limits of CPU time and memory."""
    source, sink = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(source)
        _settle(work, sink, seconds)
    os.close(sink)
    answer = _answer(source)
    os.close(source)
    if answer is None:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if answer is None or (os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU):
        return "hang", ""
    if not answer:
        return "crash", f"status {status}"
    outcome, text = json.loads(answer)
    return outcome, text


def _answer(source: int) -> bytes | None:
    """Return what a process writes before it ends, None where it takes for ever."""
    parts: list[bytes] = []
    until = time.monotonic() + 4 * SECONDS
    while select.select([source], [], [], max(until - time.monotonic(), 0))[0]:
        part = os.read(source, 1 << 16)
        if not part:
            return b"".join(parts)
        parts.append(part)
    return None


def _settle(work: Callable[[], object], sink: int, seconds: int) -> None:
    """Do the work in this process and end it."""
    used_seconds = math.ceil(time.process_time())
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (used_seconds + seconds, used_seconds + seconds + 5))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    quiet = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(quiet, descriptor)
    verdict = _verdict(work)
    with contextlib.suppress(BrokenPipeError):
        os.write(sink, json.dumps(verdict).encode()[: 1 << 16])
    os._exit(0)


def _verdict(work: Callable[[], object]) -> tuple[str, str]:
    try:
        work()
    except SysidBenchError as error:
        return _refusal(str(error))
    except MemoryError:
        return "memory", traceback.format_exc()[-900:]
    except BaseException:
        return "traceback", traceback.format_exc()[-900:]
    return "accepted", ""


def _refusal(text: str) -> tuple[str, str]:
    if "MemoryError" in text or "Unable to allocate" in text:
        return "memory", text[:300]
    readable = text.strip() and len(text) < LONGEST and text.replace("\n", " ").isprintable()
    return ("refused" if readable else "message"), repr(text[:300])


def main() -> int:
    """Print counts by kind, and every input that did harm; 1 where one did."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--kind", action="append", choices=[kind.name for kind in KINDS])
    parser.add_argument("--show", action="append", default=[])
    options = parser.parse_args()
    total: Counter[str] = Counter()
    for kind in KINDS:
        if options.kind and kind.name not in options.kind:
            continue
        counts: Counter[str] = Counter()
        start = time.monotonic()
        cases = range(options.first, options.first + options.count)
        for verdict in fuzz(kind, cases, options.seed):
            counts[verdict.outcome] += 1
            if verdict.outcome not in HARMLESS or verdict.outcome in options.show:
                print(
                    f"-- {kind.name} {verdict.case} {verdict.outcome}: {verdict.text}", flush=True
                )
        print(f"{kind.name}: {dict(counts)} in {time.monotonic() - start:.1f} s", flush=True)
        total += counts
    print(f"all: {total.total()} {dict(total)}")
    return int(any(total[outcome] for outcome in total if outcome not in HARMLESS))


if __name__ == "__main__":
    raise SystemExit(main())
