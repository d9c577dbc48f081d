"""Force/torque sensors: exact wrenches by MuJoCo's sensors, and the errors of real sensors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Final

import mujoco
import numpy as np

from sysid_bench.models.sensor import SensorSubtree
from sysid_bench.simulation.plant import Plant, check_finite
from sysid_bench.spatial import matrix_of_quaternion, quaternion_of_matrix, quaternion_of_rotation
from sysid_bench.types import Array, Trajectory

LEVER: Final = 0.1
"""m: ratio of moment and force ranges of common six-axis sensors, which scales crosstalk."""

SITE: Final = "force/torque sensor {}"


@dataclass(frozen=True, eq=False)
class Contact:
    """External wrench (N, 6) [n; f] (N m, N) on the body with index `body`, at its origin and in
    its axes."""

    body: int
    wrench: Array


def sensor_wrench(
    plant: Plant, cuts: Sequence[SensorSubtree], motion: Trajectory, touch: Contact | None = None
) -> Array:
    """Return the wrenches (N, 6 s) that s ideal sensors measure along an exact motion, [n; f] each,
    in the sensor frame.

    Rotor inertia (armature) and friction act inside the joints and do not appear in the reading.
    Raises SimulationError if a wrench is not finite.
    """
    spec = plant.robot.spec.copy()
    names: list[str] = []
    for k, cut in enumerate(cuts):
        site = SITE.format(k)
        body = spec.body(plant.robot.body_names[cut.body])
        body.add_site(name=site, pos=cut.p, quat=quaternion_of_matrix(cut.R))
        for kind in (mujoco.mjtSensor.mjSENS_TORQUE, mujoco.mjtSensor.mjSENS_FORCE):
            names.append(f"{site} {kind.name}")
            sensor = spec.add_sensor(name=names[-1], type=kind, objname=site)
            sensor.objtype = mujoco.mjtObj.mjOBJ_SITE
    mj = plant.compiled(spec)
    data = mujoco.MjData(mj)
    # The robot's file may have sensors of its own before these.
    starts = np.array([mj.sensor_adr[mj.sensor(name).id] for name in names], dtype=int)
    addresses = (starts[:, None] + np.arange(3)).ravel()
    out = np.empty((len(motion), len(addresses)))
    for k in range(len(motion)):
        data.qpos[:], data.qvel[:], data.qacc[:] = motion.q[k], motion.v[k], motion.a[k]
        if touch is not None:
            b, wrench = touch.body + 1, touch.wrench[k]
            data.xfrc_applied[b] = _at_com(mj, data, b, wrench) if wrench.any() else 0.0
        # Acceleration is given, so that the sensors read what this motion takes.
        mujoco.mj_inverse(mj, data)
        out[k] = data.sensordata[addresses]
    return check_finite(plant.robot.name, out, "sensor wrench")


def contact_torque(plant: Plant, touch: Contact, motion: Trajectory) -> Array:
    """Return the generalised force (N, nv) of an external wrench; the motors supply that much
    less."""
    mj = plant.contact_free_model
    data = mujoco.MjData(mj)
    out = np.zeros((len(motion), mj.nv))
    for k in np.flatnonzero(touch.wrench.any(axis=1)):
        data.qpos[:] = motion.q[k]
        b = touch.body + 1
        force = _at_com(mj, data, b, touch.wrench[k])
        mujoco.mj_comPos(mj, data)
        point = data.xipos[b]
        mujoco.mj_applyFT(
            mj, data, force=force[:3], torque=force[3:], point=point, body=b, qfrc_target=out[k]
        )
    return out


def random_wrench(motion: Trajectory, force: float, rng: np.random.Generator) -> Array:
    """Return a sinusoidal wrench (N, 6) [n; f] with random phases, force amplitude `force` (N) and
    a tenth of it in N m."""
    phase = rng.normal(size=6)
    return np.asarray(np.repeat([0.1, 1.0], 3) * force * np.sin(2 * motion.t[:, None] + phase))


def _at_com(mj: mujoco.MjModel, data: mujoco.MjData, b: int, wrench: Array) -> Array:
    """[f; n] at the centre of mass in world axes at data.qpos, as in MuJoCo's xfrc_applied."""
    mujoco.mj_kinematics(mj, data)
    R_wb = data.xmat[b].reshape(3, 3)
    moment, force = R_wb @ wrench[:3], R_wb @ wrench[3:]
    by_force = np.empty(3)
    mujoco.mju_cross(
        by_force, data.xpos[b] - data.xipos[b], force
    )  # np.cross takes 20 times longer
    return np.concatenate([force, moment + by_force])


@dataclass(frozen=True)
class WrenchNoise:
    """Errors of a force/torque sensor, as standard deviations unless stated otherwise.

    `force` (N), `moment` (N m): white noise; `..._offset`: constant offsets; `..._drift`: drift per
    second; `gain`: relative, of the six diagonal entries of the calibration matrix; `crosstalk`:
    relative, of the other thirty, scaled by `LEVER` between force and moment. `mounting` (rad):
    angle of a misalignment about a random axis. `touch` (N, and a tenth of it in N m): amplitude of
    a contact on the last body distal to the sensor during the middle third of the recording.
    """

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
        """Return the standard deviation (6,) of the white noise, [n; f]."""
        return np.repeat([self.moment, self.force], 3)


WRENCH_NOISE = tuple(field.name for field in fields(WrenchNoise))
"""Keys of a noise table that describe force/torque sensors."""


def wrench_noise(noise: Mapping[str, float]) -> WrenchNoise:
    """Return the errors of force/torque sensors from a noise table; other keys are ignored."""
    return WrenchNoise(**{key: noise[key] for key in WRENCH_NOISE if key in noise})


@dataclass(frozen=True, eq=False)
class SensorError:
    """Errors of one sensor: it reads A f + offset + slope t, (6,) [n; f]; A (6, 6) is the
    calibration error."""

    A: Array
    offset: Array
    slope: Array

    def read(self, wrench: Array, t: Array) -> Array:
        """Return the reading (N, 6) of an exact wrench (N, 6) at times t (N,), without white
        noise."""
        return np.asarray(wrench @ self.A.T + self.offset + t[:, None] * self.slope)


def sensor_error(noise: WrenchNoise, rng: np.random.Generator) -> SensorError:
    """Draw the errors of one sensor; noise levels share their normal draws, so that comparisons
    between levels are paired."""
    z_gain, z_cross = rng.normal(size=6), rng.normal(size=(6, 6))
    z_axis, z_offset, z_slope = rng.normal(size=3), rng.normal(size=6), rng.normal(size=6)
    size = np.repeat([LEVER, 1.0], 3)
    cross = noise.crosstalk * z_cross * (size[:, None] / size)
    np.fill_diagonal(cross, 1.0 + noise.gain * z_gain)
    R = matrix_of_quaternion(
        quaternion_of_rotation(noise.mounting * z_axis / np.linalg.norm(z_axis))
    )
    # One rotation turns moment and force alike.
    turn = np.kron(np.eye(2), R)
    offset = np.repeat([noise.moment_offset, noise.force_offset], 3) * z_offset
    slope = np.repeat([noise.moment_drift, noise.force_drift], 3) * z_slope
    return SensorError(cross @ turn, offset, slope)
