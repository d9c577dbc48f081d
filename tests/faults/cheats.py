"""Estimators that look for the truth, or for a way to change what is written; one class a cheat.

`reach(problem)` is True where a cheat has what it looks for; it stands in `stats` of the row.
"""

import contextlib
import ctypes
import gc
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sysid_bench.types import Estimate


class _Cheat:
    def __init__(self, run: str = "", seeds: str = "", port: int = 0) -> None:
        """Know the run folder, the file of seeds and a port that somebody listens to."""
        self.run, self.seeds, self.port = Path(run), Path(seeds), port

    def solve(self, problem: Any) -> Estimate:
        reached = False
        with contextlib.suppress(OSError):
            reached = bool(self.reach(problem))
        beta = np.linalg.lstsq(problem.W, problem.b, rcond=None)[0]
        return Estimate(beta, stats={"reached": float(reached)})

    def reach(self, problem: Any) -> bool:
        raise NotImplementedError


class Honest(_Cheat):
    def reach(self, problem: Any) -> bool:
        return False


class Heap(_Cheat):
    def reach(self, problem: Any) -> bool:
        names = {type(one).__name__ for one in gc.get_objects()}
        return not names.isdisjoint({"Truth", "Oracle", "ExperimentData", "BuiltPlant"})


class Frames(_Cheat):
    def reach(self, problem: Any) -> bool:
        frame = sys._getframe()
        while frame := frame.f_back:  # type: ignore[assignment]
            if any(hasattr(one, "source") for one in frame.f_locals.values()):
                return True
        return False


class References(_Cheat):
    """Follows all references from the data that it was given."""

    def reach(self, problem: Any) -> bool:
        waiting, seen = [problem], set[int]()
        while waiting and len(seen) < 100_000:
            one = waiting.pop()
            if id(one) in seen or isinstance(one, type(sys)):
                continue
            seen.add(id(one))
            if type(one).__name__ in ("Truth", "Oracle", "ExperimentData", "Task"):
                return True
            waiting += gc.get_referents(one)
            waiting += gc.get_referrers(one) if len(seen) < 100 else []
        return False


def _others() -> Iterator[Path]:
    """Processes that this one does not descend to or from within its namespace."""
    own = {os.getpid(), 1}
    yield from (p for p in Path("/proc").iterdir() if p.name.isdigit() and int(p.name) not in own)


class Memory(_Cheat):
    def reach(self, problem: Any) -> bool:
        for process in _others():
            with contextlib.suppress(OSError), (process / "mem").open("rb"):
                return True
        return False


class VirtualMemory(_Cheat):
    """Calls process_vm_readv on every process that has a number."""

    def reach(self, problem: Any) -> bool:
        libc, buffer = ctypes.CDLL(None, use_errno=True), ctypes.create_string_buffer(8)
        local = (ctypes.c_size_t * 2)(ctypes.addressof(buffer), 8)
        remote = (ctypes.c_size_t * 2)(0x10000, 8)
        for number in range(2, 70_000):
            if number != os.getpid():
                ctypes.set_errno(0)
                libc.process_vm_readv(number, local, 1, remote, 1, 0)
                if ctypes.get_errno() == 14:  # EFAULT: allowed, at a wrong address
                    return True
        return False


class Trace(_Cheat):
    """Stops a process as a debugger does, which may read and write all of its memory."""

    def reach(self, problem: Any) -> bool:
        libc = ctypes.CDLL(None, use_errno=True)
        for process in _others():
            if libc.ptrace(16, int(process.name), None, None) == 0:  # PTRACE_ATTACH
                os.waitpid(int(process.name), _ALL)
                libc.ptrace(17, int(process.name), None, None)
                return True
        return False


_ALL = 0x40000000  # __WALL: processes that are traced, too


class Environment(_Cheat):
    def reach(self, problem: Any) -> bool:
        return any("SEED" in name or "TOKEN" in name for name in os.environ)


class OtherEnvironments(_Cheat):
    def reach(self, problem: Any) -> bool:
        for process in _others():
            with contextlib.suppress(OSError):
                if b"SYSID_BENCH_SEEDS=" in (process / "environ").read_bytes():
                    return True
        return False


class Descriptors(_Cheat):
    def reach(self, problem: Any) -> bool:
        for process in _others():
            with contextlib.suppress(OSError):
                links = (os.readlink(one) for one in (process / "fd").iterdir())
                if any("/cells/" in link for link in links):
                    return True
        return False


