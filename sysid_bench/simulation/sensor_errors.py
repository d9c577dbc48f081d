"""Errors of encoders, torque sensing and logging: stages of the sensor chain (`sensors.py`)."""

from dataclasses import dataclass, field
from types import SimpleNamespace as Stage
from typing import ClassVar, Final

import numpy as np
import scipy

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.sensors import TorqueSignal
from sysid_bench.simulation.size import Size, check_size, joint_sizes
from sysid_bench.types import Array

HARMONICS = np.array([1.0, 2.0, 4.0])
"""Periods per revolution of the motor: offset of one phase, unequal phases, cogging."""


# Motor current varies with the motor's angle at equal torque.
@dataclass(frozen=True)
class CurrentRipple:
    """Reading tau (1 + sum_k a_k sin(k N q + p_k)) of each joint's torque with k = 1, 2, 4, the
    gear ratio `ratio` (N) and phases p_k drawn per robot.

    `once`, `twice` and `four_times` are the amplitudes a_k: 1 to 5 % (to be verified). Residuals of
    six recorded arms below 10 Hz hold at most 2 % of fine ripple: fast joints show it least.
    """

    once: Size = field(default=0.01, metadata={"unit": "%"})
    twice: Size = field(default=0.005, metadata={"unit": "%"})
    four_times: Size = field(default=0.005, metadata={"unit": "%"})
    ratio: Size = field(default=100.0, metadata={"unit": "1"})
    sizes: ClassVar[tuple[str, ...]] = ("once", "twice", "four_times")

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> Stage | None:
        """Return the stage; None where all amplitudes are zero."""
        rows = robot.torque_rows
        phase = rng.uniform(0.0, 2.0 * np.pi, size=(len(HARMONICS), len(rows)))
        *sizes, ratio = joint_sizes(self, rows, *self.sizes, "ratio")
        share, cycles = np.array(sizes), HARMONICS[:, None] * ratio

        def reading(signal: TorqueSignal, rng: np.random.Generator) -> Array:
            waves = share * np.sin(cycles * signal.q[:, None] + phase)
            return np.asarray(signal.tau * (1.0 + waves.sum(axis=1)))

        return Stage(torque_reading=reading) if share.any() else None


# Positions and torques are older than their stamps.
@dataclass(frozen=True)
class Delay:
    """Delay `q` of each joint's position and `tau` of its torque in the log; their difference is
    the skew between the channels. The controller has neither.

    Torques of single joints of recorded arms seem to lag by 15 to 60 ms, which friction mimics in
    part; buses skew channels by 1 to 8 ms (to be verified). Delays may be fractions of a sample.
    """

    q: Size = field(default=0.0, metadata={"unit": "s"})
    tau: Size = field(default=0.002, metadata={"unit": "s"})
    sizes: ClassVar[tuple[str, ...]] = ("q", "tau")

    def __post_init__(self) -> None:
        check_size("q of the sensor error 'delay'", self.q)
        check_size("tau of the sensor error 'delay'", self.tau)

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> Stage | None:
        """Return the stage; None where all delays are zero."""
        q, tau = joint_sizes(self, robot.torque_rows, "q", "tau")

        def ages(t: Array, rng: np.random.Generator) -> tuple[Array, Array]:
            return np.tile(q, (len(t), 1)), np.tile(tau, (len(t), 1))

        return Stage(sampling_delay=ages) if q.any() or tau.any() else None


