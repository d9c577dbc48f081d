"""Chirps that all joints share: no exchange is reported, and the fit errs at most as much as least
squares of one's own, within a tenth."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from scipy.optimize import nnls

import sysid_bench
from sysid_bench.apps.actuators.delay_profile import delay_grid
from sysid_bench.apps.actuators.drive_rows import drive_rows, joint_indices
from sysid_bench.apps.actuators.rollout import (
    FITTED,
    Drives,
    drive_model,
    positions_of,
    rollout_error,
)
from sysid_bench.apps.actuators.rollout import (
    test_end as judged_end,
)
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log import Log, read_log
from sysid_bench.signals.log_data import log_of
from sysid_bench.signals.position_control import Commands
from sysid_bench.types import Array
from tests.actuators.leg import RATE, Case, leg


@dataclass(frozen=True)
class SharedCase(Case):
    """One chirp for all joints, with amplitudes of their own."""

    def _wanted(self, rng: np.random.Generator, n: int) -> Array:
        t, last = np.arange(n)[:, None] / RATE, rng.uniform(2.0, 6.0)
        chirp = np.sin(2.0 * np.pi * (0.1 + 0.5 * (last - 0.1) * t / t[-1]) * t)
        amplitudes = rng.uniform(0.1, 0.4, 3) * rng.choice([-1.0, 1.0], 3)
        return np.asarray(0.3 + amplitudes * chirp)


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(x, marks=pytest.mark.long) for x in range(1, 8))]
)
def test_shared_chirps_are_not_exchanged(seed: int) -> None:
    case = SharedCase(seed, 0.01, ((1.0, 1.0),), disturbance=0.03, seconds=12.0 if seed else 5.0)
    commands = case.commands()
    pd = {"q_des": "q_des", "kp": [30.0], "kd": [0.8], "delay": "profile"}
    keys = {"joints": list(commands.joints), "rate": RATE, "tau": {"pd": pd}}
    log = log_of({"q": commands.q, "q_des": commands.q_des}, keys)
    messages = [x["message"] for x in sysid_bench.diagnose(log, leg().manifest.path).findings]
    assert not [text for text in messages if "exchanged" in text]


@cache
def arm() -> RobotModel:
    """A six-joint arm under shared chirps."""
    return load_robot(find_manifest("z1"))


def arm_log(seed: int, load: float) -> Log:
    """Its recording under one chirp of all joints; `load`: friction over the torque of the links,
    which no fit of these terms holds."""
    rng, robot = np.random.default_rng(seed), arm()
    joints = robot.torque_rows[:6]
    n, k = int(20.0 * RATE), len(joints)
    t, last = np.arange(n) / RATE, rng.uniform(1.0, 3.0)
    chirp = np.sin(2.0 * np.pi * (0.1 + 0.5 * (last - 0.1) * t / t[-1]) * t)
    centre = np.array([0.0, 1.5, -1.0, -0.5, 0.0, 0.0])
    q_des = centre + rng.uniform(0.1, 0.3, k) * chirp[:, None]
    kp, kd = np.array([100.0, 150, 150, 100, 75, 50]), np.array([2.0, 3, 3, 2, 1.5, 1])
    zeros = np.zeros((n, k))
    whole = Commands(
        joints=tuple(joints), rate=RATE, q=q_des, v=zeros, q_des=q_des, v_des=zeros,
        feedforward=zeros, kp=np.tile(kp, (n, 1)), kd=np.tile(kd, (n, 1)),
        limit=np.full(k, np.inf), delay=None,
    )  # fmt: skip
    low, high = [0.01, 0.3, 0.5, -0.3], [0.1, 1.0, 2.0, 0.3]
    drives = Drives(tuple(joints), rng.uniform(low, high, (k, 4)), rng.uniform(0.004, 0.016))
    model = drive_model(robot, drives, whole)
    places = joint_indices(robot, joints)
    q = positions_of(model, places, drives.delay, whole, slice(0, n), np.full(k, load))
    pd = {"q_des": "q_des", "kp": kp.tolist(), "kd": kd.tolist(), "delay": "profile"}
    keys = {"joints": list(joints), "rate": RATE, "tau": {"pd": pd}}
    q = q + 1e-4 * rng.normal(size=q.shape)
    return read_log(log_of({"q": q, "q_des": q_des}, keys), robot)


@pytest.mark.long
@pytest.mark.parametrize("load", [0.0, 0.1])
@pytest.mark.parametrize("seed", range(4))
def test_no_worse_than_least_squares_at_its_best_delay(seed: int, load: float) -> None:
    """The best delay is that of the judged samples, where the plant has these terms alone; another
    plant's errors are made up for by any delay there, so that it is that of the fitted ones."""
    log = arm_log(seed, load)
    assert log.commands is not None
    first, end = int(FITTED * len(log.commands)), judged_end(len(log.commands))
    rows = drive_rows(arm(), log, log.joints, slice(0, first))
    tried = []
    for delay in delay_grid(RATE).tolist():
        tau, values, left = rows.torque(delay), np.zeros((len(log.joints), 4)), 0.0
        for j in range(len(log.joints)):
            A = rows.features[:, j]
            x, residual = nnls(np.column_stack([A, -A[:, 3]]), tau[:, j])
            values[j], left = [*x[:3], x[3] - x[4]], left + np.log(residual)
        drives = Drives(log.joints, values, delay)
        squares = rollout_error(arm(), drives, log.commands, slice(first, end)) ** 2
        tried.append((left if load else 0.0, float(np.sqrt(np.mean(squares)))))
    result = sysid_bench.identify("z1", task="actuators", log=log.description)
    assert result.rollout_error is not None
    best = min(tried)[1]
    # Half a millisecond, to which a delay is simulated, moves joints of about 1 rad/s by 0.5 mrad.
    assert result.rollout_error <= max(1.1 * best, best + 5e-4)
