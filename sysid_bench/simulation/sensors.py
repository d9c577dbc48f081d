"""Sensor models of a robot: noisy and quantised encoders, noisy joint torques."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.spatial import composed_rotation, quaternion_of_rotation
from sysid_bench.types import Array, Controller, Oracle, Recording, Trajectory

_SMALLEST: Final = 1e-30
"""Least size of noise: squares and their inverses stay far from the ends of floats."""


@dataclass(frozen=True)
class Noise:
    """Sensor noise, as standard deviations.

    `q` (rad, m): white noise of encoders; `quantum` (rad, m): their resolution; `tau` (N m, N) or
    `tau_relative` (fraction of the joint's RMS torque in the noise-free training motion): torque
    noise; `tau_correlation`: correlation of torque noise between consecutive recorded samples, as a
    first-order autoregression; `tau_drift` (N m/s, N/s): torque drift of a joint.
    """

    q: float = 0.0
    tau: float = 0.0
    tau_relative: float = 0.0
    quantum: float = 0.0
    tau_drift: float = 0.0
    tau_correlation: float = 0.0

    def __post_init__(self) -> None:
        """Raise UsageError for a correlation outside of [0, 1) and for sizes of no sensor."""
        for name in ("q", "tau", "tau_relative", "quantum", "tau_drift"):
            size = getattr(self, name)
            if size and not _SMALLEST <= size <= 1 / _SMALLEST:
                raise UsageError(
                    f"The noise {name} = {size!r}: give 0, or a number from {_SMALLEST:g} to "
                    f"{1 / _SMALLEST:g}."
                )
        if not 0.0 <= self.tau_correlation < 1.0:
            raise UsageError(
                f"tau_correlation = {self.tau_correlation!r}: give a number from 0 (white noise) "
                "to below 1."
            )

    def torque_std(self, tau: Array) -> Array:
        """Return the standard deviation (n,) of torque noise for noise-free torques (N, n)."""
        return np.asarray(self.tau + self.tau_relative * np.sqrt((tau**2).mean(axis=0)))

    def torque_noise(self, white: Array) -> Array:
        """Return white draws w (N, n) with the correlation c of torque noise in time.

        e_t = c e_(t-1) + sqrt(1 - c^2) w_t with e_0 = w_0, so that the variance does not change.
        """
        if self.tau_correlation == 0.0:
            return white
        c = self.tau_correlation
        start = (1 - np.sqrt(1 - c**2)) * white[:1]
        return recursive_filter(np.sqrt(1 - c**2), c, white, start)


def recursive_filter(gain: float, pole: float, x: Array, start: Array) -> Array:
    """Return y (N, n) of y_t = pole y_(t-1) + gain x_t, where y_0 = gain x_0 + `start` (1, n)."""
    y, _ = scipy.signal.lfilter([gain], [1.0, -pole], x, axis=0, zi=start)
    return np.asarray(y)


@dataclass(frozen=True, eq=False)
class NoiseSamples:
    """Standard normal draws of one repeat, shared by all noise levels: `encoder` (N, rows) per
    control step, `torque` (K, rows) per recorded sample."""

    encoder: Array
    torque: Array


def noise_samples(count: int, recorded: int, rows: int, rng: np.random.Generator) -> NoiseSamples:
    """Return the draws for `count` control steps and `recorded` samples."""
    return NoiseSamples(rng.normal(size=(count, rows)), rng.normal(size=(recorded, rows)))


def position_error(
    noise: Noise,
    draws: NoiseSamples,
    q: Array | None = None,
    rounded: Array | slice = slice(None),
    repeated: Array | None = None,
) -> Array:
    """Return the error of every encoder reading (N, rows), rad or m.

    With positions q (N, rows) it includes quantisation, in the degrees of freedom `rounded`; the
    orientation of a floating base has no encoder. `repeated` (N, rows) are errors of the encoders
    that depend on the position.
    """
    error = noise.q * draws.encoder
    if repeated is not None:
        error = error + repeated
    # Quantisation rounds the noisy reading, so that its error depends on the position itself.
    if noise.quantum > 0 and q is not None:
        read = q[:, rounded] + error[:, rounded]
        error[:, rounded] = np.round(read / noise.quantum) * noise.quantum - q[:, rounded]
    return error


def measured_recording(
    robot: RobotModel,
    oracle: Oracle,
    error: Array,
    torque_error: Array,
    stride: int,
    commanded: Trajectory | None,
    controller: Controller | None,
    ideal_rates: bool,
) -> Recording:
    """Return the recording of every `stride`-th simulation step.

    `error` (N, n) is that of the encoders, `torque_error` (K, n) that of each recorded torque
    sample. With `ideal_rates`, exact v and a are recorded too. Dependent joints have no encoder:
    their positions follow from those of the independent joints.
    """
    motion = oracle.measured
    kept = slice(None, None, stride)
    step = motion.t[1] - motion.t[0]
    if robot.coupling is not None:
        error = robot.coupling.spread(error)
    q = with_position_error(robot, motion.q[kept], error[kept])
    read = robot.completed(Trajectory(motion.t[kept], q, motion.v[kept], motion.a[kept]))
    return Recording(
        t=motion.t[kept],
        q=read.q,
        tau=oracle.tau[kept] + torque_error,
        rate=float(1.0 / (stride * step)),
        rows=robot.torque_rows,
        v=read.v if ideal_rates else None,
        a=read.a if ideal_rates else None,
        commanded=commanded,
        controller=controller,
        period=motion.period,
    )


def with_position_error(robot: RobotModel, q: Array, error: Array) -> Array:
    """Return configurations (N, nq) with errors (N, nv): added to positions, and as rotation
    vectors in body axes to quaternions."""
    out = q.copy()
    for joint in robot.joints:
        qadr, dof = joint.qadr, joint.vadr
        if joint.kind in ("hinge", "slide"):
            out[:, qadr] += error[:, dof]
            continue
        if joint.kind == "free":
            out[:, qadr : qadr + 3] += error[:, dof : dof + 3]
            qadr, dof = qadr + 3, dof + 3
        out[:, qadr : qadr + 4] = composed_rotation(
            out[:, qadr : qadr + 4], quaternion_of_rotation(error[:, dof : dof + 3])
        )
    return out
