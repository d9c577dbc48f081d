"""Sensors of a robot: noise, the chain of errors between signals and log, and sampling.

Order: transducer (encoder and torque errors), sampling (delay, jitter), quantisation (that of the
[noise] table), loss. The controller sees errors of encoders, and neither delay nor loss of the log.

`prepare(robot, rng)` of a sensor error returns a stage for the independent joints of a robot: an
object with one or several of `encoder_error`, `torque_reading`, `sampling_delay` and `stored`; None
for an error of size zero. Constants of a robot are drawn with `rng`, those of a recording with the
generator that a stage is called with.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final, Protocol, runtime_checkable

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


def position_error(
    noise: Noise,
    draws: Array,
    q: Array | None = None,
    rounded: Array | slice = slice(None),
    repeated: Array | None = None,
) -> Array:
    """Return the error of every encoder reading (N, rows), rad or m, from standard normal draws.

    With positions q (N, rows) it includes quantisation, in the degrees of freedom `rounded`; the
    orientation of a floating base has no encoder. `repeated` (N, rows) are errors of the encoders
    that depend on the position.
    """
    error = noise.q * draws
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


def sampled_with_delay(
    robot: RobotModel, oracle: Oracle, every: int, late_q: Array, late_tau: Array
) -> Oracle:
    """Return every `every`-th sample of motion and torque as they were `late_q` and `late_tau`
    (K, n) seconds before, under the present stamps.

    Positions and rates are cubic between steps, accelerations and torques linear. Before its first
    sample a periodic motion is taken to have run, and any other to have stood at it.
    """
    motion, dofs = oracle.motion, robot.torque_dofs
    stamps = motion.t[::every]
    times = np.repeat(stamps[:, None], robot.nv, axis=1)
    times[:, dofs] = _within(motion, stamps[:, None] - late_q)
    tau = _linear(motion.t, oracle.tau, _within(motion, stamps[:, None] - late_tau))
    # The motion with each degree of freedom at times (K, nv) of its own
    before = np.clip(np.searchsorted(motion.t, times, side="right") - 1, 0, len(motion) - 1)
    columns = np.arange(robot.nv)
    since, v, a = times - motion.t[before], motion.v[before, columns], motion.a[before, columns]
    # Balls and free joints turn on with the rate and acceleration of the step before.
    turned = (v + 0.5 * a * since) * since
    turned[:, robot.scalar_dofs] = 0.0
    # Configurations (K, nq), each joint of step `before` (K, nv)
    positions_before: Array = motion.q[before[:, 0]]
    widths = {"hinge": 1, "slide": 1, "ball": 4, "free": 7}
    for joint in robot.joints:
        part = slice(joint.qadr, joint.qadr + widths[joint.kind])
        positions_before[:, part] = motion.q[before[:, joint.vadr], part]
    q = with_position_error(robot, positions_before, turned)
    v = v + a * since
    for joint in robot.joints:
        if joint.kind in ("hinge", "slide"):
            x, dof = motion.q[:, joint.qadr], joint.vadr
            rate, slope = motion.v[:, dof], motion.a[:, dof]
            q[:, joint.qadr] = scipy.interpolate.CubicHermiteSpline(motion.t, x, rate)(
                times[:, dof]
            )
            v[:, dof] = scipy.interpolate.CubicHermiteSpline(motion.t, rate, slope)(times[:, dof])
    return Oracle(replace(motion, t=stamps, q=q, v=v, a=_linear(motion.t, motion.a, times)), tau)


def _within(motion: Trajectory, times: Array) -> Array:
    """Times (K, n) within a motion: one period later, or its first or last sample."""
    first, last = motion.t[0], motion.t[-1]
    if motion.period is not None:
        times = np.where(times < first, times + motion.period, times)
    return np.asarray(np.clip(times, first, last))


def _linear(t: Array, x: Array, times: Array) -> Array:
    """Columns of x (N, n) at times (K, n) of their own."""
    columns = [np.interp(times[:, j], t, x[:, j]) for j in range(x.shape[1])]
    return np.stack(columns, axis=1)


RngOf = Callable[[int], np.random.Generator]
"""Random generator of one recording for the stage with this number."""


@runtime_checkable
class EncoderStage(Protocol):
    """Errors of encoders that depend on the position; the controller sees them."""

    def encoder_error(self, q: Array) -> Array:
        """Return the error (N, n), rad or m, at positions q (N, n)."""
        ...


@dataclass(frozen=True, eq=False)
class TorqueSignal:
    """Torque of the independent joints on the time grid of the simulation: t (N,), q (N, n), tau
    (N, n) as read so far, and the exact `rms` (n,) of the recording."""

    t: Array
    q: Array
    tau: Array
    rms: Array


@runtime_checkable
class TorqueStage(Protocol):
    """Errors of torque or current sensing."""

    def torque_reading(self, signal: TorqueSignal, rng: np.random.Generator) -> Array:
        """Return the torque (N, n) as it is read."""
        ...


@runtime_checkable
class SamplingStage(Protocol):
    """Errors of the sampling times."""

    def sampling_delay(self, t: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return by how much the positions and the torques, (K, n) each, are older than their
        stamps t (K,), s."""
        ...


