"""Simulation loop for force laws, held torques and elastic transmissions, compiled if possible.

Force laws of this package have a `kind` and parameters `numbers`, and steps.c evaluates them
between MuJoCo's steps. With a law of a plug-in author, or without the library, the loop is in
Python.
"""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.package_folders import c_library
from sysid_bench.simulation.elastic_drives import Drive, MotorState
from sysid_bench.simulation.plant import Plant, start_states
from sysid_bench.types import Array

KINDS: Final = {
    "stribeck": 0, "coupled": 1, "lugre": 2, "friction": 3, "periodic": 4, "gravity spring": 5,
    "cables": 6,
}  # fmt: skip
"""Force laws that steps.c implements, with their codes there."""

INPUTS: Final = {"feedback": 0, "interpolated": 1, "held": 2}
"""Kinds of motor input, with their codes in steps.c."""

SOURCE: Final = Path(__file__).with_name("steps.c")


@dataclass(frozen=True, eq=False)
class Signals:
    """State before each sample's step: q (N, nq), v, a and motor torque tau (N, nv), of implicit
    integrators those that the step applies (`end_of_step`); positions,
    velocities and accelerations of elastic motors (N, n), referred to their joints; `unsolved`
    steps, whose friction is not that of the equation of motion. Of many plants: (K, ...) each."""

    q: Array
    v: Array
    a: Array
    tau: Array
    motor_q: Array
    motor_v: Array
    motor_a: Array
    unsolved: Array

    @classmethod
    def of_size(cls, N: int, mj: mujoco.MjModel, motors: int, *plants: int) -> "Signals":
        """Return room for N samples of a model, with `motors` elastic ones."""
        sizes = (mj.nq, mj.nv, mj.nv, mj.nv, motors, motors, motors)
        arrays = [np.empty((*plants, N, size)) for size in sizes]
        return cls(*arrays, *[np.zeros(plants, np.int64)])

    def of_plant(self, k: int) -> "Signals":
        """Return the signals of one of many plants."""
        return Signals(*(x[k] for x in vars(self).values()))


@dataclass(frozen=True, eq=False)
class CompiledRun:
    """One simulation: plant, compiled model and state, motors, the time of each sample (N,), inputs
    (N, nu) and steps of the model per sample."""

    plant: Plant
    mj: mujoco.MjModel
    data: mujoco.MjData
    drive: Drive
    t: Array
    control: Array
    each: int

    @property
    def motor_state(self) -> MotorState:
        """Motors at the start: aligned with their joints, the transmission relaxed."""
        dofs = self.drive.dofs
        return MotorState(np.array(self.data.qpos[dofs]), np.array(self.data.qvel[dofs]))


def run_steps(loop: CompiledRun) -> Signals:
    """Simulate from the state of the loop's data on."""
    N, mj = len(loop.t), loop.mj
    motors = mj.nu if loop.drive.transmission is not None else 0
    out = Signals.of_size(N, mj, motors)
    library = steps_library() if _is_compiled(loop.plant.laws) else None
    if isinstance(library, ctypes.CDLL):
        mj, data, plant = loop.mj, loop.data, loop.plant
        state = _State(
            mj.nq, mj.nv, mj.nu, *(getattr(data, x).ctypes.data for x in _State._arrays_)
        )
        record = _Record(*(getattr(out, name).ctypes.data for name in SIGNALS))
        # C sees addresses alone: these arrays have to live until the call returns.
        inputs = np.ascontiguousarray(loop.control, float)
        constant = -np.asarray(plant.terms.offset, float)
        laws = _Laws.of(plant.laws, data.qpos[: mj.nv], data.qvel, mj.dof_armature)
        drive = _Drive.of(loop.drive, damping_at_end(mj, loop.drive), torque_range(mj, loop.drive))
        rotors = np.concatenate([loop.motor_state.theta, loop.motor_state.rate])
        work = np.empty(mj.nv + 4 * mj.nu)
        count, number, reference = ctypes.c_int64, ctypes.c_double, ctypes.byref
        library.simulation_steps.restype = None
        library.simulation_steps(
            library.step, ctypes.c_void_p(mj._address), ctypes.c_void_p(data._address),
            reference(state), number(float(loop.t[0])), count(len(inputs)), count(loop.each),
            number(mj.opt.timestep), _pointer(inputs), _pointer(constant), reference(laws),
            reference(drive), _pointer(rotors), _pointer(work), reference(record),
        )  # fmt: skip
    else:
        with np.errstate(over="ignore", invalid="ignore"):  # of a loop that diverges
            _in_python(loop, out)
    return out


@cache
def steps_library() -> Any:
    """Return the compiled loop, linked to MuJoCo's step; or the reason, as text, why there is
    none."""
    try:
        dll = c_library(SOURCE, "libsteps", "steps_source")
        # Shared library of MuJoCo that its Python bindings have loaded.
        folder = Path(mujoco.__file__).parent
        found = [file for word in ("*mujoco.so*", "*mujoco*.dylib", "mujoco.dll")
                 for file in sorted(folder.glob(word))]  # fmt: skip
        if not found:
            raise OSError(f"MuJoCo's library was not found in {folder}")
        dll.step = ctypes.cast(ctypes.CDLL(str(found[0])).mj_step, ctypes.c_void_p)
    except (OSError, AttributeError) as error:
        return str(error)
    return dll


