"""Readings of encoders and torque sensors along the motion of a plant, before they are recorded."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sysid_bench.experiments.simulated.built_plant import BuiltPlant
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.inverse import joint_positions
from sysid_bench.simulation.sensors import (
    EncoderStage,
    Noise,
    NoiseSamples,
    RngOf,
    SamplingStage,
    TorqueSignal,
    TorqueStage,
    position_error,
    sampled_with_delay,
)
from sysid_bench.types import Array, Controller, Oracle, Trajectory

Move = Callable[[Array], tuple[Oracle, Controller | None]]
"""Encoder errors (N, n) -> ground truth of the plant that moves with them, and its controller."""


@dataclass(frozen=True, eq=False)
class EncoderModel:
    """Encoders of the model's joints: white noise and rounding, and the errors of the chain."""

    built: BuiltPlant
    noise: Noise
    draws: NoiseSamples

    @property
    def has_position_error(self) -> bool:
        """True where the errors are known only with the motion."""
        return self.noise.quantum > 0 or self.built.chain.has(EncoderStage)

    def error(self, motion: Trajectory | None = None, every: int = 1) -> Array:
        """The errors (N, n) on a motion of every `every`-th step; None: those of any motion."""
        draws = replace(self.draws, encoder=self.draws.encoder[::every])
        if motion is None or not self.has_position_error:
            return position_error(self.noise, draws)
        robot, chain = self.built.model, self.built.chain
        q = _independent_positions(robot, motion)
        scalar = np.flatnonzero(np.isin(robot.torque_dofs, robot.scalar_dofs))
        repeated = chain.encoder_error(q) if chain.has(EncoderStage) else None
        return position_error(self.noise, draws, q, scalar, repeated)


@dataclass(frozen=True, eq=False)
class _EncoderRun:
    """A run whose loop saw the errors (N, n) of its encoders: the plant's ground truth `oracle`,
    the same as the model counts it (`seen`), and the controller."""

    encoders: EncoderModel
    oracle: Oracle
    seen: Oracle
    controller: Controller | None
    error: Array

    def read(self, rng_of: RngOf, every: int) -> "SampledSignals":
        """The signals of every `every`-th step after the transducers and the sampling."""
        built, signals = self.encoders.built, self.seen
        if built.chain.has(TorqueStage):
            signals = replace(signals, tau=self._torque(rng_of))
        if not built.chain.has(SamplingStage):
            return SampledSignals(signals, self.error, every)
        joints = len(built.model.torque_dofs)
        late_q, late_tau = built.chain.sampling_delay(signals.motion.t[::every], joints, rng_of)
        late = sampled_with_delay(built.model, signals, every, late_q, late_tau)
        # Encoders are read late, and then rounded: readings stay on their grid.
        return SampledSignals(late, self.encoders.error(late.motion, every), 1)

    def _torque(self, rng_of: RngOf) -> Array:
        built, seen = self.encoders.built, self.seen
        q = _independent_positions(built.model, seen.motion)
        rms = np.sqrt((seen.tau**2).mean(axis=0))
        return built.chain.torque_reading(TorqueSignal(seen.motion.t, q, seen.tau, rms), rng_of)


@dataclass(frozen=True, eq=False)
class SampledSignals:
    """Motion and torque as sampled, and the errors (N, n) of encoders; every `stride`-th of them
    is recorded."""

    signals: Oracle
    error: Array
    stride: int


def run_with_encoder_errors(encoders: EncoderModel, move: Move) -> _EncoderRun:
    """Move the plant with a loop that sees the errors of its encoders."""
    error = encoders.error()

    def seen_by_model(oracle: Oracle) -> Oracle:
        return encoders.built.coordinates.to_model(
            replace(oracle, motion=oracle.measured, encoders=None)
        )

    oracle, controller = move(error)
    if encoders.has_position_error:
        # The first run gives positions, the second one runs with the loop seeing their errors. The
        # recorded errors are those of its own positions, so that readings lie on the encoder's
        # grid.
        oracle, controller = move(encoders.error(seen_by_model(oracle).motion))
        error = encoders.error(seen_by_model(oracle).motion)
    return _EncoderRun(encoders, oracle, seen_by_model(oracle), controller, error)


def _independent_positions(robot: RobotModel, motion: Trajectory) -> Array:
    """Positions (N, n) of the joints with measured torque; zero for balls and free joints."""
    q: Array = joint_positions(robot, motion)[:, robot.torque_dofs]
    return q
