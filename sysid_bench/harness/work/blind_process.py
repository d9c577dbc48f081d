"""A third-party method in a process of its own, which was started fresh and never held the truth.

To its caller it is an estimator, whose calls are answered by that process: see blind_worker.py. One
process serves one estimator of one experiment.
"""

import contextlib
import inspect
import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

from sysid_bench.errors import reason_of
from sysid_bench.experiments.blind_data import method_data
from sysid_bench.experiments.job_channel import MethodEnd, ProcessEnd, peak_memory
from sysid_bench.experiments.spec import SEEDS
from sysid_bench.experiments.third_party import loaded_sources
from sysid_bench.harness.work.confinement import (
    hide_memory,
    method_environment,
    wanted_isolation,
)
from sysid_bench.harness.work.process_tree import (
    child_of,
    kill_group,
    kill_subtree,
    memory_use,
    tree_of,
)
from sysid_bench.harness.work.run_process import end_of_process
from sysid_bench.types import Estimate, Experiment, Problem
from sysid_bench.words import FRAME_DEPENDENT, NAMESPACES, PROCESS, STATUSES

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

_LONGEST: Final = 1 << 26
_LONGEST_REASON: Final = 200
_MESSAGES: Final = 2
_POLL_SECONDS: Final = 0.1
_READ_SECONDS, _READ_BYTES = 0.1, 5e7
"""CPU seconds, and bytes in a second, of reading data: 10 times what 3 MB take."""
_CONFINEMENT: Final = 50_000_000
"""Bytes of the two processes around a confined one, and a margin."""
_GRACE_SECONDS: Final = 2.0

SEALED_NEEDS: Final = (
    "The plant is sealed, and this system gives a method no namespaces of its own (see isolation): "
    "it could read the seed. Run the cell on Linux with user namespaces."
)


class BlindMethod:
    """Estimator whose `solve` and `fit`, where the method has them, run in its process.

    `isolation` is that of its process; `sources` are the third-party files that it had loaded;
    `frame_dependent` is what it declares.
    """

    def __init__(self, process: "subprocess.Popen[bytes]", simulated: bool) -> None:
        self.seconds = self.seconds_cpu = 0.0
        self.isolation = PROCESS
        self.sources: dict[str, str] = {}
        self.calls: tuple[str, ...] = ()
        self.frame_dependent = ""
        self._process, self._simulated = process, simulated
        # Few wait at a time: what a method writes without end must not fill this process.
        self._inbox: queue.Queue[dict[str, Any] | None] = queue.Queue(_MESSAGES)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def __getattr__(self, name: str) -> Any:
        if name not in ("solve", "fit") or name not in self.__dict__.get("calls", ()):
            raise AttributeError(name)
        return partial(self._call, name)

    def start(self, head: Mapping[str, Any]) -> None:
        """Send what the process needs to find its method, and wait until it is built.

        Raises MethodEnd where that fails.
        """
        self._send(json.dumps(head).encode() + b"\n")
        self.isolation = str(self._next("isolation")["isolation"])
        if head["sealed"] and self.isolation == PROCESS:
            raise MethodEnd(ProcessEnd("failed", SEALED_NEEDS))
        confined = self.isolation == NAMESPACES
        # Confined, it is the child of the first process of its namespace.
        inner = child_of(child_of(self._process.pid)) if confined else self._process.pid
        self._pid = inner or self._process.pid
        # The method's code has run: what comes may be its own.
        built = self._next("calls")
        self.calls = tuple(name for name in ("solve", "fit") if name in str(built["calls"]))
        match built.get(FRAME_DEPENDENT):
            case str(reason):
                self.frame_dependent = " ".join(reason.split())[:_LONGEST_REASON]
            case True:
                self.frame_dependent = "its answer depends on the frames of the links"

    def used_seconds(self) -> tuple[float, float]:
        """Seconds and CPU seconds of all calls."""
        return self.seconds, self.seconds_cpu

    @property
    def peak_memory(self) -> float | None:
        """Largest resident memory of the process in MB; None where the system does not tell it."""
        return peak_memory(self._pid)

    def _call(self, name: str, data: Problem | Experiment) -> Estimate:
        experiment: Experiment | None = None
        if isinstance(data, Experiment):
            # Calls of the simulation are counted where they are made.
            experiment = replace(data, simulate=inspect.unwrap(data.simulate))
        problem = data.problem if isinstance(data, Experiment) else data
        sent = method_data(problem, experiment, simulated=self._simulated)
        cpu_sent = self._cpu()
        self._send(json.dumps({"call": name, "bytes": len(sent)}).encode() + b"\n" + sent)
        self._next("ready")
        start, cpu_start = time.perf_counter(), self._cpu()
        self._send(b"\n")
        answer = self._next("estimate")
        # A method may compute while it reads: what reading does not take counts.
        early = max(0.0, cpu_start - cpu_sent - _READ_SECONDS - len(sent) / _READ_BYTES)
        self.seconds += time.perf_counter() - start + early
        self.seconds_cpu += self._cpu() - cpu_start + early
        return _estimate(answer["estimate"])

    def _cpu(self) -> float:
        """CPU seconds of the process and of all that it has started."""
        if sys.platform != "linux":
            return time.perf_counter()  # the wall clock bounds it from above
        seconds = 0.0
        # All that it has started, also what has left its parents.
        for process in (self._process.pid, *tree_of(self._process.pid)):
            with contextlib.suppress(OSError, IndexError):
                # clock_getcpuclockid(3) of another process; children that it has waited for
                seconds += time.clock_gettime((~process << 3) | 2)
                fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
                seconds += sum(map(int, fields[13:15])) / os.sysconf("SC_CLK_TCK")
        return seconds

    def _send(self, data: bytes) -> None:
        pipe = self._process.stdin
        assert pipe is not None
        with contextlib.suppress(OSError):  # it has ended, which the answer says
            pipe.write(data)
            pipe.flush()

    def _next(self, key: str) -> dict[str, Any]:
        """Return the next answer with a key; raises MethodEnd at the end of the process, and for an
        error that it reports."""
        while True:
            try:
                answer = self._inbox.get(timeout=_POLL_SECONDS)
            except queue.Empty:
                if self._process.poll() is None:
                    continue
                answer = None  # one of its children may keep the pipe open
            if answer is None:
                raise MethodEnd(self._end())
            self.sources = loaded_sources(_modules(answer)) or self.sources
            match answer.get("error"):
                case [str(status), str(reason), str(text)] if status in STATUSES:
                    raise MethodEnd(ProcessEnd(status, reason, text))
            if key in answer:
                return answer

    def _end(self) -> ProcessEnd:
        """How the process has ended, or that it has closed its pipe and goes on."""
        try:
            return ProcessEnd(*end_of_process(self._process.wait(_GRACE_SECONDS)))
        except subprocess.TimeoutExpired:
            return ProcessEnd("crash", "its process closed the pipe of its result")

    def end(self) -> None:
        """Leave out what the process, which has ended, wrote beyond its answers."""
        until = time.monotonic() + _GRACE_SECONDS  # a process that left its group may keep the pipe
        while self._listener.is_alive() and time.monotonic() < until:
            with contextlib.suppress(queue.Empty):
                self._inbox.get(timeout=_POLL_SECONDS)

    def _listen(self) -> None:
        pipe = self._process.stdout
        assert pipe is not None
        for message in _messages(pipe):
            self._inbox.put(message)
        self._inbox.put(None)


