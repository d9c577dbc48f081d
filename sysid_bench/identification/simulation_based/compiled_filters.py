"""Python interface of the compiled Kalman filters, filters.c."""

import ctypes
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.identification.simulation_based.forward_model import check_code
from sysid_bench.instruction_sets import LEVELS, levelled_library
from sysid_bench.types import Array

SOURCE: Final = Path(__file__).with_name("filters.c")

INDEFINITE: Final = "The filter's covariance is not positive definite: the noise is too large."


@cache
def filters_library() -> tuple[Any, str] | None:
    """Return the compiled filters and the suffix of their functions; None where there are none."""
    try:
        dll, level = levelled_library(SOURCE, "libfilters", "filters_source")
    except OSError:
        return None
    return dll, LEVELS[level]


def run_filter(
    steps: Any, q: Array, noise: tuple[Array, Array], start: tuple[Array, Array],
    unscented: tuple[float, float] | None,
) -> tuple[Array, Array]:  # fmt: skip
    """Return mean (m,) and covariance (m, m) of [q v beta] after the last of the positions q
    (N, n), from those after the first one.

    `steps`: the compiled model; `noise` of positions and torques (n,). `unscented`: spread of the
    sigma points, and the further weight of the centre; None: the extended filter.
    """
    dll, suffix = filters_library() or (None, "")
    (N, n), mean, P = q.shape, start[0].copy(), start[1].copy()
    arrays = [np.ascontiguousarray(x, float) for x in (q, *noise)]
    step = steps.function("sensitivities" if unscented is None else "predict")
    tree, model = (ctypes.addressof(x._obj) for x in steps.arguments)
    function = ctypes.cast(step, ctypes.c_void_p)
    given = _Filter(n=n, r=len(mean) - 2 * n, samples=N, dt=steps.given["dt"])
    names = ("q", "q_noise", "tau_noise", "tree", "model", "step", "memory")
    addresses = (*(x.ctypes.data for x in arrays), tree, model, function, steps.memory)
    for name, address in zip(names, addresses, strict=True):
        setattr(given, name, address)
    work = getattr(dll, f"work_{suffix}")
    work.restype = ctypes.c_int64
    scratch = np.empty(work(ctypes.c_int64(n), ctypes.c_int64(len(mean) - 2 * n)))
    places = [ctypes.c_void_p(x.ctypes.data) for x in (mean, P, scratch)]
    settings = [] if unscented is None else [ctypes.c_double(x) for x in unscented]
    run = getattr(dll, f"{'extended' if unscented is None else 'unscented'}_{suffix}")
    run.restype = ctypes.c_int64
    code = run(ctypes.byref(given), *settings, *places)
    check_code(code)
    if code:
        raise EstimationError(INDEFINITE)
    return mean, P


class _Filter(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("n", "r", "samples")),
        ("dt", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in
          ("q", "q_noise", "tau_noise", "tree", "model", "step", "memory")),
    )  # fmt: skip
