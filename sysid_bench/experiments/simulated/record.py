"""Recordings of a plant that moves as an excitation says, as sensed and as filtered."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.evaluation.cramer_rao import torque_bound, white_bound
from sysid_bench.excitation.design_problem import DesignProblem
from sysid_bench.experiments.robot_cache import LoadedRobot
from sysid_bench.experiments.simulated.commanded import design_motion
from sysid_bench.experiments.simulated.ft_sensors import SensorMeasurement, decimated_motion
from sysid_bench.experiments.simulated.problem import (
    ProblemBuilder,
    regressor_blocks,
    scalar_positions,
)
from sysid_bench.experiments.spec import (
    ExperimentSpec,
    drift_seed,
    held_out_seed,
    motion_seed,
    noise_seed,
    run_seed,
)
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.processing import processing_of
from sysid_bench.simulation.force_torque import WRENCH_NOISE
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.plant import Plant
from sysid_bench.simulation.sensors import Noise, draw_noise, encoder_error, measure
from sysid_bench.tasks.task import Task
from sysid_bench.types import (
    Array,
    Controller,
    Oracle,
    Recording,
    Trajectory,
)

Briefed = Callable[[float], DesignProblem]
"""The brief of an experiment at a rate (Hz)."""


@dataclass(frozen=True, eq=False)
class SimulatedRobot:
    """A plant that moves as an excitation says."""

    spec: ExperimentSpec
    loaded: LoadedRobot
    plant: Plant
    design_problem: Briefed

    @cached_property
    def simulation(self) -> Any:
        """What moves it."""
        return self.loaded.build_plugin("simulation", self.spec.simulation)

    @property
    def decimation(self) -> int:
        """Steps of the simulation per sample of the recording."""
        return round(self.simulation.design_rate(self.spec.rate) / self.spec.rate)

    @cached_property
    def commanded(self) -> Trajectory:
        """The motion that is asked for."""
        brief = self.design_problem(self.simulation.design_rate(self.spec.rate))
        return design_motion(self.spec.excitation, self.loaded, brief, motion_seed(self.spec))

    def run(self, error: Array) -> tuple[Oracle, Controller | None]:
        """What happens where encoders err so much (N, n)."""
        if type(self.simulation) is Inverse:  # which no encoder disturbs
            return self._undisturbed, None
        oracle, controller = self.simulation.run(self.plant, self.commanded, error)
        return oracle, controller

    @cached_property
    def _undisturbed(self) -> Oracle:
        still = np.zeros((len(self.commanded), len(self.plant.robot.torque_dofs)))
        oracle: Oracle = self.simulation.run(self.plant, self.commanded, still)[0]
        return oracle


@dataclass(frozen=True)
class Repetition:
    """One recording of the commanded motion: the how manieth, and whether the payload is on."""

    index: int
    loaded: bool
    seed: int  # of its noise


def repetitions(spec: ExperimentSpec, task: Task) -> tuple[Repetition, ...]:
    """The recordings that an experiment makes, in order. The first loaded one has the noise that it
    has without the others: comparisons are paired."""
    order = spec.signals.get("runs", "B")
    if "A" in order and (not task.definition.supports_runs_without_payload or task.cuts):
        raise UnsupportedError(
            "Runs without the payload tell of the payload, from joint torques alone; the task is "
            f"{task.name!r}{' with sensors' if task.cuts else ''}."
        )
    if len(order) > 1 and spec.signals.get("contacts"):
        raise UnsupportedError(
            "Contact periods leave different samples of each run: take runs or contacts."
        )
    first = order.index("B")
    return tuple(
        Repetition(i, letter == "B", noise_seed(spec) if i == first else run_seed(spec, i))
        for i, letter in enumerate(order)
    )


@dataclass(frozen=True, eq=False)
class SampledRecording:
    """The recording as sensed and as filtered, and what only scoring may know of it."""

    raw: Recording
    recording: Recording
    oracle: Oracle
    every: int
    torque_std: Array  # (n,) of the torque noise
    correlation: float  # of that noise from sample to sample

    def cramer_rao_bound(self, posing: "ProblemBuilder") -> Array | None:
        """The Cramer-Rao bound (r,) as standard deviations where torque alone is noisy; None where
        a row has no noise of that kind, or the motion does not excite every direction."""
        if posing.task.cuts or not (self.torque_std[list(posing.row_indices)] > 0).all():
            return None
        return _bound(posing, self.oracle, self.every, tuple(self.torque_std), self.correlation)


@lru_cache(maxsize=2)
def _bound(
    posing: "ProblemBuilder", oracle: Oracle, every: int, std: tuple[float, ...], correlation: float
) -> Array | None:
    motion, places = decimated_motion(oracle.motion, every), posing.row_indices
    of_rows = np.array(std)[list(places)]
    if correlation == 0.0:
        found = white_bound(posing.build(motion, oracle.tau[::every]), of_rows)
    else:  # rows that are whitened in time are dense
        rows = regressor_blocks(posing.regression, places, posing.instruments, motion)
        found = torque_bound(rows, np.diag(of_rows**2), correlation)
    return None if found is None else np.sqrt(np.diag(found))


def record(
    spec: ExperimentSpec,
    take: SimulatedRobot,
    sensing: SensorMeasurement,
    turn: Repetition | None = None,
) -> SampledRecording:
    """The recording of one repeat, and of one of its runs where there are several."""
    place, seed = (0, noise_seed(spec)) if turn is None else (turn.index, turn.seed)
    robot, every, commanded = take.plant.robot, take.decimation, take.commanded
    noise = Noise(**{k: x for k, x in spec.noise.items() if k not in WRENCH_NOISE})
    processing = processing_of(spec.signals)
    rng = np.random.default_rng(seed)
    moving = robot.torque_dofs
    draws = draw_noise(len(commanded), len(range(0, len(commanded), every)), len(moving), rng)
    error = encoder_error(noise, draws)
    oracle, controller = take.run(error)
    if noise.quantum > 0:
        # Rounding depends on where the robot is: the positions of a first run tell, the second runs
        # with the loop seeing it.
        scalar = np.flatnonzero(np.isin(moving, robot.scalar_dofs))
        there = scalar_positions(robot, oracle.motion)[:, moving]
        error = encoder_error(noise, draws, there, scalar)
        oracle, controller = take.run(error)
        # Recorded is what is read where the robot was then: it lies on the encoder's grid.
        there = scalar_positions(robot, oracle.motion)[:, moving]
        error = encoder_error(noise, draws, there, scalar)
    torque_std = noise.torque_std(oracle.tau[::every])
    raw = measure(
        robot,
        oracle,
        error,
        torque_std * noise.in_time(draws.torque),
        every,
        # Without a controller the robot moves exactly as commanded: to tell would be the truth.
        None if controller is None else commanded,
        controller,
        ideal_rates=not processing.differentiate,
    )
    raw = sensing.measure(_drifted(spec, raw, place, noise.tau_drift), oracle, every)
    recording = _completed(robot, processing.apply(raw, robot.joints))
    return SampledRecording(raw, recording, oracle, every, torque_std, noise.tau_correlation)


def _drifted(spec: ExperimentSpec, recording: Recording, place: int, level: float) -> Recording:
    """The recording with torques that drift from the first run on; runs follow at once."""
    if level == 0.0:
        return recording
    slope = level * np.random.default_rng(drift_seed(spec)).normal(size=recording.tau.shape[1])
    start = place * len(recording) / recording.rate
    return replace(recording, tau=recording.tau + (recording.t + start)[:, None] * slope)


def _completed(robot: RobotModel, recording: Recording) -> Recording:
    """The recording with the joints that follow where filtered signals put the others."""
    if robot.coupling is None:
        return recording
    motion = robot.completed(recording.motion)
    return replace(recording, q=motion.q, v=motion.v, a=motion.a)


def held_out_motions(spec: ExperimentSpec, take: SimulatedRobot) -> dict[str, Oracle]:
    """Other motions of the same plant, exact: what scoring compares with."""
    motions: dict[str, Oracle] = {}
    for place, excitation in enumerate(spec.held_out):
        seed = held_out_seed(spec, place)
        motion = design_motion(excitation, take.loaded, take.design_problem(spec.rate), seed)
        still = np.zeros((len(motion), len(take.plant.robot.torque_dofs)))
        oracle, _ = Inverse().run(take.plant, motion, still)
        name = excitation["use"]
        motions[name if name not in motions else f"{name}-{place}"] = oracle
    return motions
