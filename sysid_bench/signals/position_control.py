"""Torque that a position controller commands, where a recording holds none."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.models.motor_table import Motor, motor
from sysid_bench.signals.filter import NoFilter, derivative
from sysid_bench.signals.log_checks import Finding, check_finite
from sysid_bench.signals.log_description import NO_JOINT, LogDescription
from sysid_bench.signals.log_keys import TOLD, PositionControl
from sysid_bench.signals.log_samples import Grid, RecordedBase, Samples
from sysid_bench.types import Array
from sysid_bench.units import quantity

PROFILE: Final = "profile"
"""Delay that is unknown, and found by a profile of the fit over it."""

DELAY: Final = "delay"
"""Name of the finding of such a delay."""


@dataclass(frozen=True, eq=False)
class Commands:
    """Recorded state and commands (N, k) of position-controlled `joints` on a uniform grid at
    `rate` (Hz): positions, velocities (None: not recorded), gains, feed-forward torque and torque
    `limit` (k,). `delay` (s) of the commands, None where it is unknown. `base`: recorded motion of
    a floating base (None: held). `line` (2, k): torque at rest and speed without load of motors,
    between which the largest torque falls (None: no motors are named); `armature` (2, k): that of
    their tables and its deviation, NaN where there is none; `band` (k,): position error without
    torque (None: zero). `magnitude` (N, k): sizes of currents or torques, without sign."""

    joints: tuple[str, ...]
    rate: float
    q: Array
    v: Array | None
    q_des: Array
    v_des: Array
    feedforward: Array
    kp: Array
    kd: Array
    limit: Array
    delay: float | None
    base: RecordedBase | None = None
    line: Array | None = None
    armature: Array | None = None
    band: Array | None = None
    magnitude: Array | None = None

    def __len__(self) -> int:
        return len(self.q)

    @property
    def velocity(self) -> Array:
        """Recorded velocities (N, k), else differences of the positions over five samples."""
        return derivative(NoFilter(), self.q, self.rate, 4) if self.v is None else self.v

    def select(self, rows: slice) -> "Commands":
        """Return some of the samples."""
        names = ("q", "q_des", "v_des", "feedforward", "kp", "kd")
        parts = {name: getattr(self, name)[rows] for name in names}
        if self.magnitude is not None:
            parts["magnitude"] = self.magnitude[rows]
        base = None if self.base is None else self.base.apply(lambda x: x[rows])
        return replace(self, **parts, v=None if self.v is None else self.v[rows], base=base)

    def of(self, joints: Sequence[str]) -> "Commands":
        """Return those of some joints, in their order."""
        columns = [self.joints.index(name) for name in joints]
        parts: dict[str, Any] = {
            k: x[..., columns] for k, x in vars(self).items() if isinstance(x, np.ndarray)
        }
        return replace(self, **parts, joints=tuple(joints))

    def torque(self, delay: float) -> Array:
        """Return the torque (N, k) for commands that act `delay` (s) after they were recorded.

        Each sample is the mean over its period: a command that is held from one sample to the next
        acts half a period later, on average, than its time stamp.
        """
        shift = delay * self.rate
        q_des, v_des, feedforward = (
            mean_of_held(x, shift) for x in (self.q_des, self.v_des, self.feedforward)
        )
        error = q_des - self.q
        if self.band is not None:
            error = error - np.clip(error, -self.band, self.band)
        tau = self.kp * error + self.kd * (v_des - self.velocity) + feedforward
        return np.asarray(np.clip(tau, *self.torque_limits(self.velocity)))

    def torque_limits(self, v: Array) -> tuple[Array, Array]:
        """Return the least and largest torque (..., k) at velocities (..., k)."""
        if self.line is None:
            return -self.limit, self.limit
        rest, fastest = self.line
        stated, limits = np.isfinite(rest), []
        for sign in (-1.0, 1.0):
            # Torque falls with the speed; one that is not known at rest is there below the fastest.
            share = sign * v / fastest
            falling = np.where(stated, rest, 0.0) * (1.0 - share)
            falling = np.where(stated, falling, np.where(share < 1.0, np.inf, 0.0))
            limits.append(np.minimum(self.limit, np.maximum(falling, 0.0)))
        return -limits[0], limits[1]


def mean_of_held(x: Array, shift: float) -> Array:
    """Return the mean of commands x (N, k) over the period about each sample (half before, half
    after), each held until the next and all `shift` samples late; the first acts from the start,
    the last to the end."""
    behind = shift + 0.5
    whole = int(np.floor(behind))
    # A period that starts within a held command sees the rest of it, then the next one.
    share = behind - whole
    # Commands that act before they are recorded: the last one is held beyond the end.
    late = np.arange(len(x)) - whole
    held, before = (np.clip(rows, 0, len(x) - 1) for rows in (late, late - 1))
    return np.asarray((1.0 - share) * x[held] + share * x[before])


def _stated_delay(log: LogDescription) -> float | None:
    """Return the delay (s) of a position controller, None where it is unknown.

    Raises UsageError for a negative one, and for another word.
    """
    assert log.tau.pd is not None
    written = log.tau.pd.delay
    if isinstance(written, str) and written.strip().isalpha():
        if written.strip() != PROFILE:
            error = unknown_name("delay", written, [PROFILE], "Or state a time, such as '5 ms'.")
            raise UsageError(f"{log.source}: tau.pd.delay: {error}")
        return None
    delay = quantity(written, "s")
    if delay < 0:
        raise UsageError(f"{log.source}: tau.pd.delay must not be negative; got {written!r}.")
    return delay


def unknown_delay(log: LogDescription, samples: int) -> list[Finding]:
    """Return the finding of commands whose delay is unknown, so that it counts as none."""
    if log.tau.pd is None or _stated_delay(log) is not None:
        return []
    text = (
        "the delay of the commands is unknown and counts as zero; state it, or find it by the task "
        "'actuators'"
    )
    return [Finding(DELAY, samples, text)]


def with_commanded_torque(log: LogDescription, samples: Samples, grid: Grid) -> Samples:
    """Return samples with the torque of their position controller; those of a log with measured
    torque as they are. An unknown delay counts as none.

    A lost command counts as the one before, and a lost state as one between its neighbours, so
    that the torque of valid samples is that of valid numbers.
    """
    if log.tau.pd is None:
        return samples
    whole: dict[str, Any] = {
        name: _without_gaps(x, held=name in TOLD) for name, x in samples.signals.items()
    }
    # Delays count samples of the file, whose stamps may jitter about their rate.
    rate = 1.0 / float(np.median(np.diff(grid.t)))
    commands = _commands(log, log.tau.pd, replace(samples, **whole), rate)
    return replace(samples, tau=commands.torque(_stated_delay(log) or 0.0))


def _without_gaps(x: Array, held: bool) -> Array:
    """Return x (N, k) with rows for those that hold no numbers: the last one before if `held`,
    else on the line between their neighbours."""
    valid = np.flatnonzero(np.logical_not(check_finite(x)))
    rows = np.arange(len(x))
    if held:
        return np.asarray(x[valid][np.maximum(np.searchsorted(valid, rows, side="right") - 1, 0)])
    return np.stack([np.interp(rows, valid, column[valid]) for column in x.T], axis=1)


def commands_of(log: LogDescription, samples: Samples, grid: Grid) -> Commands | None:
    """Return state and commands at the times of a grid; None for a log with measured torque.

    Unlike `Samples.at`, samples that repeat the position before are kept as they were recorded.
    """
    if log.tau.pd is None:
        return None
    at_grid = samples.at(grid)
    found = _commands(log, log.tau.pd, at_grid, grid.rate)
    v = None if samples.v is None else grid.interpolated(samples.v)
    found = replace(found, base=at_grid.base, q=grid.interpolated(samples.q), v=v)
    return found.of([name for name in log.joints if name != NO_JOINT])


def _commands(log: LogDescription, pd: PositionControl, samples: Samples, rate: float) -> Commands:
    """Return the commands in samples at a rate (Hz), held where the controller is slower."""
    assert samples.q_des is not None
    zeros, held = np.zeros_like(samples.q), _held_rows(log, pd, len(samples), rate)
    motors = None if pd.motor is None else _motors(log, pd)
    of_table: dict[str, Any] = {} if motors is None else of_motors(motors)
    # Limits that are stated, else those of motors, else infinite.
    if pd.limit is None and motors is not None:
        limit = largest_torque(motors)
    else:
        limit = log.joint_values("tau.pd.limit", (np.inf,) if pd.limit is None else pd.limit)
        if not (limit > 0.0).all():
            raise UsageError(f"{log.source}: tau.pd.limit must be positive; got {limit.tolist()}.")
    v_des, feedforward = (zeros if x is None else x for x in (samples.v_des, samples.feedforward))
    return Commands(
        joints=log.joints,
        rate=rate,
        q=samples.q,
        v=samples.v,
        q_des=samples.q_des[held],
        v_des=v_des[held],
        feedforward=feedforward[held],
        kp=_gains(log, pd, samples, "kp"),
        kd=_gains(log, pd, samples, "kd"),
        limit=limit,
        delay=_stated_delay(log),
        magnitude=samples.magnitude,
        **of_table,
    )


def _held_rows(log: LogDescription, pd: PositionControl, count: int, rate: float) -> Array:
    """Return the sample (N,) whose command a slower controller holds."""
    rows = np.arange(count)
    if pd.rate is None:
        return rows
    stated = quantity(pd.rate, "Hz")
    if stated <= 0:
        raise UsageError(f"{log.source}: tau.pd.rate must be positive; got {pd.rate!r}.")
    each = max(1.0, rate / stated)
    return np.asarray(np.ceil(np.floor(rows / each + 1e-9) * each - 1e-9), dtype=int)


def _gains(log: LogDescription, pd: PositionControl, samples: Samples, name: str) -> Array:
    """Return the gains (N, k); raises UsageError for negative ones, and for kp of zero."""
    written = getattr(pd, name)
    found = getattr(samples, name)
    if found is None:
        found = np.tile(log.joint_values(f"tau.pd.{name}", written), (len(samples), 1))
    if not ((found >= 0.0).all() and (name == "kd" or (found > 0.0).any(axis=0).all())):
        raise UsageError(
            f"{log.source}: tau.pd.{name} must be {'positive' if name == 'kp' else 'zero or more'} "
            f"(N m/rad or N m s/rad); got {float(np.min(found)):g}."
        )
    return np.asarray(found)


def _motors(log: LogDescription, pd: PositionControl) -> list[Motor | None]:
    """Return the motor of each joint, None where none is named."""
    names = pd.motor or ("",)
    if len(names) not in (1, len(log.joints)):
        raise UsageError(
            f"{log.source}: tau.pd.motor has {len(names)} names; write one, or one for each of the "
            f"{len(log.joints)} joints."
        )
    try:
        found = [motor(name) if name else None for name in names]
    except UsageError as error:
        raise UsageError(f"{log.source}: tau.pd.motor: {error}") from error
    return found * len(log.joints) if len(found) == 1 else found


def of_motors(motors: Sequence[Motor | None]) -> dict[str, Array]:
    """Return `line` and `armature` (2, k) of commands whose joints have these motors."""
    line = [(np.inf, np.inf) if m is None else (m.stall_torque, m.no_load_speed) for m in motors]
    armature = [
        (np.nan, np.nan) if m is None else (m.armature, m.armature * m.keys.spread) for m in motors
    ]
    return {"line": np.array(line).T, "armature": np.array(armature).T}


def largest_torque(motors: Sequence[Motor | None]) -> Array:
    """Return the largest torques (k,) of motors, infinite where none is named."""
    return np.array([np.inf if one is None else one.keys.peak_torque for one in motors])