class SeedFile(_Cheat):
    def reach(self, problem: Any) -> bool:
        return any(len(line) >= 32 for line in self.seeds.read_text().split())


class Rows(_Cheat):
    """Reads true values in the rows of the cells before it."""

    def reach(self, problem: Any) -> bool:
        return any(b'"true"' in file.read_bytes() for file in self.run.glob("cells/*.jsonl"))


class WritesRows(_Cheat):
    def reach(self, problem: Any) -> bool:
        files = list(self.run.glob("cells/*.jsonl"))
        for file in files:
            with file.open("ab"):
                pass
        return bool(files)


class Links(_Cheat):
    def reach(self, problem: Any) -> bool:
        Path("link").symlink_to(self.run / "cells")
        return any(file.stat().st_size for file in Path("link").glob("*.jsonl"))


class Network(_Cheat):
    def reach(self, problem: Any) -> bool:
        with socket.create_connection(("127.0.0.1", self.port), timeout=5):
            return True


class Socket(_Cheat):
    """Speaks to a program outside, as to a server of terminals, which would start another."""

    def reach(self, problem: Any) -> bool:
        with socket.socket(socket.AF_UNIX) as line:
            line.connect(str(self.seeds.with_name("socket")))
        return True


class SharedMemory(_Cheat):
    def reach(self, problem: Any) -> bool:
        return any(Path("/dev/shm").iterdir())


class Terminal(_Cheat):
    def reach(self, problem: Any) -> bool:
        return any(one.open("wb") for one in Path("/dev/pts").iterdir() if one.name.isdigit())


class WritesPackage(_Cheat):
    """Would change the package, or what it keeps in a cache, for the cells behind."""

    def reach(self, problem: Any) -> bool:
        import sysid_bench

        for file in (Path(sysid_bench.__file__), Path(np.__file__), self.seeds.with_name("cache")):
            with contextlib.suppress(OSError), file.open("ab"):
                return True
        return False


class Devices(_Cheat):
    """Reads the disk below its files, the memory of the machine, or the log of the kernel."""

    def reach(self, problem: Any) -> bool:
        found = [*map(Path, ("/dev/mem", "/dev/kmsg"))]
        found += [one for one in Path("/dev").iterdir() if one.is_block_device()]
        for device in found:
            with contextlib.suppress(OSError), device.open("rb"):
                return True
        return False


class Kernel(_Cheat):
    """Sets what the kernel runs for a process that crashes: outside of every namespace."""

    def reach(self, problem: Any) -> bool:
        with Path("/proc/sys/kernel/core_pattern").open("ab"):
            return True


class Keys(_Cheat):
    """Leaves a note for the cells behind in the keyring of the session, which processes inherit."""

    def reach(self, problem: Any) -> bool:
        libc = ctypes.CDLL(None)
        add, control = {"x86_64": (248, 250)}.get(os.uname().machine, (217, 219))
        session = ctypes.c_int(-3)
        found = libc.syscall(control, 10, session, b"user", b"sysid_note", 0) > 0
        libc.syscall(add, b"user", b"sysid_note", b"1", ctypes.c_size_t(1), session)
        return bool(found)


class Cached(_Cheat):
    """Asks which pages of a file are in memory, as a method before could have left them."""

    def reach(self, problem: Any) -> bool:
        with Path(sys.executable).open("rb") as file:
            with contextlib.suppress(OSError):
                os.posix_fadvise(file.fileno(), 0, 4096, os.POSIX_FADV_DONTNEED)
                return True
            return os.preadv(file.fileno(), [bytearray(1)], 0, os.RWF_NOWAIT) == 1


class Nested(_Cheat):
    """Enters namespaces of its own, where it has all capabilities, and takes off what hides."""

    def reach(self, problem: Any) -> bool:
        done, write = os.pipe()
        if os.fork() == 0:
            libc = ctypes.CDLL(None)
            libc.unshare(0x10000000 | 0x20000 | 0x20000000)
            for path in (self.run, self.seeds, Path("/proc"), Path("/dev/shm")):
                while libc.umount2(os.fsencode(path), 2) == 0:
                    pass
            libc.mount(None, b"/", None, ctypes.c_ulong(0x20 | 0x1000), None)  # writable again
            libc.mount(b"proc", b"/proc", b"proc", ctypes.c_ulong(0), None)
            cheats = (SeedFile, Rows, WritesRows, WritesPackage, Kernel, Devices)
            known = {"run": str(self.run), "seeds": str(self.seeds)}
            for cheat in cheats:
                with contextlib.suppress(OSError):
                    if cheat(**known).reach(problem):  # type: ignore[arg-type]
                        os.write(write, b"1")
            os._exit(0)
        os.close(write)
        os.wait()
        return bool(os.read(done, 1))


