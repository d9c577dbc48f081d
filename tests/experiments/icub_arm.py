"""An experiment in simulation: the iCub's left arm behind its sensor, 60 s of random
minimum-jerk motion of arm and torso after 5 s of rest, and a test motion with a touched hand."""

from functools import cache
from typing import Final

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorSubtree, subtree_at
from sysid_bench.simulation.plant import Plant, plant_of
from sysid_bench.simulation.wrench_sensors import Contact, sensor_wrench
from sysid_bench.types import Array, Trajectory
from tests.robots import named_robot

JOINTS: Final = (
    "torso_pitch", "torso_roll", "torso_yaw", "l_shoulder_pitch", "l_shoulder_roll",
    "l_shoulder_yaw", "l_elbow", "l_wrist_prosup", "l_wrist_pitch", "l_wrist_yaw",
)  # fmt: skip
RATE: Final = 100.0
SIGMA: Final = np.repeat([0.008, 0.15], 3)  # N m, N
REST: Final = 5.0
BASE: Final = "l_hand"


@cache
def arm() -> tuple[RobotModel, SensorSubtree, Plant]:
    robot = named_robot("icub")
    return robot, subtree_at(robot, "l_arm"), plant_of(robot)


def motion(seconds: float, rest: float, seed: int, joints: tuple[str, ...] = JOINTS) -> Trajectory:
    """Random points, one joint after another on its own clock, at most 1 rad/s."""
    robot, _, _ = arm()
    rng, t = np.random.default_rng(seed), np.arange(round(seconds * RATE)) / RATE
    q = np.tile(0.5 * (robot.limits.q_low + robot.limits.q_high), (len(t), 1))
    v, a = np.zeros_like(q), np.zeros_like(q)
    for name in joints:
        i = robot.rows.index(name)
        low, high = robot.limits.q_low[i], robot.limits.q_high[i]
        start, here = rest, q[0, i]
        while start < seconds:
            there = here + 0.9 * (rng.uniform(low, high) - here)
            length = max(1.5 * rng.uniform(0.6, 1.4), 1.875 * abs(there - here))
            s = np.clip((t - start) / length, 0.0, 1.0)
            now, way = (s > 0) & (s <= 1) & (t < start + length), there - here
            q[t >= start, i] = (here + way * (10 * s**3 - 15 * s**4 + 6 * s**5))[t >= start]
            v[now, i] = (way / length * (30 * s**2 - 60 * s**3 + 30 * s**4))[now]
            a[now, i] = (way / length**2 * (60 * s - 180 * s**2 + 120 * s**3))[now]
            start, here = start + length, there
    return Trajectory(t, q, v, a, "random points")


def touched(test: Trajectory) -> Contact:
    """5 to 8 N and 0.3 N m on the hand from 10 to 25 s."""
    robot, _, _ = arm()
    wrench, t = np.zeros((len(test), 6)), test.t
    wrench[:, 1] = 0.3 * np.sin(np.pi * t)
    wrench[:, 3] = 5 * np.sin(0.6 * np.pi * t)
    wrench[:, 5] = -8 * np.cos(0.4 * np.pi * t)
    wrench[(t < 10) | (t >= 25)] = 0.0
    return Contact(robot.body_names.index(BASE), wrench)


@cache
def training() -> tuple[Trajectory, Array]:
    """The motion and the exact wrench (N, 6)."""
    _, cut, plant = arm()
    made = motion(60.0, REST, 11)
    return made, sensor_wrench(plant, (cut,), made)


def noisy(wrench: Array, seed: int) -> Array:
    return np.asarray(wrench + SIGMA * np.random.default_rng(seed).normal(size=wrench.shape))
