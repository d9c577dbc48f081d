"""Simulation loop for state-dependent force laws, compiled if possible.

Force laws of this package have a `kind` and parameters `numbers`, and steps.c evaluates them
between MuJoCo's steps. With a law of a plug-in author, or without the library, the loop is in
Python.
"""

import ctypes
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.c_library import c_library
from sysid_bench.simulation.plant import Plant
from sysid_bench.types import Array

KINDS: Final = {"stribeck": 0, "coupled": 1}
"""Force laws that steps.c implements, with their codes there."""

SOURCE: Final = Path(__file__).with_name("steps.c")

Signals = tuple[Array, Array, Array, Array]


class _State(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("nq", "nv", "nu")),
        *((x, ctypes.c_void_p) for x in ("qpos", "qvel", "qacc", "actuator", "ctrl", "applied")),
    )


class _Record(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_void_p) for name in ("q", "v", "a", "tau"))


def simulate_steps(
    plant: Plant, mj: mujoco.MjModel, data: mujoco.MjData, t: Array, control: Array, each: int
) -> Signals:
    """Simulate from the state of `data` on; return q (N, nq), v, a and motor torque (N, nv).

    `t` (N,) are the sample times, `control` (N, nu) the inputs, each held for `each` steps of the
    model.
    """
    out = tuple(np.empty((len(t), size)) for size in (mj.nq, mj.nv, mj.nv, mj.nv))
    known = all(getattr(law, "kind", None) in KINDS for law in plant.laws)
    library = steps_library() if known else None
    run = _Run(plant, mj, data, control, each)
    if isinstance(library, ctypes.CDLL):
        _in_c(library, run, out)
    else:
        _in_python(run, t, out)
    return out  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class _Run:
    """One simulation: plant, its compiled model, state, inputs (N, nu) and steps per input."""

    plant: Plant
    mj: mujoco.MjModel
    data: mujoco.MjData
    control: Array
    each: int


@cache
def steps_library() -> Any:
    """Return the compiled loop, linked to MuJoCo's step; or the reason, as text, why there is
    none."""
    try:
        dll = c_library(SOURCE, "libsteps", "steps_source")
        dll.step = ctypes.cast(_engine().mj_step, ctypes.c_void_p)
    except (OSError, AttributeError) as error:
        return str(error)
    return dll


def _engine() -> ctypes.CDLL:
    """Shared library of MuJoCo that its Python bindings have loaded."""
    folder = Path(mujoco.__file__).parent
    found = [file for word in ("*mujoco.so*", "*mujoco*.dylib", "mujoco.dll")
             for file in sorted(folder.glob(word))]  # fmt: skip
    if not found:
        raise OSError(f"MuJoCo's library was not found in {folder}")
    return ctypes.CDLL(str(found[0]))


def _in_c(library: Any, run: _Run, out: tuple[Array, ...]) -> None:
    plant, mj, data = run.plant, run.mj, run.data
    arrays = (data.qpos, data.qvel, data.qacc, data.qfrc_actuator, data.ctrl, data.qfrc_applied)
    state = _State(mj.nq, mj.nv, mj.nu, *(x.ctypes.data for x in arrays))
    record = _Record(*(x.ctypes.data for x in out))
    # C sees addresses alone: these arrays have to live until the call returns.
    inputs = np.ascontiguousarray(run.control, float)
    constant = -np.asarray(plant.terms.offset, float)
    numbers = [np.ascontiguousarray(law.numbers, float) for law in plant.laws]
    kinds = np.array([KINDS[law.kind] for law in plant.laws], dtype=np.int64)
    addresses = np.array([x.ctypes.data for x in numbers], dtype=np.uintp)
    pointer, count = ctypes.c_void_p, ctypes.c_int64
    arguments = (
        *(library.step, pointer(mj._address), pointer(data._address), ctypes.byref(state)),
        *(count(len(inputs)), count(run.each)),
        *(pointer(x.ctypes.data) for x in (inputs, constant)),
        count(len(numbers)),
        *(pointer(x.ctypes.data) for x in (kinds, addresses)),
        ctypes.byref(record),
    )
    library.simulation_steps.restype = None
    library.simulation_steps(*arguments)


def _in_python(run: _Run, t: Array, out: tuple[Array, ...]) -> None:
    plant, mj, data = run.plant, run.mj, run.data
    for k, now in enumerate(t):
        data.ctrl[:] = run.control[k]
        out[0][k], out[1][k] = data.qpos, data.qvel
        for step in range(run.each):
            extra = plant.extra(now, data.qpos, data.qvel)
            data.qfrc_applied[:] = -plant.terms.offset - extra
            mujoco.mj_step(mj, data)
            # Accelerations and torques belong to the sampled state, before it is advanced.
            if step == 0:
                out[2][k], out[3][k] = data.qacc, data.qfrc_actuator
