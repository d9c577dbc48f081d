"""The compiled kernel, kernel.c, through its plain C functions: trees and columns as flat arrays.

One library holds the kernel once per instruction set; the best that the processor has is taken.
Where the library is absent, too old for its source or unwanted, `chosen()` says why, and the NumPy
kernel serves: same values, same contract.
"""

import ctypes
import os
import threading
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.c_library import c_library
from sysid_bench.errors import UsageError
from sysid_bench.regressors.columns import Columns
from sysid_bench.regressors.kernel_layout import KernelLayout, columns_layout
from sysid_bench.types import Array, Trajectory

VARIABLE: Final = "SYSID_BENCH_KERNEL"
"""`numpy`, `compiled`, or one of `LEVELS`: which kernel this process takes; unset, the best."""

LEVELS: Final = {"x86-64-v4": "v4", "x86-64-v3": "v3", "baseline": "base"}
"""Instruction sets, best first, and what the functions compiled for them end in: AVX-512, AVX2
with FMA, and what every processor of the kind has."""

SOURCE: Final = Path(__file__).with_name("kernel.c")


@dataclass(frozen=True)
class KernelChoice:
    """Which kernel works in this process; `reason`: why it is NumPy where it is."""

    library: "Library | None"
    reason: str = ""

    def __str__(self) -> str:
        if self.library is None:
            return f"NumPy ({self.reason})"
        return f"compiled, {self.library.level}"


@cache
def selected_kernel() -> KernelChoice:
    """The kernel of this process; UsageError for a name in the variable that is none."""
    wanted = os.environ.get(VARIABLE, "")
    if wanted not in ("", "numpy", "compiled", *LEVELS):
        known = ", ".join(("numpy", "compiled", *LEVELS))
        raise UsageError(f"{VARIABLE} is {wanted!r}; it is unset or one of {known}.")
    if wanted == "numpy":
        return KernelChoice(None, f"{VARIABLE} asks for it")
    try:
        return KernelChoice(_load(wanted))
    except OSError as error:
        return KernelChoice(None, str(error))


def _load(wanted: str) -> "Library":
    """The library and the wanted instruction set, or the best; OSError with the reason."""
    dll = c_library(SOURCE, "libregressor", "kernel_source")
    usable = [level for level in LEVELS if _usable(dll, level)]
    if wanted in LEVELS and wanted not in usable:
        raise OSError(f"{wanted} is not among what this machine has: {', '.join(usable)}")
    return Library(dll, wanted if wanted in LEVELS else usable[0])


def _usable(dll: Any, level: str) -> bool:
    suffix = LEVELS[level]
    return hasattr(dll, f"work_{suffix}") and bool(dll.kernel_runs(suffix.encode()))


class _Motion(ctypes.Structure):
    _fields_ = (
        ("samples", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("q", "v", "a")),
    )


@dataclass(frozen=True, eq=False)
class Library:
    """The functions of one instruction set."""

    dll: Any
    level: str

    def rows(self, program: KernelLayout, motion: Trajectory) -> Array:
        """The values (program.size, N): rows of Y without their zeros."""
        out = np.empty((program.size, len(motion)))
        self._call("rows", program, motion, out)
        return out

    def dense(self, program: KernelLayout, motion: Trajectory, out: Array) -> Array:
        """Y (N, rows, p) with its zeros, into `out`."""
        self._call("dense", program, motion, program.runs, out, width=out.shape[2])
        return out

    def fold(self, program: KernelLayout, motion: Trajectory, b: Array, R: Sequence[Array]) -> None:
        """R (k + 1, k + 1) of each of the program's rows absorbs its rows of [Y | b], b (N, nv)."""
        factors = np.array([part.ctypes.data for part in R], dtype=np.uintp)
        to = (program.at, program.count + 1, program.rows)
        self._call("fold", program, motion, _plain(b), len(R), *to, factors)

    def torque(self, program: KernelLayout, motion: Trajectory, phi: Array) -> Array:
        """Rigid-body torque (N, nv) of the program's links with parameters phi (links, 10)."""
        out = np.empty(motion.v.shape)
        self._call("torque", program, motion, _plain(phi), out)
        return out

    def _call(
        self, name: str, program: KernelLayout, motion: Trajectory, *args: Any, width: int = 0
    ) -> None:
        q, v, a = (_plain(x) for x in (motion.q, motion.v, motion.a))
        span = _Motion(len(motion), *(x.ctypes.data for x in (q, v, a)))
        tree, plan = ctypes.byref(program.tree), ctypes.byref(program.plan)
        sizes = (ctypes.c_int64(program.size), ctypes.c_int64(width))
        size = self._function("work", ctypes.c_int64)(tree, *sizes)
        given = [_argument(x) for x in (*args, _desk(size))]
        self._function(name, None)(tree, plan, ctypes.byref(span), *given)

    def _function(self, name: str, answer: Any) -> Any:
        function = getattr(self.dll, f"{name}_{LEVELS[self.level]}")
        function.restype = answer
        return function


_DESKS: Final = threading.local()


def _desk(size: int) -> Array:
    """Room to work in, one per thread and kept: fresh memory costs more than the kernel."""
    if getattr(_DESKS, "room", np.zeros(0)).nbytes < size:
        _DESKS.room = np.empty(size, dtype=np.uint8)
    return _DESKS.room


def _argument(x: Any) -> Any:
    if isinstance(x, np.ndarray):
        return ctypes.c_void_p(x.ctypes.data)
    return ctypes.c_int64(x) if isinstance(x, int) else ctypes.byref(x)


def _plain(x: Array) -> Array:
    return np.ascontiguousarray(x, dtype=float)


_PROGRAMS: Final[weakref.WeakKeyDictionary[Any, dict[tuple[int, ...], KernelLayout]]] = (
    weakref.WeakKeyDictionary()
)


def layout_of(columns: Columns, rows: Sequence[int] | None = None) -> KernelLayout:
    """The program of some rows of the columns (None: all), made once."""
    wanted = tuple(range(len(columns.rows)) if rows is None else rows)
    made = _PROGRAMS.setdefault(columns, {})
    if wanted not in made:
        made[wanted] = columns_layout(columns, wanted)
    return made[wanted]