def compiled_torque(
    laws: Sequence[Any], t: Array, q: Array, v: Array, load: Array, each: int
) -> Array:
    """Return the torque (N, nv) of laws with states along a given motion.

    q, v and load (N, nv), by degree of freedom, are interpolated linearly at `each` steps between
    the uniform sample times t (N,).
    """
    h = float(t[1] - t[0]) / each if len(t) > 1 else 1e-3
    library = steps_library() if _is_compiled(laws) else None
    signals = [np.ascontiguousarray(x, float) for x in (q, v, load)]
    if not isinstance(library, ctypes.CDLL):
        states = start_states(laws, signals[0][0], signals[1][0])
        tau = np.empty_like(signals[1])
        for k, now in enumerate(t):
            following = min(k + 1, len(t) - 1)
            for i in range(each):
                q, v, load = (x[k] + i / each * (x[following] - x[k]) for x in signals)
                torque, states = states.step(h, now + i * h, q, v, load)
                if i == 0:
                    tau[k] = torque
        return tau
    tau, work = np.empty_like(signals[1]), np.empty((4, v.shape[1]))
    numbers = _Laws.of(laws, signals[0][0], signals[1][0], np.zeros(v.shape[1]))
    count, number = ctypes.c_int64, ctypes.c_double
    arguments = (
        ctypes.byref(numbers), number(float(t[0])), count(len(t)), count(each), number(h),
        count(v.shape[1]), *(_pointer(x) for x in (*signals, work, tau)),
    )  # fmt: skip
    library.laws_along.restype = None
    library.laws_along(*arguments)
    return tau


def _is_compiled(laws: Sequence[Any]) -> bool:
    return all(getattr(law, "kind", None) in KINDS for law in laws)


def _pointer(x: Array) -> ctypes.c_void_p:
    return ctypes.c_void_p(x.ctypes.data)


class _State(ctypes.Structure):
    _arrays_ = ("qpos", "qvel", "qacc", "qfrc_actuator", "qfrc_passive", "qfrc_constraint", "ctrl",
                "qfrc_applied")  # fmt: skip
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("nq", "nv", "nu")),
        *((name, ctypes.c_void_p) for name in _arrays_),
    )


SIGNALS: Final = ("q", "v", "a", "tau", "motor_q", "motor_v", "motor_a")
"""Recorded arrays, in the order of the C structs."""


class _Record(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_void_p) for name in SIGNALS)


class _Drive(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("nu", "input", "elastic")),
        *((name, ctypes.c_void_p) for name in
          ("dof", "kp", "kd", "limit", "low", "high", "stiffness", "damping", "gap", "inertia",
           "implicit")),
    )  # fmt: skip

    @classmethod
    def of(cls, drive: Drive, implicit: Array | None, limits: tuple[Array, Array]) -> "_Drive":
        """Addresses of a drive's arrays, which live as long as the result."""
        own, n = drive.transmission, len(drive.dofs)
        elastic = [np.zeros(n)] * 4 if own is None else [
            own.stiffness, own.damping, own.gap, own.inertia
        ]  # fmt: skip
        parts = [np.ascontiguousarray(drive.dofs, np.int64)] + [
            np.ascontiguousarray(x, float)
            for x in (drive.kp, drive.kd, drive.limit, *limits, *elastic)
        ]
        addresses = [x.ctypes.data for x in parts]
        if implicit is not None:
            parts.append(np.ascontiguousarray(implicit, float))
        addresses.append(0 if implicit is None else parts[-1].ctypes.data)
        made = cls(n, INPUTS[drive.input], int(own is not None), *addresses)
        made.parts = parts
        return made


class _Laws(ctypes.Structure):
    _fields_ = (
        ("count", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("kinds", "numbers", "states", "armature")),
    )

    @classmethod
    def of(cls, laws: Sequence[Any], q: Array, v: Array, armature: Array) -> "_Laws":
        """Addresses of the laws' numbers and states, which live as long as the result."""
        kinds = np.array([KINDS[law.kind] for law in laws], dtype=np.int64)
        numbers = [np.ascontiguousarray(law.numbers, float) for law in laws]
        states = [np.ascontiguousarray(x) for x in start_states(laws, q, v).states]
        addresses = [
            np.array([x.ctypes.data for x in arrays], dtype=np.uintp)
            for arrays in (numbers, states)
        ]
        own = np.ascontiguousarray(armature, float)
        made = cls(len(kinds), *(x.ctypes.data for x in (kinds, *addresses, own)))
        made.parts = (kinds, numbers, states, addresses, own)
        return made


