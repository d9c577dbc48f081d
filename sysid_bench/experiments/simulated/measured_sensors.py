"""Force/torque sensors of a simulated experiment: their readings, exact and with errors."""

from dataclasses import dataclass, replace

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.experiments.processed_rows import sampled_motion
from sysid_bench.experiments.seed import noise_seed, seed_of, sensor_seed
from sysid_bench.experiments.simulated.built_plant import BuiltPlant
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.experiments.tasks.task import Task
from sysid_bench.models.sensor import end_body
from sysid_bench.simulation.wrench_sensors import (
    Contact,
    SensorError,
    contact_torque,
    random_wrench,
    sensor_error,
    sensor_wrench,
    wrench_noise,
)
from sysid_bench.types import Array, Oracle, Recording, Trajectory


@dataclass(frozen=True, eq=False)
class MeasuredSensors:
    """The sensors of a task on the moving plant. Without any, recordings are left as they are."""

    spec: ExperimentSpec
    built: BuiltPlant
    task: Task
    run: int = 0  # other runs of the same sensor have other noise

    def recording(self, raw: Recording, oracle: Oracle, decimation: int) -> Recording:
        """The recording `raw` of every `decimation`-th step of the plant's motion, with the
        readings of the sensors.

        Raises UnsupportedError for a contact in a simulation that does not feel it.
        """
        if not self.task.cuts:
            return raw
        # A stream of its own: a sensor leaves the noise of torques and encoders as it is.
        white = np.random.default_rng(seed_of(noise_seed(self.spec), "wrench", self.run))
        noise = wrench_noise(self.spec.noise)
        motion = sampled_motion(oracle.motion, decimation)
        contact = self._contact(motion)
        if contact is not None:
            # The motors hold the robot on its motion against the contact.
            plant = self.built.plant
            tau = plant.robot.reduced(motion.q, contact_torque(plant, contact, motion))
            raw = replace(raw, tau=raw.tau - self.built.coordinates.torque_to_model(tau))
        exact = _by_sensor(self._wrench(motion, contact))
        errors = _sensor_errors(self.spec, len(self.task.cuts))
        parts = [
            error.read(wrench, raw.t) + noise.white() * white.normal(size=wrench.shape)
            for error, wrench in zip(errors, exact, strict=True)
        ]
        rows = tuple(row for cut in self.task.cuts for row in cut.rows)
        return replace(raw, wrench=np.hstack(parts), wrench_rows=rows)

    def noise_free(self, oracle: Oracle) -> tuple[Trajectory, Array]:
        """The plant's motion as the model counts it, and the noise-free torques and wrenches (N,
        nv + 6 sensors), with the constant offsets of the sensors where those are among the
        unknowns."""
        seen = self.built.coordinates.to_model(oracle)
        if not self.task.cuts:
            return seen.motion, seen.tau
        wrench = self._wrench(oracle.motion)
        # Constant offsets are unknowns of a task that has more than ten parameters for each body.
        alone = self.task.definition.measures_sensor_only
        if alone and len(self.task.parameters) > 10 * len(self.task.bodies):
            wrench += self.task.truth.theta[10 * len(self.task.bodies) :]
        return seen.motion, np.hstack([seen.tau, wrench])

    def _wrench(self, motion: Trajectory, contact: Contact | None = None) -> Array:
        return sensor_wrench(self.built.plant, self.task.cuts, motion, contact)

    def _contact(self, motion: Trajectory) -> Contact | None:
        """A contact on the last body during the middle third of a motion."""
        force = wrench_noise(self.spec.noise).touch
        if force == 0.0:
            return None
        if self.spec.simulation["use"] != "inverse":
            raise UnsupportedError(
                "A contact (noise.touch) needs the simulation 'inverse': it moves no robot."
            )
        rng = np.random.default_rng(seed_of(noise_seed(self.spec), "touched", self.run))
        wrench, part = random_wrench(motion, force, rng), len(motion) // 3
        wrench[:part] = wrench[2 * part :] = 0.0
        return Contact(end_body(self.built.plant.robot, self.task.cuts[0]), wrench)


def sensor_offset(spec: ExperimentSpec, count: int) -> Array:
    """True offsets (6 count,) [n; f] of the measured sensor and of those that end its sub-tree."""
    return np.concatenate([error.offset for error in _sensor_errors(spec, count)])


def _sensor_errors(spec: ExperimentSpec, count: int) -> list[SensorError]:
    """Offset, drift, gain, crosstalk and mounting errors of each sensor of an experiment."""
    rng, noise = np.random.default_rng(sensor_seed(spec)), wrench_noise(spec.noise)
    return [sensor_error(noise, rng) for _ in range(count)]


def _by_sensor(wrenches: Array) -> list[Array]:
    return np.split(wrenches, wrenches.shape[1] // 6, axis=1)
