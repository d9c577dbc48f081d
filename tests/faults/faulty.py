"""Faulty estimators, one class a fault. They know nothing of the harness but `solve(problem)`."""

import contextlib
import ctypes
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np

from sysid_bench.types import Estimate, Metric


def ols(problem: Any) -> Estimate:
    return Estimate(np.linalg.lstsq(problem.W, problem.b, rcond=None)[0])


class _Placed:
    def __init__(self, place: int = 0) -> None:
        """Take a setting, so that one suite can have a fault several times."""
        self.place = place


class _Fault(_Placed):
    def solve(self, problem: Any) -> Any:
        self.act(problem)
        return ols(problem)

    def act(self, problem: Any) -> Any:
        raise NotImplementedError


# Exceptions


class Raises(_Fault):
    def act(self, problem: Any) -> NoReturn:
        raise ValueError("<script>alert(1)</script> $x^2$ & _ %")


class Exits(_Fault):
    def act(self, problem: Any) -> NoReturn:
        sys.exit(0)


class Interrupts(_Fault):
    def act(self, problem: Any) -> NoReturn:
        raise KeyboardInterrupt("mine")


class EndsGenerator(_Fault):
    def act(self, problem: Any) -> NoReturn:
        raise GeneratorExit("mine")


class Recurses(_Fault):
    def act(self, problem: Any) -> None:
        self.act(problem)


class UnreadableError(_Fault):
    def act(self, problem: Any) -> NoReturn:
        class Broken(Exception):
            def __str__(self) -> str:
                raise RuntimeError("not even a message")

        raise Broken


# Answers


def _answering(make: Callable[[int], Any]) -> type[_Placed]:
    """Class of methods that answer what is made from the number of base parameters."""
    return type("Answers", (_Placed,), {"solve": lambda self, problem: make(problem.base.rank)})


AnswersNan = _answering(lambda rank: Estimate(np.full(rank, np.nan)))
AnswersInf = _answering(lambda rank: Estimate(np.full(rank, np.inf)))
AnswersHuge = _answering(lambda rank: Estimate(np.full(rank, 1e300)))
AnswersTooMany = _answering(lambda rank: Estimate(np.zeros(rank + 1)))
AnswersMatrix = _answering(lambda rank: Estimate(np.zeros((rank, 1))))
AnswersComplex = _answering(lambda rank: Estimate(np.full(rank, 1j)))
AnswersText = _answering(lambda rank: Estimate(np.array(["a"] * rank)))
AnswersNone = _answering(lambda rank: None)
AnswersObject = _answering(lambda rank: Estimate(np.zeros(rank), stats={"x": object()}))  # type: ignore[dict-item]


# Ends of the process


class Segfaults(_Fault):
    def act(self, problem: Any) -> None:
        ctypes.string_at(0)


class Aborts(_Fault):
    def act(self, problem: Any) -> None:
        os.abort()


class Leaves(_Fault):
    def act(self, problem: Any) -> None:
        os._exit(0)


class KillsItself(_Fault):
    def act(self, problem: Any) -> None:
        os.kill(os.getpid(), signal.SIGKILL)


class ClosesDescriptors(_Fault):
    def act(self, problem: Any) -> None:
        os.closerange(0, 64)


# Time and memory


class Hangs(_Fault):
    def act(self, problem: Any) -> None:
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        while True:
            time.sleep(0.1)


class Allocates(_Fault):
    def act(self, problem: Any) -> None:
        kept = []
        while True:
            kept.append(np.ones(4_000_000))


class RaisesLimit(_Fault):
    """Allows itself any memory, and hides all errors."""

    def act(self, problem: Any) -> None:
        try:
            resource.setrlimit(resource.RLIMIT_DATA, (resource.RLIM_INFINITY,) * 2)
        except ValueError:  # only root may do so
            raise MemoryError from None
        kept = []
        while True:
            kept.append(np.ones(4_000_000))
            time.sleep(0.01)


class AllocatesQuietly(_Fault):
    """Allocates and hides the error: the limit still holds."""

    def act(self, problem: Any) -> None:
        kept = []
        while True:
            try:
                kept.append(np.ones(4_000_000))
            except MemoryError:
                raise RuntimeError("hidden") from None


class Prints(_Fault):
    def act(self, problem: Any) -> None:
        for _ in range(300):
            sys.stdout.write("x" * 100_000 + "\n")


# State of the process


class ChangesFolder(_Fault):
    def act(self, problem: Any) -> None:
        os.chdir("/")
        os.umask(0o777)
        for name in ("HOME", "TMPDIR"):
            os.environ[name] = "/nonexistent"
        os.environ.pop("PATH", None)


