"""Force/torque sensors: what MuJoCo's own force and torque sensors give, and how real ones err."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Final

import mujoco
import numpy as np

from sysid_bench.models.sensor import SensorCut
from sysid_bench.simulation.plant import Plant, check_finite
from sysid_bench.spatial.rotation import (
    matrix_of_quaternion,
    quaternion_of_matrix,
    quaternion_of_vector,
)
from sysid_bench.types import Array, Trajectory

LEVER: Final = 0.1
"""Moment per force (m) in the ranges of common six-axis sensors: the scale of crosstalk."""

SITE: Final = "force/torque sensor {}"


@dataclass(frozen=True, eq=False)
class Contact:
    """An external wrench (N, 6) [n; f] on `body`, about its origin, in its axes."""

    body: int
    wrench: Array


def sensor_wrench(
    plant: Plant, cuts: Sequence[SensorCut], motion: Trajectory, touch: Contact | None = None
) -> Array:
    """What ideal sensors measure (N, 6 sensors), [n; f] each, along an exact motion.

    The model is a copy with a site, a force and a torque sensor per cut; rotors (armature) and
    friction act inside of the joints and are not felt beyond them.
    """
    spec = plant.robot.spec.copy()
    for k, cut in enumerate(cuts):
        _add_sensor(spec, plant.robot.body_names[cut.body], cut, SITE.format(k))
    mj = plant.compiled(spec)
    data = mujoco.MjData(mj)
    places = _sensor_addresses(mj, len(cuts))
    out = np.empty((len(motion), len(places)))
    for k in range(len(motion)):
        data.qpos[:], data.qvel[:], data.qacc[:] = motion.q[k], motion.v[k], motion.a[k]
        if touch is not None:
            mujoco.mj_kinematics(mj, data)
            data.xfrc_applied[touch.body + 1] = _at_com(data, touch.body + 1, touch.wrench[k])
        mujoco.mj_inverse(mj, data)
        out[k] = data.sensordata[places]
    return check_finite(plant.robot.name, out, "sensor wrench")


def contact_torque(plant: Plant, touch: Contact, motion: Trajectory) -> Array:
    """Generalised force (N, nv) of an external wrench: what it takes off the joints."""
    mj = plant.fixed_contact_free_model
    data = mujoco.MjData(mj)
    out = np.zeros((len(motion), mj.nv))
    for k in np.flatnonzero(touch.wrench.any(axis=1)):
        data.qpos[:] = motion.q[k]
        mujoco.mj_kinematics(mj, data)
        mujoco.mj_comPos(mj, data)
        b = touch.body + 1
        force = _at_com(data, b, touch.wrench[k])
        mujoco.mj_applyFT(mj, data, force[:3], force[3:], data.xipos[b], b, out[k])
    return out


def random_wrench(motion: Trajectory, force: float, rng: np.random.Generator) -> Array:
    """A wrench (N, 6) with forces of up to `force` (N) and moments of a tenth of it (N m)."""
    phase = rng.normal(size=6)
    return np.repeat([0.1, 1.0], 3) * force * np.sin(2 * motion.t[:, None] + phase)


def _add_sensor(spec: mujoco.MjSpec, body: str, cut: SensorCut, name: str) -> None:
    spec.body(body).add_site(name=name, pos=cut.p, quat=quaternion_of_matrix(cut.R))
    for kind in (mujoco.mjtSensor.mjSENS_TORQUE, mujoco.mjtSensor.mjSENS_FORCE):
        spec.add_sensor(
            name=f"{name} {kind.name}", type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=name
        )


def _sensor_addresses(mj: mujoco.MjModel, count: int) -> Array:
    """Where the six numbers of each sensor stand in sensordata, moments first."""
    places = []
    for k in range(count):
        for kind in (mujoco.mjtSensor.mjSENS_TORQUE, mujoco.mjtSensor.mjSENS_FORCE):
            start = int(mj.sensor_adr[mj.sensor(f"{SITE.format(k)} {kind.name}").id])
            places += [start, start + 1, start + 2]
    return np.array(places, dtype=int)


def _at_com(data: mujoco.MjData, b: int, wrench: Array) -> Array:
    """[f; n] in world axes about the centre of mass, as MuJoCo takes it."""
    R_wb = data.xmat[b].reshape(3, 3)
    moment, force = R_wb @ wrench[:3], R_wb @ wrench[3:]
    return np.concatenate([force, moment + np.cross(data.xpos[b] - data.xipos[b], force)])


@dataclass(frozen=True)
class WrenchNoise:
    """How a sensor errs. Standard deviations: white `force` (N) and `moment` (N m), of constants
    (`..._offset`) and of slopes in time (`..._drift`, per second), and of `gain` (share, each of
    the six axes) and `crosstalk` (share, each of the thirty other entries; between force and moment
    in the ratio `LEVER`). `mounting`: the sensor is turned by this
    angle (rad) about an axis drawn at random. `touch` (N, and a tenth of it in N m): what acts on
    the last body behind the sensor during the middle third of the recording."""

    force: float = 0.0
    moment: float = 0.0
    force_offset: float = 0.0
    moment_offset: float = 0.0
    force_drift: float = 0.0
    moment_drift: float = 0.0
    gain: float = 0.0
    crosstalk: float = 0.0
    mounting: float = 0.0
    touch: float = 0.0

    def white(self) -> Array:
        """Standard deviation (6,) of the white noise."""
        return np.repeat([self.moment, self.force], 3)


WRENCH_NOISE = tuple(field.name for field in fields(WrenchNoise))
"""Keys of a noise table that belong to force/torque sensors."""


def wrench_noise(noise: Mapping[str, float]) -> WrenchNoise:
    """The part of a noise table that is about force/torque sensors."""
    return WrenchNoise(**{key: noise[key] for key in WRENCH_NOISE if key in noise})


@dataclass(frozen=True, eq=False)
class SensorError:
    """One sensor as it was made: it reads A f + offset + slope t (6,)."""

    A: Array
    offset: Array
    slope: Array

    def measure(self, wrench: Array, t: Array) -> Array:
        """The reading (N, 6) of an exact wrench (N, 6)."""
        return np.asarray(wrench @ self.A.T + self.offset + t[:, None] * self.slope)


def sensor_error(noise: WrenchNoise, rng: np.random.Generator) -> SensorError:
    """A sensor drawn with these errors. Levels share their draws: comparisons are paired."""
    z_gain, z_cross = rng.normal(size=6), rng.normal(size=(6, 6))
    z_axis, z_offset, z_slope = rng.normal(size=3), rng.normal(size=6), rng.normal(size=6)
    size = np.repeat([LEVER, 1.0], 3)
    cross = noise.crosstalk * z_cross * (size[:, None] / size)
    np.fill_diagonal(cross, 1.0 + noise.gain * z_gain)
    R = matrix_of_quaternion(quaternion_of_vector(noise.mounting * z_axis / np.linalg.norm(z_axis)))
    turn = np.kron(np.eye(2), R)
    offset = np.repeat([noise.moment_offset, noise.force_offset], 3) * z_offset
    slope = np.repeat([noise.moment_drift, noise.force_drift], 3) * z_slope
    return SensorError(cross @ turn, offset, slope)
