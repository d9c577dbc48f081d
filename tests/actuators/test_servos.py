"""Position servos whose gains are not known, and that stick: laws on a leg, and a public arm."""

import json
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

import sysid_bench
from sysid_bench.apps.actuators.commands.actuators_result import ActuatorsResult
from sysid_bench.apps.actuators.commands.servo_result import RATIOS, gain_fields, gain_text
from sysid_bench.apps.actuators.drive_estimate import identify_drives
from sysid_bench.apps.actuators.drive_rows import LEAST, drive_rows, model_values
from tests.actuators.leg import JOINTS, Case, leg

FACTORS = [1 / 75, 0.2, 5.0, 75.0]
"""Errors of stated gains; the file of a public arm states 75 times too much."""


@pytest.mark.parametrize("factor", FACTORS)
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
def test_stated_gains_are_a_start(factor: float, seed: int) -> None:
    case = Case(seed, delay=0.004, disturbance=0.03)
    commands = case.log().commands
    assert commands is not None
    log = case.log(kp=(30.0 * factor,), kd=(0.8 * factor,), delay="4 ms")
    half = slice(0, len(commands) // 2)  # of one set of gains
    found = identify_drives(drive_rows(leg(), log, JOINTS, half, ("gain",)), delay=0.004)
    (gain,) = found.gains
    assert gain.gain * factor == pytest.approx(1.0, abs=0.05)
    assert gain.interval[0] < gain.gain < gain.interval[1]
    right = identify_drives(drive_rows(leg(), case.log(), JOINTS, half), delay=0.004)
    # All torques follow from the gain: so do the values, whatever was stated.
    assert found.fit.values[:, :3] == pytest.approx(right.fit.values[:, :3], rel=0.1)


@pytest.mark.parametrize("factor", FACTORS)
def test_wrong_gains_are_named(tmp_path: Path, factor: float) -> None:
    case = Case(0, delay=0.004, disturbance=0.03, gains=((1.0, 1.0),))
    commands = case.commands()
    pd = {"q_des": "q_des", "kp": [30.0 * factor], "kd": [0.8 * factor], "delay": "4 ms"}
    keys = {"joints": list(JOINTS), "rate": 200.0, "tau": {"pd": pd}}
    log = sysid_bench.log_of({"q": commands.q, "q_des": commands.q_des}, keys)
    accept = ["worse", "gain", "sign", "direction", "robot", "units"]
    path = leg().manifest.path
    result = sysid_bench.identify(path, task="actuators", log=log, accept=accept)
    (warning,) = [text for text in result.warnings if "the gains that fit" in text]
    assert "--also gain" in warning
    named = float(warning.split("fit are ")[1].split()[0])
    assert named * factor == pytest.approx(1.0, abs=0.1)


def test_links_without_torque_leave_ratios() -> None:
    case = Case(3, delay=0.004, gains=((1.0, 1.0),), disturbance=0.03)
    rows = drive_rows(leg(), case.log(), JOINTS, more=("gain",))
    assert not identify_drives(rows, delay=0.004).gains[0].is_open
    (gain,) = identify_drives(replace(rows, links=0.0 * rows.links), delay=0.004).gains
    assert gain.is_open
    assert gain.gain == 1.0
    (fields,) = gain_fields([gain], JOINTS)
    assert not fields["determined"]
    assert RATIOS in gain_text(fields)


@pytest.mark.parametrize(("armature", "kept"), [(0.4, True), (9.0, False)])
def test_no_drive_is_without_the_armature_of_its_file(armature: float, kept: bool) -> None:
    """An assumed delay that is far too long leaves no friction, and less armature than there is."""
    robot = leg(f'armature="{armature}" damping="0.01" ')
    log = Case(0, delay=0.012, smooth=True, gains=((1.0, 1.0),)).log()
    fit = identify_drives(drive_rows(robot, log, JOINTS), delay=0.05).fit
    calf = JOINTS.index("calf")
    least = LEAST * model_values(robot, JOINTS)[calf]
    assert fit.at_bound[calf, 1]
    # A file that is wrong by a factor of hundreds is not believed.
    assert (fit.values[calf, 0] == pytest.approx(least[0])) == kept
    assert (fit.values[calf, 1] == pytest.approx(least[1])) == kept
    assert 0.0 < fit.values[calf, 0] <= least[0] * (1.0 + 1e-9)


def test_rows_in_which_a_joint_sticks_decide_nothing() -> None:
    case = Case(1, delay=0.004, disturbance=0.0)
    rows = drive_rows(leg(), case.log(delay="4 ms"), JOINTS)
    found = identify_drives(rows, delay=0.004)
    sticks = rows.features[:, :, 2] == 0.0
    assert sticks.any(axis=0).all()
    assert (found.fit.residuals[sticks] == 0.0).all()
    # The weights of the others keep the mean over all rows.
    assert np.mean(rows.features[:, :, 3] ** 2, axis=0) == pytest.approx(1.0)


MOTIONS = ("multisine", "large_amplitude", "friction_gravity", "backlash_detection")
PAIRS = list(combinations(MOTIONS, 2))


@pytest.mark.data
@pytest.mark.parametrize(
    ("kp", "also", "pairs"),
    [
        (998.22, ["gain"], [("friction_gravity", "backlash_detection")]),
        pytest.param(998.22, ["gain"], PAIRS, marks=pytest.mark.long),
        pytest.param(17.8, [], PAIRS, marks=pytest.mark.tutorial),
    ],
)
def test_a_public_servo_arm(
    data_folder: Path, tmp_path: Path, kp: float, also: list[str], pairs: list[tuple[str, ...]]
) -> None:
    """Trained on each pair of motions and tested on the others, with the gains of the file, which
    are 70 times too large, and with those of an earlier file."""
    joints = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
    logs, model = {}, data_folder / "robots/robotstudio_so101__so101.xml"
    for name in MOTIONS:
        folder = data_folder / "so101_sage" / name
        clock = 'time = { column = "timestamp", unit = "us" }'
        logs[name] = tmp_path / f"{name}.toml"
        logs[name].write_text(
            f'joints = {json.dumps(joints)}\nrate = "50 Hz"\n'
            f'q = {{ columns = "positions", file = {json.dumps(str(folder / "state_motor.csv"))}, '
            f'{clock} }}\ntau = {{ pd = {{ q_des = {{ columns = "positions", '
            f'file = {json.dumps(str(folder / "control.csv"))}, {clock}, resample = "previous" }}, '
            f'kp = {kp}, kd = 0.0, delay = "profile" }} }}\n',
            encoding="utf-8",
        )
    ratios = []
    for pair in pairs:
        for test in [name for name in MOTIONS if name not in pair][: len(pairs)]:
            result = sysid_bench.identify(
                *(model,), task="actuators", log=[logs[name] for name in pair], also=also,
                test=[logs[test]], accept=["worse"],
            )  # fmt: skip
            assert isinstance(result, ActuatorsResult)
            command = result.scores["rollout_error_command"]
            # Of all six joints: the hand's errors are small beside those of the arm.
            ratios.append(1.0 if result.scores["beaten_by"] else result.rollout_error / command)
            if also:
                assert result.gains is not None
                assert 5.0 < kp * result.gains[0]["gain"] < 25.0
    assert np.median(ratios) <= 0.4
    assert result.lost_motion is not None
    # Owners report a backlash of about one degree in the wrist: no more than 17 mrad.
    assert 0.0 < result.lost_motion["wrist_roll"]["width"] < 0.03
