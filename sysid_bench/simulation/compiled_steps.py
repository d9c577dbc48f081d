"""A simulation whose force laws look at each state: the loop over steps, compiled where it can be.

Laws of this package name themselves and their numbers, and steps.c evaluates them between MuJoCo's
steps; a stranger's law is a Python function, and then so is the loop, as without a compiler.
"""

import ctypes
from functools import cache
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.c_library import c_library
from sysid_bench.simulation.plant import Plant
from sysid_bench.types import Array

KINDS: Final = {"stribeck": 0, "coupled": 1}
"""Laws that steps.c knows, as it counts them."""

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
    """q (N, nq), v, a and motor torque (N, nv) at times t (N,) under inputs control (N, nu), held
    for `each` steps, from the state of `data` on."""
    out = tuple(np.empty((len(t), size)) for size in (mj.nq, mj.nv, mj.nv, mj.nv))
    known = all(getattr(law, "kind", None) in KINDS for law in plant.laws)
    library = steps_library() if known else None
    if isinstance(library, ctypes.CDLL):
        _in_c(library, plant, mj, data, control, each, out)
    else:
        _in_python(plant, mj, data, t, control, each, out)
    return out  # type: ignore[return-value]


@cache
def steps_library() -> Any:
    """The compiled loop with MuJoCo's step, or the reason (a text) why there is none."""
    try:
        dll = c_library(SOURCE, "libsteps", "steps_source")
        dll.step = ctypes.cast(_engine().mj_step, ctypes.c_void_p)
    except (OSError, AttributeError) as error:
        return str(error)
    return dll


def _engine() -> ctypes.CDLL:
    """The library that the Python bindings have loaded."""
    folder = Path(mujoco.__file__).parent
    found = [file for word in ("*mujoco.so*", "*mujoco*.dylib", "mujoco.dll")
             for file in sorted(folder.glob(word))]  # fmt: skip
    if not found:
        raise OSError(f"there is no library of MuJoCo in {folder}")
    return ctypes.CDLL(str(found[0]))


def _in_c(
    library: Any,
    plant: Plant,
    mj: mujoco.MjModel,
    data: mujoco.MjData,
    control: Array,
    each: int,
    out: tuple[Array, ...],
) -> None:
    arrays = (data.qpos, data.qvel, data.qacc, data.qfrc_actuator, data.ctrl, data.qfrc_applied)
    state = _State(mj.nq, mj.nv, mj.nu, *(x.ctypes.data for x in arrays))
    record = _Record(*(x.ctypes.data for x in out))
    inputs, constant = np.ascontiguousarray(control, float), -np.asarray(plant.terms.offset, float)
    numbers = [np.ascontiguousarray(law.numbers, float) for law in plant.laws]
    kinds = np.array([KINDS[law.kind] for law in plant.laws], dtype=np.int64)
    places = np.array([x.ctypes.data for x in numbers], dtype=np.uintp)
    pointer, count = ctypes.c_void_p, ctypes.c_int64
    library.simulation_steps.restype = None
    library.simulation_steps(
        library.step, pointer(mj._address), pointer(data._address), ctypes.byref(state),
        count(len(inputs)), count(each), pointer(inputs.ctypes.data), pointer(constant.ctypes.data),
        count(len(numbers)), pointer(kinds.ctypes.data), pointer(places.ctypes.data),
        ctypes.byref(record),
    )  # fmt: skip


def _in_python(
    plant: Plant,
    mj: mujoco.MjModel,
    data: mujoco.MjData,
    t: Array,
    control: Array,
    each: int,
    out: tuple[Array, ...],
) -> None:
    for k, now in enumerate(t):
        data.ctrl[:] = control[k]
        out[0][k], out[1][k] = data.qpos, data.qvel
        for step in range(each):
            extra = plant.extra(now, data.qpos, data.qvel)
            data.qfrc_applied[:] = -plant.terms.offset - extra
            mujoco.mj_step(mj, data)
            if step == 0:
                out[2][k], out[3][k] = data.qacc, data.qfrc_actuator