class ChangesDefaults(_Fault):
    def act(self, problem: Any) -> None:
        np.random.seed(0)
        np.seterr(all="raise")
        warnings.simplefilter("error")
        sys.setrecursionlimit(120)


class WritesData(_Fault):
    """Makes shared arrays writable and overwrites them."""

    def act(self, problem: Any) -> None:
        for array in (problem.W, problem.b):
            try:
                array.flags.writeable = True
                array[...] = 0.0
            except ValueError:
                continue
        raise RuntimeError("overwritten")


class PatchesScores(_Fault):
    """Replaces functions of the harness that the cells after it need."""

    def act(self, problem: Any) -> None:
        from sysid_bench.evaluation.torque_errors import RowErrors
        from sysid_bench.experiments import execute

        RowErrors.relative = property(lambda self: 1e-9)  # type: ignore[assignment, method-assign]
        execute.identify = lambda *_: (_ for _ in ()).throw(RuntimeError("patched"))  # type: ignore[attr-defined]


class PatchesNumpy(_Fault):
    def act(self, problem: Any) -> None:
        np.linalg.lstsq = np.linalg.svd = np.dot = None  # type: ignore[assignment]
        raise RuntimeError("patched")


class StartsThread(_Fault):
    def act(self, problem: Any) -> None:
        def spin() -> None:
            while True:
                time.sleep(0.01)

        threading.Thread(target=spin).start()


class LeavesFiles(_Fault):
    def act(self, problem: Any) -> None:
        tempfile.mkstemp(prefix="sysid_litter_")
        tempfile.mkdtemp(prefix="sysid_litter_")


# Processes


class Forks(_Fault):
    def act(self, problem: Any) -> None:
        if os.fork() == 0:
            time.sleep(3600)
            os._exit(0)


class ForksSession(_Fault):
    def act(self, problem: Any) -> None:
        if os.fork() == 0:
            os.setsid()
            if os.fork() == 0:
                time.sleep(3600)
            os._exit(0)


class ForksAndReturns(_Fault):
    """Both processes come back from `solve`."""

    def act(self, problem: Any) -> None:
        os.fork()


class StartsProgram(_Fault):
    def act(self, problem: Any) -> None:
        command = ["sh", "-c", "sleep 3601; true", os.environ["TMPDIR"]]
        subprocess.Popen(command, start_new_session=True, env={})


class DaemonizesTwice(_Fault):
    """Starts a program from a grandchild in a session of its own; all in between ends."""

    def act(self, problem: Any) -> None:
        child = os.fork()
        if child == 0:
            os.setsid()
            if os.fork() == 0:
                os.setsid()
                command = ["sh", "-c", "sleep 3601; true", os.environ["TMPDIR"]]
                subprocess.Popen(command, start_new_session=True, env={})
            os._exit(0)
        os.waitpid(child, 0)


class KillsGroup(_Fault):
    def act(self, problem: Any) -> None:
        os.killpg(0, signal.SIGKILL)


class KillsParent(_Fault):
    def act(self, problem: Any) -> None:
        with contextlib.suppress(PermissionError):
            os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(1)


class ForgesMessages(_Fault):
    """Writes messages of the harness into every open descriptor."""

    def act(self, problem: Any) -> None:
        lines = (
            *(b'{"cell": []}', b'{"cell": "x"}', b'{"row": 5}', b'{"row": {"id": {}}}'),
            *(b"[" * 100_000, b"5", b'{"end": 3}'),
        )
        for descriptor in range(3, 64):
            try:
                os.write(descriptor, b"\n".join(lines) + b"\n")
            except OSError:
                continue


def forge_rows(_: Any) -> float:
    """A metric that answers for all cells of its experiment, and for its own under the labels of
    another robot."""
    found: dict[str, Any] = {}
    frame = sys._getframe()
    while frame := frame.f_back:  # type: ignore[assignment]
        found |= frame.f_locals.get("headers", {})
    for cell, header in found.items():
        row = {**header, "id": cell, "robot": "another", "estimator": "ols", "experiment": "0"}
        row |= {"nv": 99, "fingerprint": "", "reason": "forged", "status": "ok"}
        messages = [{"cell": cell}, {"row": row | {"torque_error": 99.0}}]
        data = b"".join(b"\n" + json.dumps(m).encode() + b"\n" for m in messages)
        for descriptor in range(3, 64):
            with contextlib.suppress(OSError):
                os.write(descriptor, data)
    return 0.0


forges = Metric("forges", "Forges", compute=forge_rows)


class WritesToDescriptors(_Fault):
    """Writes garbage into every open descriptor."""

    def act(self, problem: Any) -> None:
        for descriptor in range(3, 64):
            try:
                os.write(descriptor, b'{"row": {"id": "forged", "status": "ok"}}\n')
            except OSError:
                continue
