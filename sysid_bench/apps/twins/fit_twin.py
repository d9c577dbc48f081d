"""Twin of a robot from recordings: effects that cross-validation keeps, and coloured noise.

The noise is a sum of first-order processes that has the autocorrelation of the residual."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from scipy.optimize import nnls

from sysid_bench.apps.twins.effect_selection import (
    BASE,
    SHARPNESS,
    STEP_WIDTH,
    JointColumns,
    JointEffects,
    JointFit,
    JointLimits,
    JointSignals,
    effect_values,
    group_names,
    joint_signals,
    processed_recording,
    select_effects,
)
from sysid_bench.apps.twins.replay import Replay, replay_rate
from sysid_bench.errors import UsageError
from sysid_bench.experiments.recorded.process_log import LogProcessing, ProcessedLog
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import JointTerms
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.filter import Filter
from sysid_bench.simulation.effects.friction import rate_limit
from sysid_bench.simulation.motor_load import gravity_rms
from sysid_bench.types import Array

NOISE: Final = "torque-noise"
"""Sensor error of a plant file."""

WHITE: Final = 1e-5
"""Time constant (s) of a process that is white at any rate of a recording."""

CONSTANTS: Final = (WHITE, 0.02, 0.05, 0.15, 0.5, 1.5)
"""Time constants (s) of the processes; residuals of recorded arms forget in 0.03 to 2.8 s."""

LONGEST: Final = 3.0
"""Lag (s) up to which the autocorrelation is fitted."""


@dataclass(frozen=True, eq=False)
class ColouredNoise:
    """Standard deviations (len(CONSTANTS), n) of independent processes with each of CONSTANTS, for
    n joints."""

    std: Array

    def entries(self) -> list[dict[str, object]]:
        """Return the entries `torque-noise` of a plant, one for each time constant in use."""
        return [
            {"use": NOISE, "std": row.tolist(), "share": 0.0, "time_constant": constant}
            for constant, row in zip(CONSTANTS, self.std, strict=True)
            if row.any()
        ]


def coloured_noise(
    residuals: Sequence[Array], step: float, filter: Filter, rate: float
) -> ColouredNoise:
    """Return the noise that, sampled at `rate` (Hz) and filtered, has the level and the
    autocorrelation of the residual (N,) of each joint, a sample every `step` (s).

    The autocorrelation is a sum of those of the processes with weights that are not negative.
    """
    processes = []  # autocovariances up to LONGEST, of processes of variance 1 behind the filter
    for constant in CONSTANTS:
        # So long that the circular transform wraps nothing into the lags that are used.
        size = 1 << int(np.ceil(np.log2(max(8 * LONGEST, 8 * constant) * rate + 64)))
        impulse = np.zeros((size, 1))
        # In the middle: a zero-phase filter answers on both sides.
        impulse[size // 2] = 1.0
        gain = np.abs(np.fft.rfft(filter.smooth(impulse, rate)[:, 0])) ** 2
        pole = np.exp(-1.0 / (rate * constant))
        angle = 2 * np.pi * np.arange(len(gain)) / size
        # First-order autoregression of variance one.
        spectrum = (1 - pole**2) / (1 - 2 * pole * np.cos(angle) + pole**2)
        processes.append(np.fft.irfft(spectrum * gain, size)[: round(LONGEST * rate) + 2])
    columns = []
    for residual in residuals:
        std = np.zeros(len(CONSTANTS))
        columns.append(std)
        count = max(2, min(len(residual) // 4, round(LONGEST / step)))
        found = time_covariance(residual, count)
        if found[0] <= 0.0:
            continue
        lags = np.arange(count) * step
        basis = np.column_stack([np.interp(lags * rate, np.arange(len(x)), x) for x in processes])
        # The level counts as much as all lags together.
        weights = np.ones(count)
        weights[0] = np.sqrt(count)
        # Variances are not negative: without the constraint the sum may fit better, and be the
        # autocorrelation of no noise.
        variance, _ = nnls(basis * weights[:, None], found / found[0] * weights)
        # The fit need not meet lag zero: scaled to it, the noise has the RMS of the residual.
        level = float(basis[0] @ variance)
        if level > 0:
            std[:] = np.sqrt(variance * found[0] / level)
    return ColouredNoise(np.array(columns).T)


def time_covariance(x: Array, count: int) -> Array:
    """Return the biased autocovariance (count,) of x (N,) about zero, at lags of samples."""
    # Padded to twice the length: the transform is circular, a covariance is not. Divided by N at
    # every lag, it is positive semidefinite.
    size = 1 << (2 * len(x) - 1).bit_length()
    power = np.abs(np.fft.rfft(x, size)) ** 2
    return np.asarray(np.fft.irfft(power, size)[:count] / len(x))


OF_GRAVITY: Final = ("stribeck", "low-harmonics")
"""Begin of the groups whose size is a share of the torque of gravity."""


def with_friction(robot: RobotModel, fits: Mapping[str, JointFit]) -> RobotModel:
    """Return the robot with the viscous and Coulomb friction and the offset of each fit."""
    joints = dict(robot.manifest.joints)
    for name, fit in fits.items():
        own = {term: fit.values[term] for term in BASE}
        joints[name] = joints.get(name, JointTerms()).model_copy(update=own)
    return load_robot(replace(robot.manifest, joints=joints), robot.payload)


def plant_keys(
    robot: RobotModel, fits: Mapping[str, JointFit], noise: ColouredNoise
) -> dict[str, Any]:
    """Return the keys of the plant file of a robot that has the friction of the fits."""
    gravity, rows, measured = gravity_rms(robot, robot.mj), robot.rows, robot.torque_rows
    # Joints about vertical axes carry no gravity: shares of nothing would be infinite.
    force = np.maximum(gravity, 1e-3 * gravity.max())

    def sizes(column: str, joints: Sequence[str] = rows) -> Array:
        found = map(fits.get, joints)
        return np.array([0.0 if fit is None else fit.values.get(column, 0.0) for fit in found])

    def shapes(what: str, otherwise: float, joints: Sequence[str] = rows) -> list[float]:
        found = map(fits.get, joints)
        return [otherwise if fit is None else float(getattr(fit.effects, what)) for fit in found]

    def of_gravity(torque: Array) -> Array:
        """Torques (nv,) as shares of that of gravity, 0 where there is none."""
        return np.asarray(np.divide(torque, force, out=np.zeros_like(torque), where=force > 0))

    widths, vs = shapes("width", STEP_WIDTH), np.array(shapes("vs", 1.0))
    load, peak, viscous = sizes("load"), of_gravity(sizes("stribeck")), sizes("viscous")
    curve = sizes("curved") * rate_limit(robot) / np.where(viscous > 0, viscous, np.inf)
    slope, late = sizes("time", measured), shapes("delay", 0.0, measured)
    shape = {"vs": vs.tolist(), "v0": (vs / SHARPNESS).tolist()}
    effects: list[tuple[Any, dict[str, Any]]] = [
        (max(widths) > STEP_WIDTH, {"use": "play", "width": widths}),
        (load.any(), {"use": "load-friction", "coulomb": _percent(load), "width": widths}),
        (peak.any(), {"use": "stribeck", "share": _percent(peak), **shape}),
        (curve.any(), {"use": "curved-friction", "curvature": _percent(curve)}),
    ]
    effects += _harmonic_entries(sizes, of_gravity)
    sensors = [
        (slope.any(), {"use": "torque-drift", "slope": slope.tolist()}),
        (any(late), {"use": "delay", "tau": late}),
    ]
    return {
        "simulation": {"use": "inverse"},
        "effects": [entry for has_size, entry in effects if has_size] or ["matched"],
        "sensors": [*noise.entries(), *(entry for has_size, entry in sensors if has_size)],
    }


def _harmonic_entries(
    sizes: Callable[[str], Array], of_gravity: Callable[[Array], Array]
) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Presence and plant entry of the low harmonics of each order."""
    orders = dict.fromkeys(("first", "second", "third"), 0.0)
    for order, word in enumerate(orders, start=1):
        A, B = sizes(f"sin {order}"), sizes(f"cos {order}")
        # A sin(k q) + B cos(k q) is one wave sin(k (q + phase)): hence the phase over the order.
        phase, share = np.arctan2(B, A) / order, _percent(of_gravity(np.hypot(A, B)))
        entry = {"use": "low-harmonics", **orders, word: share, "phase": phase.tolist()}
        yield phase.any(), entry


