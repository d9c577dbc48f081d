"""Recordings of several training motions of one plant, and what is pooled of them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.experiments.seed import motion_noise_seed
from sysid_bench.experiments.simulated.measured_sensors import MeasuredSensors
from sysid_bench.experiments.simulated.noise_free import NoiseFreePart
from sysid_bench.experiments.simulated.record import (
    Repetition,
    SampledRecording,
    SimulatedRobot,
    record,
)
from sysid_bench.experiments.spec import MOTIONS, ExperimentSpec
from sysid_bench.types import Array


def recorded_motions(
    spec: ExperimentSpec, noise_free: NoiseFreePart, first: Repetition
) -> list[SampledRecording]:
    """The recording of each training motion, one after the other; `first` is that of the first.

    Raises UnsupportedError for tasks, runs and excitations that allow one motion alone.
    """
    trainings = noise_free.simulated_motions
    if MOTIONS in spec.redrawn:
        # The noise-free part is shared by all repeats, whose motions differ.
        trainings = tuple(replace(training, spec=spec) for training in trainings)
    _check_different(spec, noise_free, trainings)
    sensors = MeasuredSensors(spec, noise_free.simulated.built, noise_free.task)
    order = [first, *(Repetition(i, True, motion_noise_seed(spec, i)) for i in _further(spec))]
    return [
        record(spec, training, sensors, repetition)
        for training, repetition in zip(trainings, order, strict=True)
    ]


def _further(spec: ExperimentSpec) -> range:
    return range(1, spec.motions)


def _check_different(
    spec: ExperimentSpec, noise_free: NoiseFreePart, trainings: Sequence[SimulatedRobot]
) -> None:
    """Raise UnsupportedError where several motions cannot be used, or all are the same one."""
    if "runs" in spec.signals and (spec.motions > 1 or MOTIONS in spec.redrawn):
        raise UnsupportedError("Runs without the payload repeat one motion: leave out runs.")
    if spec.motions == 1:
        return
    if noise_free.task.cuts:
        raise UnsupportedError(
            f"motions = {spec.motions}: tasks with force/torque sensors take one training motion."
        )
    first, second = trainings[0].commanded, trainings[1].commanded
    if np.array_equal(first.q, second.q):
        raise UnsupportedError(
            f"motions = {spec.motions}: the excitation {spec.excitation['use']!r} gives the same "
            "motion for every seed. Choose one that draws it, as 'fourier', or motions = 1."
        )


def pooled_bound(bounds: Sequence[Array | None]) -> Array | None:
    """Standard deviations (r,) of the Cramer-Rao bound of all motions together, from the bounds
    (r, r) of each: information adds up. None where a motion has none."""
    known = [bound for bound in bounds if bound is not None]
    if not known or len(known) < len(bounds):
        return None
    if len(known) == 1:
        return np.sqrt(np.diag(known[0]))
    information = sum(np.linalg.inv(bound) for bound in known)
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(information))))


def mean_share(shares: Sequence[tuple[float, int]]) -> float:
    """Mean of (share, samples), weighted by the samples."""
    if len(shares) == 1:
        return shares[0][0]
    total = sum(samples for _, samples in shares)
    return sum(share * samples for share, samples in shares) / total if total else 0.0
