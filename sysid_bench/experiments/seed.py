"""Seeds of an experiment: each depends on those parts of the specification that it is named for."""

from typing import Any

from sysid_bench.canonical_json import canonical_hash
from sysid_bench.experiments.simulated.seed_hash import SEALED, seed_of_hash
from sysid_bench.experiments.spec import MOTIONS, PLANT, REDRAWN, ExperimentSpec


def seed_of(suite_seed: int, *parts: Any) -> int:
    """A 128-bit seed from the suite's and any JSON values."""
    return int(canonical_hash([suite_seed, *parts])[:32], 16)


def motion_seed(spec: ExperimentSpec, index: int = 0) -> int:
    """Seed of the training motion number `index`: payloads, tasks and noise share it, and so do all
    repeats unless motions are redrawn."""
    return seed_of(spec.seed, "motion", *_motion_parts(spec, index))


def other_motion_seed(spec: ExperimentSpec, index: int) -> int:
    """Seed of motion number `index` of the training's excitation, never one of the training."""
    return seed_of(spec.seed, "further motion", *_motion_parts(spec, index))


def _motion_parts(spec: ExperimentSpec, index: int) -> tuple[Any, ...]:
    parts: tuple[Any, ...] = (spec.seeded_robot, spec.excitation)
    if index > 0:
        parts += ({"motion": index},)
    if MOTIONS in spec.redrawn:
        parts += ({"repeat": spec.repeat},)
    return parts


def held_out_seed(spec: ExperimentSpec, index: int) -> int:
    """Seed of the held-out motion number `index`: never the training motion, whatever they are."""
    return seed_of(spec.seed, "held-out", spec.seeded_robot, spec.held_out[index], index)


def noise_seed(spec: ExperimentSpec) -> int:
    """Seed of the sensor noise: the same draw for every payload, level, estimator, prior and plant,
    so that their comparison is paired."""
    # Neither payload nor level: common random numbers reduce the variance of differences.
    parts = (spec.seeded_robot, spec.task, spec.excitation, spec.simulation, spec.rate, spec.repeat)
    return seed_of(spec.seed, "noise", *parts)


def sensor_seed(spec: ExperimentSpec) -> int:
    """Seed of the errors of a force/torque sensor: the same sensor for every payload, motion, task
    and level of its errors; another one for each repeat."""
    return seed_of(spec.seed, "sensor", spec.seeded_robot, spec.sensor, spec.repeat)


def run_seed(spec: ExperimentSpec, run: int) -> int:
    """Seed of the noise of a further recording of the same motion."""
    return seed_of(noise_seed(spec), "run", run)


def motion_noise_seed(spec: ExperimentSpec, index: int) -> int:
    """Seed of the noise in the recording of the training motion number `index`."""
    return noise_seed(spec) if index == 0 else seed_of(noise_seed(spec), "motion", index)


def drift_seed(spec: ExperimentSpec) -> int:
    """Seed of the torque drift: the same in all recordings of an experiment."""
    return seed_of(noise_seed(spec), "drift")


def plant_seed(spec: ExperimentSpec, *channel: Any) -> int:
    """Seed of one random size or direction of a plant: the same for every payload, task, motion and
    level of noise, and for all repeats unless `plant` is redrawn. That of a sealed plant depends
    on its secret, too."""
    parts = (spec.seeded_robot, *channel)
    if PLANT in spec.redrawn:
        parts += (spec.repeat,)
    if spec.plant.get(SEALED):
        parts += (seed_of_hash(str(spec.plant[SEALED])),)
    return seed_of(spec.seed, "plant", *parts)


def known_seed(spec: ExperimentSpec) -> int:
    """Seed of the errors of the known parts of a task, the same for every payload."""
    return seed_of(spec.seed, "known", spec.seeded_robot, spec.task)


def prior_seed(spec: ExperimentSpec) -> int:
    """Seed of the prior: the same for all noise levels, and for all repeats unless the prior is
    `redrawn`."""
    # One prior for all repeats: their scatter is then that of the noise alone.
    parts: tuple[Any, ...] = (spec.seeded_robot, spec.payload, spec.task)
    if not isinstance(spec.prior, str) and spec.prior.get(REDRAWN):
        parts += (spec.repeat,)
    return seed_of(spec.seed, "prior", *parts)
