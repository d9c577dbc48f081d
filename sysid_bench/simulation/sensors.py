"""Sensors: what a robot reports of what happened."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import unknown_name
from sysid_bench.models.robot import RobotModel
from sysid_bench.spatial.rotation import product, quaternion_of_vector
from sysid_bench.types import Array, Controller, Oracle, Recording, Trajectory
from sysid_bench.units import quantity, split_quantity


@dataclass(frozen=True)
class Noise:
    """Standard deviations of white noise: encoders `q` (rad, m), torque `tau` (N m, N, or as a
    share of the joint's RMS torque in the noise-free training motion); `quantum` of the encoders."""

    q: float = 0.0
    tau: float = 0.0
    tau_relative: bool = False
    quantum: float = 0.0


def noise_of(spec: Mapping[str, object]) -> Noise:
    """A noise table of a suite, {q = "1e-4 rad", tau = "0.5 %", quantum = "0.001 deg"}."""
    for key in spec:
        if key not in ("q", "tau", "quantum"):
            raise unknown_name("noise setting", key, ("q", "tau", "quantum"))
    tau = spec.get("tau", 0.0)
    relative = isinstance(tau, str) and split_quantity(tau)[1] == "%"
    return Noise(
        q=quantity(spec.get("q", 0.0), "rad|m"),
        tau=quantity(tau, "1" if relative else "N m|N"),
        tau_relative=relative,
        quantum=quantity(spec.get("quantum", 0.0), "rad|m"),
    )


@dataclass(frozen=True, eq=False)
class Draws:
    """Standard normal draws of one repeat, (N, nv) each: shared by all noise levels."""

    encoder: Array
    torque: Array


def draw(count: int, recorded: int, nv: int, rng: np.random.Generator) -> Draws:
    """Draws for `count` control steps and `recorded` samples."""
    return Draws(rng.normal(size=(count, nv)), rng.normal(size=(recorded, nv)))


def encoder_error(noise: Noise, draws: Draws, q: Array | None = None) -> Array:
    """Error of every encoder reading (N, nv); with positions q (N, nv) that of rounding as well."""
    error = noise.q * draws.encoder
    if noise.quantum > 0 and q is not None:
        error = np.round((q + error) / noise.quantum) * noise.quantum - q
    return error


def sense(
    robot: RobotModel,
    oracle: Oracle,
    error: Array,
    torque_std: Array,
    draws: Draws,
    every: int,
    commanded: Trajectory,
    controller: Controller | None,
    ideal_rates: bool,
) -> Recording:
    """The recording of every `every`-th step: encoders with their error (N, nv), torque with white
    noise of `torque_std` (nv,). With `ideal_rates` v and a are reported exactly as well."""
    motion = oracle.motion
    kept = slice(None, None, every)
    step = motion.t[1] - motion.t[0]
    return Recording(
        t=motion.t[kept],
        q=displaced(robot, motion.q[kept], error[kept]),
        tau=oracle.tau[kept] + torque_std * draws.torque,
        rate=float(1.0 / (every * step)),
        rows=robot.rows,
        v=motion.v[kept] if ideal_rates else None,
        a=motion.a[kept] if ideal_rates else None,
        commanded=commanded,
        controller=controller,
        period=motion.period,
    )


def displaced(robot: RobotModel, q: Array, error: Array) -> Array:
    """Configurations (N, nq) moved by (N, nv): added to positions, turned onto quaternions."""
    out = q.copy()
    for joint in robot.joints:
        at, dof = joint.qadr, joint.vadr
        if joint.kind in ("hinge", "slide"):
            out[:, at] += error[:, dof]
            continue
        if joint.kind == "free":
            out[:, at : at + 3] += error[:, dof : dof + 3]
            at, dof = at + 3, dof + 3
        out[:, at : at + 4] = product(out[:, at : at + 4], quaternion_of_vector(error[:, dof : dof + 3]))
    return out