def _percent(shares: Array) -> list[float]:
    """Shares as plant files write them without a unit."""
    return [100.0 * share for share in shares.tolist()]


SAMPLES: Final = 6000
"""Samples of a recording, about, that effects are fitted to: signals lie below 10 Hz."""

SHORTEST: Final = 3.0
"""s: all training recordings together, whose blocks of time decide on effects."""


@dataclass(frozen=True, eq=False)
class Twin:
    """A robot with its fitted friction, the keys of its plant file, and the fit of each joint."""

    robot: RobotModel
    plant: Mapping[str, Any]
    fits: Mapping[str, JointFit]
    rate: float  # Hz, of replays
    sizes: tuple[float, ...]  # RMS of the measured torque of each joint

    @property
    def left_out_residual(self) -> float:
        """RMS over joints of the residual on left-out blocks over the RMS torque."""
        parts = [fit.after / size for fit, size in zip(self.fits.values(), self.sizes, strict=True)]
        return float(np.sqrt(np.mean(np.square(parts))))

    @property
    def replay_plant(self) -> Replay:
        """The plant of replays."""
        return Replay(self.robot, self.plant)

    @property
    def noise_free_plant(self) -> Replay:
        """The plant of replays without coloured noise: what is repeated when a motion is."""
        sensors = [one for one in self.plant["sensors"] if one["use"] != NOISE]
        return Replay(self.robot, {**self.plant, "sensors": sensors})