# Position errors repeat with each revolution.
@dataclass(frozen=True)
class Eccentricity:
    """Error `amplitude` (sin(m q + p) - sin(p)) of each encoder, which the controller sees, too.

    m = `per_turn` are periods per revolution of the joint; phases p are drawn per robot.

    An encoder disc off its axis by e at the radius r errs by e / r once per revolution: 10 um at
    30 mm give 0.3 mrad (geometry; e to be verified). On the motor side `per_turn` is the gear
    ratio, and the error is divided by it. Slides repeat every 2 pi m / `per_turn`.
    """

    amplitude: Size = field(default=3e-4, metadata={"unit": "rad|m"})
    per_turn: Size = field(default=1.0, metadata={"unit": "1"})
    sizes: ClassVar[tuple[str, ...]] = ("amplitude",)

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> Stage | None:
        """Return the stage; None where the amplitude is zero. Balls and free joints have none."""
        rows = robot.torque_rows
        phase = rng.uniform(0.0, 2.0 * np.pi, size=len(rows))
        amplitude, turns = joint_sizes(self, rows, "amplitude", "per_turn")
        amplitude[~np.isin(robot.torque_dofs, robot.scalar_dofs)] = 0.0

        def error(q: Array) -> Array:
            # Zero at the reference, where encoders are set.
            return np.asarray(amplitude * (np.sin(turns * q + phase) - np.sin(phase)))

        return Stage(encoder_error=error) if amplitude.any() else None


# Samples are not taken when their stamps say.
@dataclass(frozen=True)
class Jitter:
    """Sampling at t + e with the stamp t; e is normal with the standard deviation `std`, and the
    same for all joints of a sample, which one clock takes.

    General-purpose operating systems have 0.1 to 1 ms (to be verified).
    """

    std: float = field(default=2e-4, metadata={"unit": "s"})
    sizes: ClassVar[tuple[str, ...]] = ("std",)

    def __post_init__(self) -> None:
        check_size("std of the sensor error 'jitter'", self.std)

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> Stage | None:
        """Return the stage; None without jitter."""
        joints = len(robot.torque_rows)

        def ages(t: Array, rng: np.random.Generator) -> tuple[Array, Array]:
            early = np.repeat(self.std * rng.normal(size=(len(t), 1)), joints, axis=1)
            return -early, -early

        return Stage(sampling_delay=ages) if self.std else None


ROWS: Final = ("deleted", "held")
"""Rows of lost samples: missing in the log and bridged linearly, as gaps of recorded logs are; or
holding the last sample again under their own stamps."""


@dataclass(frozen=True)
class LostSamples:
    """Loss of the fraction `share` of the samples, in gaps of `burst` samples on average; `rows`
    says what the log has in their place, "deleted" or "held".

    Buses and loggers under load lose 0.1 to 1 % (to be verified).
    """

    share: float = field(default=0.005, metadata={"unit": "%"})
    burst: float = field(default=1.0, metadata={"unit": "1"})
    rows: str = "held"
    sizes: ClassVar[tuple[str, ...]] = ("share",)

    def __post_init__(self) -> None:
        if not (0 <= self.share <= 0.5 and self.burst >= 1):
            raise UsageError(
                f"share = {self.share!r} and burst = {self.burst!r} of the sensor error "
                "'lost-samples': give a share from 0 to 50 %, in gaps of 1 sample or more."
            )
        if self.rows not in ROWS:
            raise unknown_name("kind of rows of the sensor error 'lost-samples'", self.rows, ROWS)

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> Stage | None:
        """Return the stage; None where nothing is lost."""
        return Stage(stored=self._stored) if self.share else None

    def _stored(self, count: int, rng: np.random.Generator) -> Array:
        """The sample of each row (count,), -1 where it is deleted; the first and the last one are
        never lost."""
        # A two-state chain (Gilbert 1960) with this share and mean gap.
        u, lost = rng.random(count), np.zeros(count, dtype=bool)
        end, begin = 1.0 / self.burst, self.share / (1.0 - self.share) / self.burst
        for k in range(1, count - 1):
            lost[k] = u[k] >= end if lost[k - 1] else u[k] < begin
        rows = np.arange(count)
        if self.rows == "deleted":
            return np.where(lost, -1, rows)
        # The last sample that was not lost, which the row repeats.
        return np.asarray(np.maximum.accumulate(np.where(lost, 0, rows)))


