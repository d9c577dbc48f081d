"""The force/torque sensors of an experiment: what they feel, ideally and as they were made."""

from dataclasses import dataclass, replace

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.experiments.spec import ExperimentSpec, noise_seed, seed_of, sensor_seed
from sysid_bench.models.sensor import last_body
from sysid_bench.simulation.force_torque import (
    Contact,
    SensorError,
    contact_torque,
    random_wrench,
    sensor_error,
    sensor_wrench,
    wrench_noise,
)
from sysid_bench.simulation.plant import Plant
from sysid_bench.tasks.task import Task
from sysid_bench.types import Array, Oracle, Recording, Trajectory


@dataclass(frozen=True, eq=False)
class SensorMeasurement:
    """The sensors that a task looks at, on the plant that moves; without any it changes nothing."""

    spec: ExperimentSpec
    plant: Plant
    task: Task
    run: int = 0  # further runs of the same sensor have noise of their own

    def measure(self, raw: Recording, oracle: Oracle, every: int) -> Recording:
        """A recording of every `every`-th step with the reading of the sensors."""
        if not self.task.cuts:
            return raw
        white = np.random.default_rng(seed_of(noise_seed(self.spec), "wrench", self.run))
        noise = wrench_noise(self.spec.noise)
        motion = decimated_motion(oracle.motion, every)
        touch = self._touch(motion)
        if touch is not None:
            taken = contact_torque(self.plant, touch, motion)
            raw = replace(raw, tau=raw.tau - self.plant.robot.reduced(motion.q, taken))
        exact = self._wrench(motion, touch)
        parts = [
            fault.measure(wrench, raw.t) + noise.white() * white.normal(size=wrench.shape)
            for fault, wrench in zip(
                sensor_errors(self.spec, len(self.task.cuts)), _by_sensor(exact), strict=True
            )
        ]
        rows = tuple(row for cut in self.task.cuts for row in cut.rows)
        return replace(raw, wrench=np.hstack(parts), wrench_rows=rows)

    def exact(self, oracle: Oracle) -> Array:
        """All that would be measured without noise (N, nv + 6 sensors); with the constants of the
        sensor where those are among the unknowns."""
        if not self.task.cuts:
            return oracle.tau
        wrench = self._wrench(oracle.motion)
        alone = self.task.definition.measures_sensor_only
        if alone and len(self.task.parameters) > 10 * len(self.task.bodies):
            wrench += self.task.truth.theta[10 * len(self.task.bodies) :]
        return np.hstack([oracle.tau, wrench])

    def _wrench(self, motion: Trajectory, touch: Contact | None = None) -> Array:
        return sensor_wrench(self.plant, self.task.cuts, motion, touch)

    def _touch(self, motion: Trajectory) -> Contact | None:
        """What touches the last body during the middle third of a motion."""
        force = wrench_noise(self.spec.noise).touch
        if force == 0.0:
            return None
        if self.spec.simulation["use"] != "inverse":
            raise UnsupportedError(
                "A touch (noise.touch) moves no robot: take the simulation 'inverse'."
            )
        rng = np.random.default_rng(seed_of(noise_seed(self.spec), "touched", self.run))
        wrench, part = random_wrench(motion, force, rng), len(motion) // 3
        wrench[:part] = wrench[2 * part :] = 0.0
        return Contact(last_body(self.plant.robot, self.task.cuts[0]), wrench)


def true_offset(spec: ExperimentSpec, count: int) -> Array:
    """The constants (6 count,) of the sensor that is measured, and of those that end its
    sub-tree."""
    return np.concatenate([fault.offset for fault in sensor_errors(spec, count)])


def sensor_errors(spec: ExperimentSpec, count: int) -> list[SensorError]:
    """How the sensors of an experiment were made."""
    rng, noise = np.random.default_rng(sensor_seed(spec)), wrench_noise(spec.noise)
    return [sensor_error(noise, rng) for _ in range(count)]


def _by_sensor(wrenches: Array) -> list[Array]:
    return np.split(wrenches, wrenches.shape[1] // 6, axis=1)


def decimated_motion(motion: Trajectory, every: int) -> Trajectory:
    """Every `every`-th sample of a motion."""
    part = slice(None, None, every)
    return replace(motion, t=motion.t[part], q=motion.q[part], v=motion.v[part], a=motion.a[part])