def _messages(pipe: IO[bytes]) -> Iterator[dict[str, Any]]:
    """Yield JSON objects; a method may write other lines into its pipe, which are left out."""
    with contextlib.suppress(OSError, ValueError):
        while line := pipe.readline(_LONGEST):
            if not line.endswith(b"\n"):  # cut off, here or by the end of the process
                if len(line) == _LONGEST:
                    reason = f"its answer has more than {_LONGEST / 1e6:.0f} MB, which is not read"
                    yield {"error": ["failed", f"{reason}; let it return less in 'stats'", ""]}
                return
            with contextlib.suppress(ValueError, RecursionError):
                message = json.loads(line)
                if isinstance(message, dict):
                    yield message


@contextmanager
def blind_method(
    estimator: Mapping[str, Any], run_folder: Path, *, simulated: bool, sealed: bool
) -> Iterator[BlindMethod]:
    """Start the process of an estimator {use, settings} and end it with all that it has started.

    Its folder, the only one that it can write to, is empty, and its environment has what libraries
    need. The run folder, whose rows have true values, and the file of seeds are hidden from it.
    Raises MethodEnd where the method cannot be built.
    """
    hidden = [os.path.abspath(run_folder), os.environ.get(SEEDS, "")]
    with tempfile.TemporaryDirectory(prefix="sysid_method_", ignore_cleanup_errors=True) as folder:
        hide_memory(True)  # until it is known that nobody can look
        try:
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", "sysid_bench.harness.work.blind_worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                cwd=folder,
                env=method_environment(folder),
                start_new_session=True,
            )
        except OSError as error:  # no process or descriptor is left on this machine
            hide_memory(False)
            reason = f"its process could not be started ({reason_of(error)})"
            raise MethodEnd(ProcessEnd("lost", reason)) from error
        # Messages name a method by its class.
        kind = type(str(estimator["use"]).rpartition(":")[2], (BlindMethod,), {})
        method: BlindMethod = kind(process, simulated)
        try:
            method.start(
                {
                    "hidden": [os.path.abspath(path) for path in hidden if path],
                    "folder": folder,
                    "memory": _free_memory(),
                    "isolation": wanted_isolation(),
                    "sealed": sealed,
                    "path": [entry or os.getcwd() for entry in sys.path],
                    "estimator": dict(estimator),
                }
            )
            hide_memory(method.isolation == PROCESS)
            yield method
        finally:
            hide_memory(False)
            kill_group(process)
            process.wait()
            kill_subtree()
            method.end()
            for pipe in (process.stdin, process.stdout):
                with contextlib.suppress(OSError):
                    pipe and pipe.close()


def _free_memory() -> int | None:
    """Bytes that the limit of this process leaves to a method; None without a limit.

    The supervisor ends a worker whose processes are together above it: a method whose own
    allocation fails before can say so.
    """
    if resource is None:
        return None
    limit = resource.getrlimit(resource.RLIMIT_DATA)[0]
    if limit == resource.RLIM_INFINITY:
        return None
    return max(int(limit - memory_use(os.getpid(), 0.0)) - _CONFINEMENT, _CONFINEMENT)


def _modules(answer: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield (name, file) of the modules of an answer, leaving out what a method may have written
    in their place."""
    modules = answer.get("modules")
    for one in modules if isinstance(modules, list) else ():
        match one:
            case [str(name), str(file)]:
                yield name, file


def _estimate(found: Any) -> Estimate:
    """The estimate of an answer. Shapes and values are checked as those of any method are."""
    given = dict(found) if isinstance(found, dict) else {}
    for name in ("beta", "theta", "covariance", "sigma"):
        if given.get(name) is not None:
            # None stands for a number that is not finite.
            given[name] = np.array(given[name], dtype=float)
    stats = given.get("stats")
    if isinstance(stats, dict):
        given["stats"] = {key: np.nan if x is None else x for key, x in stats.items()}
    known = {field.name for field in fields(Estimate)}
    return Estimate(**{key: value for key, value in given.items() if key in known})