# Strain gauges and their amplifiers warm: readings drift linearly, and as a random walk.
@dataclass(frozen=True)
class TorqueDrift:
    """Drift `slope` (per second) of each joint's torque reading from the start of a recording, and
    a random walk with the standard deviation `walk` after one second.

    Strain-gauge torque sensors drift by 0.2 to 1 % of their range per hour (data sheets; to be
    verified): 100 N m sensors by 6e-5 to 3e-4 N m/s.
    """

    slope: Size = field(default=1e-4, metadata={"unit": "N m|N"})  # per second
    walk: Size = field(default=0.0, metadata={"unit": "N m|N"})  # per square root of a second
    sizes: ClassVar[tuple[str, ...]] = ("slope", "walk")

    def __post_init__(self) -> None:
        check_size("walk of the sensor error 'torque-drift'", self.walk)

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> Stage | None:
        """Return the stage; None where both drifts are zero."""
        slope, walk = joint_sizes(self, robot.torque_rows, "slope", "walk")

        def reading(signal: TorqueSignal, rng: np.random.Generator) -> Array:
            steps = np.diff(signal.t, prepend=signal.t[:1])[:, None]
            wiener = np.cumsum(np.sqrt(steps) * rng.normal(size=signal.tau.shape), axis=0)
            since = (signal.t - signal.t[0])[:, None]
            return np.asarray(signal.tau + slope * since + walk * wiener)

        return Stage(torque_reading=reading) if slope.any() or walk.any() else None


@dataclass(frozen=True)
class TorqueGain:
    """Relative error `gain` and constant error `offset` of each joint's torque reading.

    Torque constants of motors scatter by 2 to 5 %, and fall by 0.1 %/K as magnets warm (data
    sheets; to be verified).
    """

    gain: Size = field(default=0.03, metadata={"unit": "%"})
    offset: Size = field(default=0.0, metadata={"unit": "N m|N"})
    sizes: ClassVar[tuple[str, ...]] = ("gain", "offset")

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> Stage | None:
        """Return the stage; None where both errors are zero."""
        gain, offset = joint_sizes(self, robot.torque_rows, "gain", "offset")

        def reading(signal: TorqueSignal, rng: np.random.Generator) -> Array:
            return np.asarray((1.0 + gain) * signal.tau + offset)

        return Stage(torque_reading=reading) if gain.any() or offset.any() else None


# Noise of filtered amplifiers is coloured: a first-order process, whatever the sampling rate.
@dataclass(frozen=True)
class TorqueNoise:
    """Noise of each joint's torque reading with the standard deviation `std` plus the fraction
    `share` of the joint's RMS torque, and the correlation exp(-|s| / `time_constant`) over s
    seconds, whatever the rate.

    Residuals of six recorded arms lose their correlation (to 1/e) in 0.03 to 2.8 s, most of it
    unmodelled torque; that of the sensors alone is shorter.
    """

    std: Size = field(default=0.0, metadata={"unit": "N m|N"})
    share: Size = field(default=0.01, metadata={"unit": "%"})
    time_constant: Size = field(default=0.05, metadata={"unit": "s"})
    sizes: ClassVar[tuple[str, ...]] = ("std", "share")

    def __post_init__(self) -> None:
        check_size("std of the sensor error 'torque-noise'", self.std)
        check_size("share of the sensor error 'torque-noise'", self.share)
        if not (np.asarray(self.time_constant, dtype=float) > 0).all():
            raise UsageError(
                f"time_constant = {self.time_constant!r} of the sensor error 'torque-noise': give "
                "more than 0 s; white noise is noise.tau."
            )

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> Stage | None:
        """Return the stage; None where the deviations are zero."""
        names = ("std", "share", "time_constant")
        std, share, constant = joint_sizes(self, robot.torque_rows, *names)

        def reading(signal: TorqueSignal, rng: np.random.Generator) -> Array:
            # e_(k+1) = rho e_k + sqrt(1 - rho^2) s w_k from its stationary state.
            white = rng.normal(size=signal.tau.shape)
            rho = np.exp(-(signal.t[1] - signal.t[0]) / constant)
            noise = np.empty_like(white)
            for j, c in enumerate(rho):
                b = np.sqrt(1 - c**2)
                start = np.array([(1 - b) * white[0, j]])
                noise[:, j], _ = scipy.signal.lfilter([b], [1.0, -c], white[:, j], zi=start)
            return np.asarray(signal.tau + (std + share * signal.rms) * noise)

        return Stage(torque_reading=reading) if std.any() or share.any() else None