@runtime_checkable
class LossStage(Protocol):
    """Loss and repetition of rows of the log."""

    def stored(self, count: int, rng: np.random.Generator) -> Array:
        """Return the sample that each of `count` rows holds; -1 for a row that is missing."""
        ...


@dataclass(frozen=True, eq=False)
class SensorChain:
    """The prepared stages of a robot's sensors, in the order in which they are listed."""

    stages: tuple[Any, ...] = ()

    @property
    def is_exact(self) -> bool:
        """True without any error."""
        return all(stage is None for stage in self.stages)

    def has(self, kind: Any) -> bool:
        """Return True where a stage is of a kind, such as `SamplingStage`."""
        return any(isinstance(stage, kind) for stage in self.stages)

    def encoder_error(self, q: Array) -> Array:
        """Return the error (N, n) of encoders at positions q (N, n)."""
        total = np.zeros_like(q)
        for _, stage in self._of(EncoderStage):
            total = total + stage.encoder_error(q)
        return total

    def torque_reading(self, signal: TorqueSignal, rng_of: RngOf) -> Array:
        """Return the torque (N, n) as it is read on the time grid of the simulation."""
        for k, stage in self._of(TorqueStage):
            signal = replace(signal, tau=stage.torque_reading(signal, rng_of(k)))
        return signal.tau

    def sampling_delay(self, t: Array, joints: int, rng_of: RngOf) -> tuple[Array, Array]:
        """Return the age (K, n) of positions and of torques at their stamps t (K,), s."""
        q, tau = np.zeros((len(t), joints)), np.zeros((len(t), joints))
        for k, stage in self._of(SamplingStage):
            late_q, late_tau = stage.sampling_delay(t, rng_of(k))
            q, tau = q + late_q, tau + late_tau
        return q, tau

    def stored(self, recording: Recording, rng_of: RngOf) -> Recording:
        """Return the recording with its lost rows bridged linearly and its held ones repeated."""
        for k, stage in self._of(LossStage):
            recording = _stored(recording, stage.stored(len(recording), rng_of(k)))
        return recording

    def _of(self, kind: Any) -> list[tuple[int, Any]]:
        return [(k, stage) for k, stage in enumerate(self.stages) if isinstance(stage, kind)]


def _stored(recording: Recording, source: Array) -> Recording:
    """The recording with row k holding sample source[k]; rows of -1 are bridged, as those that are
    missing in a log are."""
    t, kept = recording.t, source >= 0

    def stored(x: Array | None) -> Array | None:
        if x is None:
            return None
        out: Array = x[np.maximum(source, 0)]
        for column in range(x.shape[1]):
            out[~kept, column] = np.interp(t[~kept], t[kept], out[kept, column])
        return out

    signals = {name: stored(getattr(recording, name)) for name in ("q", "tau", "v", "a", "wrench")}
    return replace(recording, **signals)  # type: ignore[arg-type]
