"""Python interface of the compiled regressor kernel, kernel.c.

One library holds the kernel once per instruction set; the best one that the processor supports is
used. If the library is missing, was compiled from another source or is switched off,
`select_kernel()` gives the reason, and the NumPy kernel computes the same values.
"""

import ctypes
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.instruction_sets import LEVELS, levelled_library
from sysid_bench.regressors.kernel_layout import Columns, KernelLayout, columns_layout
from sysid_bench.types import Array, Trajectory


@dataclass
class _Spent:
    seconds: float = 0.0
    lock: threading.Lock = field(default_factory=threading.Lock)


_SPENT: Final = _Spent()


def count_kernel(start: float) -> None:
    """Add the CPU time of the calling thread since `start`, of `time.thread_time()`."""
    with _SPENT.lock:
        _SPENT.seconds += time.thread_time() - start


def kernel_times() -> float:
    """CPU time (s) of the kernels in this process so far."""
    return _SPENT.seconds


SOURCE: Final = Path(__file__).with_name("kernel.c")

FEW: Final = 32
"""Most samples for which the functions compiled for few samples are the faster ones (measured on
each instruction set)."""


@dataclass(frozen=True)
class KernelSelection:
    """Kernel of this process: the compiled `library`, or NumPy with the `reason` for it."""

    library: "Library | None"
    reason: str = ""

    def __str__(self) -> str:
        if self.library is None:
            return f"NumPy ({self.reason})"
        return f"compiled, {self.library.level}"


@cache
def select_kernel() -> KernelSelection:
    """Return the kernel of this process; raises UsageError for an invalid environment variable."""
    try:
        library = levelled_library(SOURCE, "libregressor", "kernel_source")
        return KernelSelection(Library(*library))
    except OSError as error:
        return KernelSelection(None, str(error))


class _Motion(ctypes.Structure):
    _fields_ = (("samples", ctypes.c_int64), *((name, ctypes.c_void_p) for name in ("q", "v", "a")))


@dataclass(frozen=True, eq=False)
class Library:
    """Functions of the compiled kernel for one instruction set."""

    dll: Any
    level: str

    def rows(self, layout: KernelLayout, motion: Trajectory, out: Array | None = None) -> Array:
        """Return the values (layout.size, N), into `out` if it is given: rows of Y without their
        zeros."""
        out = np.empty((layout.size, len(motion))) if out is None else out
        self._call("rows", layout, motion, (out,))
        return out

    def dense(self, layout: KernelLayout, motion: Trajectory, out: Array) -> Array:
        """Return Y (N, rows, p) with its zeros, written into `out`."""
        self._call("dense", layout, motion, (layout.runs, out), width=out.shape[2])
        return out

    def update_factors(
        self, layout: KernelLayout, motion: Trajectory, b: Array, R: Sequence[Array]
    ) -> None:
        """Update each R (k + 1, k + 1) in place to the R factor of [R; Y_i | b_i], b (N, nv), for
        the rows i of the layout."""
        # An array of pointers: each row's factor lies in memory of its own.
        factors = np.array([part.ctypes.data for part in R], dtype=np.uintp)
        targets = (layout.starts, layout.count + 1, layout.rows)
        self._call("fold", layout, motion, (_contiguous(b), len(R), *targets, factors))

    def torque(self, layout: KernelLayout, motion: Trajectory, phi: Array) -> Array:
        """Return the rigid-body torque (N, nv) of the layout's links; phi (links, 10)."""
        out = np.empty(motion.v.shape)
        self._call("torque", layout, motion, (_contiguous(phi), out))
        return out

    def _call(
        self,
        name: str,
        layout: KernelLayout,
        motion: Trajectory,
        args: Sequence[Any],
        width: int = 0,
    ) -> None:
        # ctypes sees addresses alone: q, v, a and args keep their arrays alive during the call.
        q, v, a = (_contiguous(x) for x in (motion.q, motion.v, motion.a))
        span = _Motion(len(motion), *(x.ctypes.data for x in (q, v, a)))
        tree, plan = ctypes.byref(layout.tree), ctypes.byref(layout.plan)
        # The sums of a fold are those of whole blocks, however few samples there are.
        few = len(motion) <= FEW and name != "fold"
        size = self._functions["work", few](tree, layout.size, width)
        arguments = [_argument(x) for x in (*args, _workspace(size))]
        function = self._functions[name, few]
        start = time.thread_time()
        function(tree, plan, ctypes.byref(span), *arguments)
        count_kernel(start)

    @cached_property
    def _functions(self) -> dict[tuple[str, bool], Any]:
        """Functions of the library by name, as compiled for few samples and for blocks."""
        found, pointer, number = {}, ctypes.c_void_p, ctypes.c_int64
        for few in (False, True):
            suffix = LEVELS[self.level] + few * "_few"
            for name in ("rows", "dense", "fold", "torque", "work"):
                function = getattr(self.dll, f"{name}_{suffix}")
                function.restype = number if name == "work" else None
                found[name, few] = function
            found["work", few].argtypes = (pointer, number, number)
        return found

    def bound(self, layout: KernelLayout, motion: Trajectory, out: Array) -> Callable[[], None]:
        """Return `dense` with its arguments bound once, for contiguous arrays that the caller keeps
        and changes in place."""
        span = _Motion(len(motion), *(x.ctypes.data for x in (motion.q, motion.v, motion.a)))
        tree, plan = ctypes.byref(layout.tree), ctypes.byref(layout.plan)
        few = len(motion) <= FEW
        work = np.empty(self._functions["work", few](tree, layout.size, out.shape[2]), np.uint8)
        arguments = (tree, plan, ctypes.byref(span), *map(_argument, (layout.runs, out, work)))
        run = partial(self._functions["dense", few], *arguments)
        # Addresses keep nothing alive.
        run.owned = (layout, motion, out, work)  # type: ignore[attr-defined]
        return run


_WORKSPACES: Final = threading.local()


def _workspace(size: int) -> Array:
    """Scratch memory of the calling thread; kept, since fresh pages cost more than the kernel."""
    buffer: Array = getattr(_WORKSPACES, "buffer", np.zeros(0))
    if buffer.nbytes < size:
        buffer = _WORKSPACES.buffer = np.empty(size, dtype=np.uint8)
    return buffer


def _argument(x: Any) -> Any:
    if isinstance(x, np.ndarray):
        return ctypes.c_void_p(x.ctypes.data)
    return ctypes.c_int64(x) if isinstance(x, int) else ctypes.byref(x)


def _contiguous(x: Array) -> Array:
    return np.ascontiguousarray(x, dtype=float)


_LAYOUTS: Final[weakref.WeakKeyDictionary[Any, dict[tuple[int, ...], KernelLayout]]] = (
    weakref.WeakKeyDictionary()
)


def layout_of(columns: Columns, rows: Sequence[int] | None = None) -> KernelLayout:
    """Return the kernel layout of the given rows of `columns` (None: all); cached."""
    wanted = tuple(range(len(columns.rows)) if rows is None else rows)
    layouts = _LAYOUTS.setdefault(columns, {})
    if wanted not in layouts:
        layouts[wanted] = columns_layout(columns, wanted)
    return layouts[wanted]
