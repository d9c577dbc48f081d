"""Recordings designed for actuators: they separate delay and armature, and keep the limits."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import sysid_bench
from sysid_bench.apps.actuators.command_design import DELAY
from sysid_bench.apps.actuators.commands.excite_actuators import CommandsResult
from sysid_bench.apps.actuators.drive_estimate import identify_drives
from sysid_bench.apps.actuators.drive_rows import drive_rows, joint_indices
from sysid_bench.apps.actuators.rollout import Drives, drive_model, positions_of
from sysid_bench.commands.main import main
from sysid_bench.errors import UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.models.motor_table import motor
from sysid_bench.signals.log import read_log
from sysid_bench.signals.log_description import read_description
from sysid_bench.signals.position_control import Commands
from sysid_bench.types import Array
from tests.actuators.leg import JOINTS, MODEL, RATE, Case, leg

SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, 20))]
DESIGN = sysid_bench.CommandsRequest(
    "", gains={"kp": [30.0], "kd": [0.8]}, limits={"v": [10.0], "tau": [20.0]},
    period=20.0, starts=2, iterations=1,
)  # fmt: skip

MOTORS = """
[motor.falling]
rotor_inertia = 0.01
peak_torque = 4.3
rated_torque = 0.5
rated_speed = 2.5
no_load_speed = 3
[motor.constant]
rotor_inertia = 0.01
peak_torque = 4.3
no_load_speed = 3
"""


@cache
def model(folder: Path) -> Path:
    """The leg's file, which states no armature."""
    file = folder / "leg.xml"
    file.write_text(MODEL.replace(' armature=".5"', ""), encoding="utf-8")
    return file


def designed(folder: Path, seed: int) -> CommandsResult:
    """Commands for the leg, written to `commands.csv`."""
    request = replace(DESIGN, robot=model(folder), seed=seed, out=folder / "commands.csv")
    return sysid_bench.excite(request)


def written(folder: Path) -> dict[str, Array]:
    """Arrays of the written commands: q_des, kp and kd."""
    table = np.genfromtxt(folder / "commands.csv", delimiter=",", names=True, deletechars="")
    return {
        name: np.column_stack([table[f"{joint}.{name}"] for joint in JOINTS])
        for name in ("q_des", "kp", "kd")
    }


@pytest.mark.parametrize("seed", SEEDS)
def test_data_along_a_design_separate_delay_and_armature(tmp_path: Path, seed: int) -> None:
    result = designed(tmp_path, seed)
    assert not result.violations
    case = Case(seed, delay=0.001 * (3 * seed % 13))
    data, half = written(tmp_path), round(result.period * result.rate) // 2
    np.testing.assert_array_equal(data["q_des"][:half], data["q_des"][half:])
    assert result.gains["kp"][0] == [30.0] * len(JOINTS)
    changed = [(data[name][-1] / data[name][0]).tolist() for name in ("kp", "kd")]
    assert [0.5] * len(JOINTS) in changed
    zeros, whole = np.zeros_like(data["kp"]), case.commands()
    whole = replace(whole, q=data["q_des"], q_des=data["q_des"], kp=data["kp"], kd=data["kd"])
    whole = replace(whole, v_des=zeros, feedforward=zeros)
    np.savez(
        tmp_path / "run.npz",
        allow_pickle=False,
        q=case.moved(whole, np.random.default_rng(seed)).q,
        **data,
    )
    log = tmp_path / "run.toml"
    log.write_text(
        f'file = "run.npz"\nrate = "{RATE} Hz"\njoints = {list(JOINTS)}\nq = {{ columns = "q" }}\n'
        'tau = { pd = { q_des = "q_des", kp = "kp", kd = "kd", delay = "profile" } }\n',
        encoding="utf-8",
    )
    found = identify_drives(drive_rows(leg(), read_log(read_description(log), leg()), JOINTS))
    assert found.separation is not None
    assert not found.separation.is_open
    assert found.delay == pytest.approx(case.delay, abs=1e-3)
    np.testing.assert_allclose(found.fit.values[:, 0], case.values[:, 0], rtol=0.05)


@pytest.mark.long
def test_motions_and_torques_of_a_design_keep_the_limits(tmp_path: Path) -> None:
    result = designed(tmp_path, 3)
    assert set(result.limits) == {"command", "position", "velocity", "torque"}
    assert all(used["share"] <= 1.0 for used in result.limits.values())
    weaker = replace(DESIGN, robot=model(tmp_path), limits={"v": [10.0], "tau": [4.0]})
    again = sysid_bench.excite(weaker)
    assert again.limits["torque"]["share"] <= 1.0
    # What a weaker motor allows says less of the armature.
    assert max(again.armature_std.values()) > max(result.armature_std.values())