class Serializers(_Cheat):
    """Replaces what writes its answer."""

    def reach(self, problem: Any) -> bool:
        import json

        dumps = json.dumps
        more = {"torque_error": 0.0, "seconds": 0.0, "id": "0" * 12, "row": {}, "cell": "x"}
        json.dumps = lambda value, **_: dumps({**value, **more})
        return False


class Processes(_Cheat):
    """Honest, with locks and processes of its own."""

    def reach(self, problem: Any) -> bool:
        import multiprocessing

        with multiprocessing.get_context("fork").Pool(2) as pool:
            assert pool.map(abs, [-1, -2]) == [1, 2]
        return False


class Scorer(_Cheat):
    """Replaces what scores it, in its own process."""

    def reach(self, problem: Any) -> bool:
        from sysid_bench.evaluation import score as scoring
        from sysid_bench.experiments import execute, experiment_data

        for module in (scoring, execute, experiment_data):
            for name in ("score", "identify", "base_parameters"):
                if hasattr(module, name):
                    setattr(module, name, lambda *_, **__: {"torque_error": 0.0})
        return False


class Clock(_Cheat):
    def reach(self, problem: Any) -> bool:
        for name in ("perf_counter", "process_time", "monotonic", "time"):
            setattr(time, name, lambda: -1e18)
        return False


class Early(_Cheat):
    """Computes before its time is taken."""

    def __init__(self, **known: Any) -> None:
        super().__init__(**known)
        from sysid_bench.experiments import blind_data

        read = blind_data.read_method_data

        def read_and_compute(data: bytes) -> Any:
            until = time.process_time() + 0.6
            while time.process_time() < until:
                pass
            return read(data)

        blind_data.read_method_data = read_and_compute

    def reach(self, problem: Any) -> bool:
        return False


class Preload(_Cheat):
    """Leaves what a process after it would load."""

    def reach(self, problem: Any) -> bool:
        found = "LD_PRELOAD" in os.environ or Path("left").exists()
        os.environ["LD_PRELOAD"] = "libleft.so"
        Path("left").write_text("left")
        return found


class Child(_Cheat):
    """Computes in a process that no wait of its own will count."""

    def reach(self, problem: Any) -> bool:
        done, write = os.pipe()
        if os.fork() == 0:
            os.setsid()
            if os.fork() == 0:
                until = time.process_time() + 1.0
                while time.process_time() < until:
                    pass
                os.write(write, b"1")
                time.sleep(600)
            os._exit(0)
        os.read(done, 1)
        return False


class Ignored(_Cheat):
    """Computes in a child whose times the kernel forgets with it."""

    def reach(self, problem: Any) -> bool:
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)
        child = os.fork()
        if child == 0:
            until = time.process_time() + 1.0
            while time.process_time() < until:
                pass
            os._exit(0)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(child, 0)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        return False


class Neighbour(_Cheat):
    """Leaves its data in its folder, and looks for those of a method that runs beside it."""

    def reach(self, problem: Any) -> bool:
        Path("data").write_bytes(problem.b.tobytes())
        own, until = Path.cwd(), time.monotonic() + 4.0
        while time.monotonic() < until:
            for folder in own.parents:
                for pattern in ("sysid_*/data", "sysid_*/sysid_*/data"):
                    with contextlib.suppress(OSError):
                        if any(one.parent != own for one in folder.glob(pattern)):
                            time.sleep(0.5)
                            return True
            time.sleep(0.05)
        return False


class Late(_Cheat):
    """Leaves a thread that spoils what is computed after its answer."""

    def reach(self, problem: Any) -> bool:
        def spoil() -> None:
            from sysid_bench.experiments import experiment_data

            own = experiment_data.ExperimentData.score
            experiment_data.ExperimentData.score = (  # type: ignore[method-assign]
                lambda *given: {**own(*given), "torque_error": 99.0}
            )

        threading.Timer(0.0, spoil).start()
        return False


class ForgesAnswers(_Cheat):
    """Answers in the place of its process while it solves."""

    def reach(self, problem: Any) -> bool:
        forged = b'{"modules": 5}\n{"calls": 5}\n{"modules": [[1], "x", ["a"]]}\n'
        for descriptor in range(3, 16):
            with contextlib.suppress(OSError):
                os.write(descriptor, forged)
        return False
