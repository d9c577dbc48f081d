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
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
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
BATCH: Final = 200
"""Inputs that share a process."""

_REPLACED: Final = 0.06
"""Share of inputs in which something else than a file stands in its place."""


_WAIT: Final = 4 * SECONDS
_ENDED: Final = 77
"""Exit code of a process that answered for all that it did."""

Work = Callable[[], object]


@dataclass(frozen=True)
class Verdict:
    """Outcome of one input: accepted, refused, or traceback, crash, hang, memory, message."""

    outcome: str
    text: str
    kind: str = ""
    case: int = 0


def fuzz(kind: Kind, cases: range, seed: int) -> Iterator[Verdict]:
    """Yield a verdict for each mutated input of a kind; equal seeds give equal inputs.

    Some hundreds share a process, which reads the sound input first: imports serve all of them.
    """
    sound = Path(_made(kind.make).name) / "sound"
    left = list(cases)
    while left:
        batch, left = left[:BATCH], left[BATCH:]
        works = [partial(_read_sound, kind, sound)]
        works += [partial(_read_damaged, kind, sound, case, seed) for case in batch]
        verdicts = outcomes(works)
        first = next(verdicts)
        assert first.outcome == "accepted", f"{kind.name}: the sound input gives {first}"
        yield from (
            replace(verdict, kind=kind.name, case=case)
            for case, verdict in zip(batch, verdicts, strict=True)
        )


def _read_sound(kind: Kind, sound: Path) -> None:
    with _copy_of(sound, "first") as folder:
        kind.read(folder)


def _read_damaged(kind: Kind, sound: Path, case: int, seed: int) -> None:
    with _copy_of(sound, str(case)) as folder:
        damage(kind, folder, random.Random(f"{seed} {kind.name} {case}"))
        kind.read(folder)


@cache
def _made(make: Callable[[Path], object]) -> "tempfile.TemporaryDirectory[str]":
    """Make sound files, once for all kinds that damage them."""
    temporary = tempfile.TemporaryDirectory()
    sound = Path(temporary.name) / "sound"
    sound.mkdir()
    (made,) = outcomes([lambda: make(sound)])
    assert made.outcome == "accepted", made
    return temporary


@contextlib.contextmanager
def _copy_of(sound: Path, name: str) -> Iterator[Path]:
    """Yield a copy beside the sound files, of its own path: nothing that was read is known."""
    folder = sound.with_name(name)
    shutil.rmtree(folder, ignore_errors=True)  # of an input that was ended
    shutil.copytree(sound, folder)
    os.chdir(sound)  # away from ./robots, whose relative paths would be known later
    try:
        yield folder
    finally:
        os.chdir(sound)
        shutil.rmtree(folder, ignore_errors=True)


def damage(kind: Kind, folder: Path, rng: random.Random) -> None:
    """Mutate one of the files of a kind."""
    path = rng.choice(sorted(p for pattern in kind.damaged for p in folder.glob(pattern)))
    if kind.places and rng.random() < _REPLACED:
        replaced(path, rng)
    else:
        path.write_bytes(mutated(path.read_bytes(), rng))


def outcomes(works: Sequence[Work], seconds: int = SECONDS) -> Iterator[Verdict]:
    """Yield a verdict of each work. They are done in turn in a process with limits of CPU time and
    memory for each; behind one that does harm, in another process."""
    left = list(works)
    while left:
        for verdict in _verdicts(left, seconds):
            del left[0]
            yield verdict


def _verdicts(works: Sequence[Work], seconds: int) -> Iterator[Verdict]:
    """Yield the verdicts of one process, at least one."""
    source, sink = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(source)
        _settle(list(works), sink, seconds)
    os.close(sink)
    is_late = yield from _answers(source)
    os.close(source)
    if is_late:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if is_late or (os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU):
        yield Verdict("hang", "")
    elif status != _ENDED << 8:
        yield Verdict("crash", f"status {status}")


def _answers(source: int) -> Generator[Verdict, None, bool]:
    """Yield what a process answers before it ends; return True where it takes for ever."""
    data, until = b"", time.monotonic() + _WAIT
    while select.select([source], [], [], max(until - time.monotonic(), 0))[0]:
        part = os.read(source, 1 << 16)
        if not part:
            return False
        *answers, data = (data + part).split(b"\n")
        if answers:
            until = time.monotonic() + _WAIT
            yield from (Verdict(*json.loads(answer)) for answer in answers)
    return True


def _settle(works: Sequence[Work], sink: int, seconds: int) -> None:
    """Do works in this process, up to one that does harm, and end it."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    quiet = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(quiet, descriptor)
    for work in works:
        _limit(seconds)
        outcome, text = _verdict(work)
        with contextlib.suppress(BrokenPipeError):
            os.write(sink, json.dumps([outcome, text]).encode() + b"\n")
        if outcome not in HARMLESS:
            break
    os._exit(_ENDED)


def _limit(seconds: int) -> None:
    """Allow this process some more seconds of CPU time, and MEMORY more bytes."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft = math.ceil(time.process_time()) + seconds
    for limit, value in ((resource.RLIMIT_AS, used + MEMORY), (resource.RLIMIT_CPU, soft)):
        resource.setrlimit(limit, (value, resource.RLIM_INFINITY))


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
