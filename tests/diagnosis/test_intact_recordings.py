"""Recordings without a mistake, of robots of the collection with friction, rotors and noise: none
is refused, though the model files are off."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sysid_bench.diagnosis.finding import ERROR
from sysid_bench.diagnosis.run_checks import diagnose
from sysid_bench.models.robot import RobotModel
from tests.diagnosis.test_diagnosis import evidence
from tests.robots import NAMED, named_robot, urdf_files, urdf_robot
from tests.signals.logs import Recorded, recorded

MOST = 14
"""Joints of a robot that is recorded at once."""


def robot_of_name(name: str) -> RobotModel:
    return named_robot(name) if name in NAMED else urdf_robot(name)


def rough(robot: RobotModel, seed: int) -> Recorded:
    """A recording with friction that rises over a width, rotors, noise and quantisation."""
    log, rng, n = recorded(robot, seed, period=8.0), np.random.default_rng(seed), len(robot.rows)
    rms = np.sqrt((log.tau**2).mean(axis=0))
    least = np.maximum(rms, 0.03 * rms.max())
    friction, speed = least * rng.uniform(0.1, 0.6, n), np.sqrt((log.v**2).mean(axis=0))
    a = np.gradient(log.v, log.t, axis=0)
    rotors = 0.3 * rms / np.sqrt((a**2).mean(axis=0)) * rng.uniform(0, 1, n)
    tau = log.tau + friction * (np.tanh(log.v / (0.02 * speed)) + 0.5 * log.v / speed) + rotors * a
    tau = tau + 0.03 * least * rng.normal(size=tau.shape)
    step = 0.002 * np.abs(tau).max(axis=0)
    v = log.v + 0.003 * rng.normal(size=log.v.shape)
    return replace(log, q=np.round(log.q, 5), v=v, tau=np.round(tau / step) * step)


def told(robot: RobotModel, seed: int) -> RobotModel:
    """The robot as its file states it: masses off by 20 %, centres by 15 % of their reach."""
    rng = np.random.default_rng(seed)
    phi = robot.phi * np.exp(0.2 * rng.normal(size=len(robot.phi)))[:, None]
    phi[:, 1:4] *= 1 + 0.15 * rng.normal(size=(len(phi), 3))
    return replace(robot, phi=phi)


@pytest.mark.long
@pytest.mark.parametrize("name", [*NAMED, *urdf_files()])
def test_an_intact_recording_is_not_refused(tmp_path: Path, name: str) -> None:
    robot = robot_of_name(name)
    kinds = {joint.kind for joint in robot.joints}
    if len(robot.joints) > MOST or not kinds <= {"hinge", "slide"} or robot.coupling is not None:
        pytest.skip("other joints than hinges and slides, or more than a recording has")
    seed = len(name)
    found = diagnose(evidence(tmp_path, rough(robot, seed), told(robot, seed)))
    assert not [one for one in found if one.severity == ERROR]