def _in_python(loop: CompiledRun, out: Signals) -> None:
    mj, data, drive = loop.mj, loop.data, loop.drive
    implicit, limits = damping_at_end(mj, drive), torque_range(mj, drive)
    h, load, rotors = mj.opt.timestep, np.zeros(mj.nv), loop.motor_state
    laws = start_states(loop.plant.laws, data.qpos[: mj.nv], data.qvel)
    for k, now in enumerate(loop.t):
        out.q[k], out.v[k] = data.qpos, data.qvel
        if drive.transmission is not None:
            out.motor_q[k], out.motor_v[k] = rotors.theta, rotors.rate
        held = _held_torque(loop, k, rotors)
        for i in range(loop.each):
            torque, laws = laws.step(h, now + i * h, data.qpos, data.qvel, load)
            data.qfrc_applied[:] = -loop.plant.terms.offset - torque
            before, given = rotors, None
            u = _input(loop, k, i) if held is None else held
            if drive.transmission is None:
                data.ctrl[:] = u
            else:
                given, rotors = _drive_links(drive, data, u, rotors, h)
            mujoco.mj_step(mj, data)
            # Torque on the links (nv,): M a + bias without armature, by the equation of motion.
            forces = (
                data.qfrc_actuator + data.qfrc_applied + data.qfrc_passive + data.qfrc_constraint
            )
            load = np.asarray(forces - mj.dof_armature * data.qacc)
            # Accelerations and torques belong to the sampled state, before it is advanced.
            if i == 0:
                out.a[k], out.tau[k] = data.qacc, data.qfrc_actuator
                if implicit is not None:
                    change = data.qvel - out.v[k]
                    out.a[k] = change / h
                    out.tau[k] = end_of_step(out.tau[k], change, drive, implicit, limits)
                if given is not None:
                    out.tau[k, drive.dofs] = given
                    out.motor_a[k] = (rotors.rate - before.rate) / h


def damping_at_end(mj: mujoco.MjModel, drive: Drive) -> Array | None:
    """Return the damping (nv,) of the joints that an integrator takes at the end of its step, and
    with it that of the feedback; None for explicit integrators, and for elastic joints."""
    kinds = mujoco.mjtIntegrator
    if drive.transmission is not None:
        return None
    if mj.opt.integrator in (kinds.mjINT_IMPLICIT, kinds.mjINT_IMPLICITFAST):
        return np.array(mj.dof_damping)
    return None


def torque_range(mj: mujoco.MjModel, drive: Drive) -> tuple[Array, Array]:
    """Return the least and the largest torque (n,) of the motors: their own limit, or that of all
    actuators of their joint."""
    joints = mj.dof_jntid[drive.dofs]
    limited = mj.jnt_actfrclimited[joints].astype(bool)
    low, high = np.where(limited, mj.jnt_actfrcrange[joints].T, [[-np.inf], [np.inf]])
    return np.maximum(low, -drive.limit), np.minimum(high, drive.limit)


def end_of_step(
    tau: Array, change: Array, drive: Drive, implicit: Array, limits: tuple[Array, Array]
) -> Array:
    """Return the torque (..., nv) that an implicit step applies, from that at its start and the
    `change` (..., nv) of the rates over it; a motor at one of its `limits` has no rate feedback.

    M a + h(q, v) = tau then holds for the acceleration of the step. With the torque of the start a
    robot would seem heavier by a step times its damping: 3 % on the base of a UR3 (measured).
    """
    tau, own = tau.copy(), tau[..., drive.dofs]
    free = (own > limits[0]) & (own < limits[1])
    if drive.input != "held":
        tau[..., drive.dofs] -= np.where(free, drive.kd * change[..., drive.dofs], 0.0)
    return np.asarray(tau - implicit * change)


def _held_torque(loop: CompiledRun, k: int, rotors: MotorState) -> Array | None:
    """Feedback torque (n,) at the sampled state, for motors that hold it; else None."""
    drive, data = loop.drive, loop.data
    if not drive.held:
        return None
    if drive.transmission is not None:
        return drive.control_torque(loop.control[k], rotors.theta, rotors.rate)
    return drive.control_torque(loop.control[k], data.qpos[drive.dofs], data.qvel[drive.dofs])


def _input(loop: CompiledRun, k: int, i: int) -> Array:
    """Input (nu,) of the feedback in step i of sample k."""
    part = i / loop.each if loop.drive.smooth else 0.0
    following = loop.control[min(k + 1, len(loop.control) - 1)]
    return np.asarray(loop.control[k] + part * (following - loop.control[k]))


def _drive_links(
    drive: Drive, data: mujoco.MjData, u: Array, rotors: MotorState, h: float
) -> tuple[Array, MotorState]:
    """Apply the transmissions' torque to the links; return the motors' torque (n,), and the rotors
    after the step."""
    torque, load, turned = drive.step(rotors, u, data.qpos[drive.dofs], data.qvel[drive.dofs], h)
    data.qfrc_applied[drive.dofs] += load
    data.ctrl[:] = 0.0
    return torque, turned
