"""MJCF with identified actuators: MuJoCo alone repeats the simulation with it."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from sysid_bench.apps.actuators.rollout import Drives, simulated_positions
from sysid_bench.apps.actuators.written_model import replay_positions, written_mjcf
from sysid_bench.models.load import load_robot
from tests.actuators.leg import JOINTS, MODEL, leg
from tests.actuators.test_drives import ONE_GAIN, log_of_case, two_gains


def test_the_written_model_repeats_the_simulation(tmp_path: Path) -> None:
    case = replace(two_gains(3), gains=ONE_GAIN)
    log = log_of_case(case)
    assert log.commands is not None
    part = slice(500, 1500)
    for limit in (np.inf, 4.0):
        commands = replace(log.commands, limit=np.full(len(JOINTS), limit))
        drives = Drives(JOINTS, case.values, delay=0.0093)
        file = tmp_path / f"leg-{limit:g}.xml"
        file.write_text(written_mjcf(leg(), drives, commands), encoding="utf-8")
        expected = simulated_positions(leg(), drives, commands, part)
        again = replay_positions(file, commands, part)
        np.testing.assert_allclose(again, expected, atol=1e-6)
        mj = mujoco.MjModel.from_xml_path(str(file))
        assert mj.nu == len(JOINTS)  # the motor of the thigh was replaced, under its name
        assert mj.actuator("drive").trnid[0] == mj.joint("thigh").id
        np.testing.assert_allclose(mj.dof_armature, case.values[:, 0])
        np.testing.assert_allclose(mj.actuator_delay, 0.009, atol=2e-6)


@pytest.mark.parametrize("rate", [60.0, 199.8, 240.0, 300.0, 400.0, 2000.0])
def test_the_written_model_repeats_the_simulation_at_any_rate(tmp_path: Path, rate: float) -> None:
    case = replace(two_gains(3), gains=ONE_GAIN)
    commands = log_of_case(case).commands
    assert commands is not None
    commands, drives = replace(commands, rate=rate), Drives(JOINTS, case.values, delay=0.0093)
    file, part = tmp_path / "leg.xml", slice(100, 400)
    file.write_text(written_mjcf(leg(), drives, commands), encoding="utf-8")
    expected = simulated_positions(leg(), drives, commands, part)
    np.testing.assert_allclose(replay_positions(file, commands, part), expected, atol=1e-6)
    still = simulated_positions(leg(), replace(drives, delay=0.0), commands, part)
    assert np.abs(still - expected).max() > 1e-4  # the delay acts


def test_an_actuator_of_a_tendon_is_not_that_of_a_joint(tmp_path: Path) -> None:
    case = replace(two_gains(3), gains=ONE_GAIN)
    commands = log_of_case(case).commands
    assert commands is not None
    cord = '<tendon><fixed name="cord"><joint joint="calf" coef="1"/></fixed></tendon>'
    file = tmp_path / "cord.xml"
    text = MODEL.replace("<actuator>", f'{cord}<actuator><motor name="pull" tendon="cord"/>')
    file.write_text(text, encoding="utf-8")
    robot, drives, part = load_robot(file), Drives(JOINTS, case.values, 0.009), slice(500, 800)
    again = tmp_path / "again.xml"
    again.write_text(written_mjcf(robot, drives, commands), encoding="utf-8")
    expected = simulated_positions(robot, drives, commands, part)
    np.testing.assert_allclose(replay_positions(again, commands, part), expected, atol=1e-6)


def test_a_limit_changes_the_motion_and_other_values_do_not_repeat_it(tmp_path: Path) -> None:
    case = replace(two_gains(3), gains=ONE_GAIN)
    commands = log_of_case(case).commands
    assert commands is not None
    part, drives = slice(500, 900), Drives(JOINTS, case.values, delay=0.009)
    expected = simulated_positions(leg(), drives, commands, part)
    weak = replace(commands, limit=np.full(len(JOINTS), 1.0))
    assert np.abs(simulated_positions(leg(), drives, weak, part) - expected).max() > 1e-3
    file = tmp_path / "late.xml"
    file.write_text(written_mjcf(leg(), replace(drives, delay=0.0), commands), encoding="utf-8")
    assert np.abs(replay_positions(file, commands, part) - expected).max() > 1e-3