@pytest.mark.long
def test_torques_of_a_design_keep_the_line_of_the_motors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Under the line from the torque at rest to the speed without load, not only the peak."""
    monkeypatch.chdir(tmp_path)
    Path("motors").mkdir()
    Path("motors/own.toml").write_text(MOTORS, encoding="utf-8")
    found = motor("falling")
    request = replace(
        DESIGN, robot=model(tmp_path), motors=["falling"], limits={}, out=tmp_path / "commands.csv",
        starts=1, iterations=0,
    )  # fmt: skip
    result = sysid_bench.excite(request)
    assert all(used["share"] <= 1.0 for used in result.limits.values())
    values = np.array([list(row.values()) for row in result.assumed.values()])
    np.testing.assert_array_equal(values[:, 0], found.armature)
    drives = Drives(JOINTS, values, DELAY)
    data = written(tmp_path)
    zeros = np.zeros_like(data["kp"])
    commands = Commands(
        joints=JOINTS, rate=result.rate, q=zeros, v=None, v_des=zeros, feedforward=zeros,
        limit=np.full(len(JOINTS), np.inf), delay=None, q_des=data["q_des"], kp=data["kp"],
        kd=data["kd"],
    )  # fmt: skip
    robot = load_robot(model(tmp_path))
    places = joint_indices(robot, JOINTS)
    mj = drive_model(robot, drives, commands)
    moved = replace(commands, q=positions_of(mj, places, DELAY, commands, slice(0, len(zeros))))
    tau, v = moved.torque(DELAY), moved.velocity
    driving = tau * v > 0.0
    line = found.stall_torque * (1.0 - np.abs(v) / found.no_load_speed)
    assert (np.abs(tau) <= found.keys.peak_torque).all()
    assert (np.abs(tau) <= line)[driving].all()
    # It is the line that binds: with torque and speed apart the motion says more.
    free = sysid_bench.excite(replace(request, motors=["constant"] * len(JOINTS)))
    assert free.delay_open < result.delay_open


def test_a_short_design_says_what_length_a_light_joint_needs(tmp_path: Path) -> None:
    short = replace(DESIGN, robot=model(tmp_path), period=4.0, starts=1, iterations=0)
    result = sysid_bench.excite(short)
    worst, open_by = max(result.armature_std.items(), key=lambda item: item[1])
    said = next(warning for warning in result.warnings if "is short for a light joint" in warning)
    assert worst in said
    period = float(said.split("--period ")[1].split()[0])
    assert period == pytest.approx(4.0 * (open_by / 0.1) ** 2, rel=0.05)
    assert open_by > 0.1


@pytest.mark.long
def test_slow_limits_leave_delay_and_armature_confounded(tmp_path: Path) -> None:
    slow = replace(
        DESIGN, robot=model(tmp_path), limits={"v": [0.5]}, period=8.0, starts=1, iterations=0
    )
    result = sysid_bench.excite(slow)
    assert any("stay confounded" in warning for warning in result.warnings)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"gains": {"kp": [30.0]}}, "kd is missing"),
        ({"gains": {"kp": [30.0, 20.0], "kd": [1.0]}}, "one for each of 3 joints"),
        ({"limits": {"a": [1.0]}}, "No limit"),
        ({"joints": ("knee",)}, "knee"),
        ({"motors": ["dm-j4340-2ec"] * 2}, "one for each of 3 joints"),
        ({"motors": ["dm-j4340"]}, "dm-j4340-2ec"),
    ],
)
def test_requests_that_no_design_serves_are_refused(
    tmp_path: Path, change: dict[str, Any], words: str
) -> None:
    with pytest.raises(UsageError, match=words):
        sysid_bench.excite(replace(DESIGN, robot=model(tmp_path), **change))


def test_options_of_motions_are_refused_for_commands(tmp_path: Path) -> None:
    words = ["excite", str(model(tmp_path)), "--gain", "kp=30", "--gain", "kd=1"]
    for more in (["--task", "actuators", "--harmonics", "3"], []):
        done = CliRunner().invoke(main, [*words, *more])
        assert done.exit_code == 2
        assert ("--harmonics" if more else "--gain") in done.output


def test_gains_and_limits_of_the_file_are_those_of_a_design(tmp_path: Path) -> None:
    drives = "".join(
        f'<position joint="{joint}" kp="{kp}" kv="0.7" forcerange="-{limit} {limit}"/>'
        for joint, kp, limit in zip(JOINTS, (30, 25, 20), (9, 8, 7), strict=True)
    )
    start, _, rest = MODEL.replace(' armature=".5"', "").partition("<actuator>")
    file = tmp_path / "servo.xml"
    file.write_text(f"{start}<actuator>{drives}</actuator></mujoco>", encoding="utf-8")
    assert "</actuator>" in rest
    request = replace(DESIGN, robot=file, gains={}, limits={"v": [10.0]}, period=4.0, starts=1)
    result = sysid_bench.excite(replace(request, out=tmp_path / "commands.csv"))
    assert result.gains["kp"][0] == [30.0, 25.0, 20.0]
    assert result.gains["kd"][0] == [0.7] * 3
    assert not any("limits of" in text and "torque" in text for text in result.warnings)
    assert 0.0 < result.limits["torque"]["share"] <= 1.0
