"""Sensors: what a robot reports of what happened."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.spatial.rotation import product, quaternion_of_vector
from sysid_bench.types import Array, Controller, Oracle, Recording, Trajectory


@dataclass(frozen=True)
class Noise:
    """Standard deviations of noise: encoders `q` (rad, m), torque `tau` (N m, N) or `tau_relative`
    (share of the joint's RMS torque in the noise-free training motion), and the `quantum` that
    encoders round to (rad, m). White, but for torque whose noise has a `tau_correlation` from each
    recorded sample to the next: autoregressive of first order, of the same deviation.
    Torques drift by `tau_drift` (N m/s, N/s, standard deviation of a joint's)."""

    q: float = 0.0
    tau: float = 0.0
    tau_relative: float = 0.0
    quantum: float = 0.0
    tau_drift: float = 0.0
    tau_correlation: float = 0.0

    def __post_init__(self) -> None:
        """Raises UsageError for noise that never changes."""
        if not 0.0 <= self.tau_correlation < 1.0:
            raise UsageError(
                f"tau_correlation = {self.tau_correlation!r}: samples of noise are alike by a "
                "number from 0 (white) to below 1."
            )

    def torque_std(self, tau: Array) -> Array:
        """Standard deviation (n,) of the torque noise for noise-free torques (N, n)."""
        return self.tau + self.tau_relative * np.sqrt((tau**2).mean(axis=0))

    def in_time(self, white: Array) -> Array:
        """White draws (N, n) with the correlation of torque noise: e_t = c e_(t-1) +
        sqrt(1 - c^2) w_t, e_0 = w_0, so that every sample has the deviation of w."""
        if self.tau_correlation == 0.0:
            return white
        from scipy.signal import lfilter

        c = self.tau_correlation
        start = (1 - np.sqrt(1 - c**2)) * white[:1]
        scaled, _ = lfilter([np.sqrt(1 - c**2)], [1.0, -c], white, axis=0, zi=start)
        return np.asarray(scaled)


@dataclass(frozen=True, eq=False)
class NoiseDraws:
    """Standard normal draws of one repeat, (N, rows) each: shared by all noise levels."""

    encoder: Array
    torque: Array


def draw_noise(count: int, recorded: int, rows: int, rng: np.random.Generator) -> NoiseDraws:
    """Draws for `count` control steps and `recorded` samples."""
    return NoiseDraws(rng.normal(size=(count, rows)), rng.normal(size=(recorded, rows)))


def encoder_error(
    noise: Noise, draws: NoiseDraws, q: Array | None = None, rounded: Array | slice = slice(None)
) -> Array:
    """Error of every encoder reading (N, rows); with positions q (N, rows) that of rounding too, in
    the degrees of freedom `rounded` (an orientation has no encoder that counts)."""
    error = noise.q * draws.encoder
    if noise.quantum > 0 and q is not None:
        read = q[:, rounded] + error[:, rounded]
        error[:, rounded] = np.round(read / noise.quantum) * noise.quantum - q[:, rounded]
    return error


def measure(
    robot: RobotModel,
    oracle: Oracle,
    error: Array,
    torque_error: Array,
    every: int,
    commanded: Trajectory | None,
    controller: Controller | None,
    ideal_rates: bool,
) -> Recording:
    """The recording of every `every`-th step: encoders with their error (N, n), torque with that of
    each recorded sample (K, n). With `ideal_rates` v and a are reported exactly as well.

    Joints that follow others carry no encoder: what is recorded of them follows from the others.
    """
    motion = oracle.motion
    kept = slice(None, None, every)
    step = motion.t[1] - motion.t[0]
    if robot.coupling is not None:
        error = robot.coupling.spread(error)
    q = with_position_error(robot, motion.q[kept], error[kept])
    read = robot.completed(Trajectory(motion.t[kept], q, motion.v[kept], motion.a[kept]))
    return Recording(
        t=motion.t[kept],
        q=read.q,
        tau=oracle.tau[kept] + torque_error,
        rate=float(1.0 / (every * step)),
        rows=robot.torque_rows,
        v=read.v if ideal_rates else None,
        a=read.a if ideal_rates else None,
        commanded=commanded,
        controller=controller,
        period=motion.period,
    )


def with_position_error(robot: RobotModel, q: Array, error: Array) -> Array:
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
        out[:, at : at + 4] = product(
            out[:, at : at + 4], quaternion_of_vector(error[:, dof : dof + 3])
        )
    return out
