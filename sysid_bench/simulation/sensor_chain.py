"""Sensor chain: errors between the simulated signals and the log.

Order: transducer (encoder and torque errors), sampling (delay, jitter), quantisation (that of the
[noise] table), loss. The controller sees errors of encoders, and neither delay nor loss of the log.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, Recording

RngOf = Callable[[int], np.random.Generator]
"""Random generator of one recording for the stage with this number."""


class _SensorDefect(Protocol):
    """Error of the sensor chain.

    `prepare(robot, rng)` returns a stage for the independent joints of a robot: an object with one
    or several of `encoder_error`, `torque_reading`, `sampling_delay` and `stored`; None for an
    error of size zero. Constants of a robot are drawn with `rng`, those of a recording with the
    generator that a stage is called with. `sizes` names the settings that are zero without the
    error.
    """

    sizes: ClassVar[tuple[str, ...]]

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> Any:
        """Return the stage of this error, or None."""
        ...


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


def sensor_chain(
    robot: RobotModel, errors: Sequence[_SensorDefect], rngs: Sequence[np.random.Generator]
) -> SensorChain:
    """Return the chain of a robot with these errors; their numbers stay those of the list."""
    prepared = (error.prepare(robot, rng) for error, rng in zip(errors, rngs, strict=True))
    return SensorChain(tuple(prepared))


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