def fit_twin(
    robot: RobotModel,
    logs: Sequence[ProcessedLog],
    preprocessing: LogProcessing,
    groups: Collection[str] | None = None,
) -> Twin:
    """Return the twin of `robot`, an identified model, from its training logs.

    `groups`: the effects that may be kept (None: all); without any it is the null twin, the robot
    with noise of the same residual. Raises UsageError for recordings that are too short.
    """
    recordings = [processed_recording(log, preprocessing) for log in logs]
    filter = preprocessing.processing.filter
    seconds = sum(float(np.ptp(one.t)) for one in recordings)
    if seconds < SHORTEST:
        raise UsageError(
            f"The recordings to fit last {seconds:.2g} s together; a twin needs {SHORTEST:g} s at "
            "least, so that its effects can be judged on parts that are left out: give a longer "
            "--log, or more of them."
        )
    signals = tuple(joint_signals(robot, one, filter) for one in recordings)
    step = max(1, round(sum(len(one.t) for one in signals) / SAMPLES))
    fits = {}
    for j, name in enumerate(robot.torque_rows):
        fastest, torque = (
            max(float(np.abs(getattr(one, x)[:, j]).max()) for one in signals) for x in ("v", "tau")
        )
        speed = max(float(rate_limit(robot)[robot.torque_dofs[j]]), fastest)
        fits[name] = select_effects(
            JointColumns(signals, j, step),
            _allowed(robot, name, groups),
            JointLimits(speed, torque),
        )
    # The twin has the friction that was fitted beside the effects, not that of the identified
    # model.
    own, rate = with_friction(robot, fits), replay_rate(signals[0].rate)
    # Effects explain a part of the robot's residual, noise makes up the rest: together they have
    # its level.
    residuals = [fit.residual for fit in fits.values()]
    noise = coloured_noise(residuals, step / signals[0].rate, filter, rate)
    rms = np.sqrt(np.mean(np.concatenate([one.tau for one in signals]) ** 2, axis=0))
    sizes = tuple(np.where(rms > 0.0, rms, 1.0).tolist())
    return Twin(own, plant_keys(own, fits, noise), fits, rate, sizes)


def without_effects(
    found: Twin, logs: Sequence[ProcessedLog], preprocessing: LogProcessing
) -> list[ProcessedLog]:
    """Return the training logs of a twin without the torque of its effects, so that bodies can be
    fitted to the rest."""
    filter = preprocessing.processing.filter
    left = []
    for log in logs:
        signals = joint_signals(found.robot, log.recording, filter)
        tau = torque_of_bodies(found.fits, signals)
        left.append(replace(log, recording=replace(log.recording, tau=tau)))
    return left


def torque_of_bodies(fits: Mapping[str, JointFit], signals: JointSignals) -> Array:
    """Return the measured torque (N, n) without what the kept effects add to viscous friction,
    sign(v) and offset, and in time."""
    left = []
    for j, name in enumerate(signals.joints):
        fit = fits[name]
        # Of BASE without the effects, and of all columns.
        friction, whole = (
            sum(fit.values[x] * effect_values(signals, j, x, effects) for x in effects.columns)
            for effects in (JointEffects(), fit.effects)
        )
        # The delay is undone first: the columns were fitted to that torque.
        tau = np.interp(signals.t + fit.effects.delay, signals.t, signals.tau[:, j])
        left.append(tau - np.asarray(whole - friction))
    return np.column_stack(left)


def _allowed(robot: RobotModel, row: str, groups: Collection[str] | None) -> list[str]:
    """Groups of a joint that may be kept; sizes of some refer to the torque of gravity."""
    # Robots that move in a horizontal plane carry no gravity: a share could refer to nothing.
    loaded = bool(gravity_rms(robot, robot.mj).any())
    hinges = {joint.dofs[0] for joint in robot.joints if joint.kind == "hinge"}
    known = [name for name in group_names(row in hinges) if groups is None or name in groups]
    return [name for name in known if loaded or not name.startswith(OF_GRAVITY)]
