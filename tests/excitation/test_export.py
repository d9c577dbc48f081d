"""Laws of exports: what is read back is what was commanded, within a quantum; limits hold."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_bench.csv_text import cell_text
from sysid_bench.errors import UsageError
from sysid_bench.excitation.export import (
    MOTORS,
    Commands,
    DamiaoDrive,
    commands_csv,
    damiao_motors,
    json_text,
    limit_commands,
    log_text,
    ros2_text,
    table_text,
)
from sysid_bench.types import Array
from tests.closeness import assert_close

PUBLISHED = tuple(name for name, motor in MOTORS.items() if motor.speed is not None)
SECRET = tuple(name for name in MOTORS if name not in PUBLISHED)
OWN_LIMITS = {"v": 3.0, "tau": 0.8}


def commands(seed: int, count: int = 40, joints: int = 3, size: float = 1.0) -> Commands:
    rng = np.random.default_rng(seed)
    q, v, a, tau = size * rng.normal(size=(4, count, joints))
    names = tuple(f"j{i}" for i in range(joints))
    return Commands(names, np.arange(count) / 200, q, v, a, tau)


def read_frame(drive: DamiaoDrive, data: Array) -> dict[str, Array]:
    """q, v, kp, kd, tau (N,) of frames (N, 8), as the drive decodes them: kp to 500, kd to 5."""
    b, s = data.astype(int).T, drive.scaling
    codes = {
        "q": (b[0] << 8 | b[1], -s.p, s.p, 16),
        "v": (b[2] << 4 | b[3] >> 4, -s.v, s.v, 12),
        "kp": ((b[3] & 0xF) << 8 | b[4], 0.0, 500.0, 12),
        "kd": (b[5] << 4 | b[6] >> 4, 0.0, 5.0, 12),
        "tau": ((b[6] & 0xF) << 8 | b[7], -s.tau, s.tau, 12),
    }
    return {
        key: low + code * (high - low) / (2**bits - 1)
        for key, (code, low, high, bits) in codes.items()
    }


@given(seed=st.integers(0, 999), name=st.sampled_from(sorted(MOTORS)), size=st.floats(0.1, 50.0))
@settings(max_examples=40, deadline=None)
def test_every_frame_says_what_was_commanded_within_a_quantum(
    seed: int, name: str, size: float
) -> None:
    design_problem = {
        "motor": name,
        "kp": 37.0,
        "kd": 1.3,
        **(OWN_LIMITS if name in SECRET else {}),
    }
    asked = commands(seed, size=size)
    drives = damiao_motors(asked.joints, {"all": design_problem})
    inside, _ = limit_commands(asked, drives, most=1.0)
    text = log_text(inside, drives)
    frames = [bytes.fromhex(line.split("#")[1]) for line in text.splitlines()]
    data = np.array([list(f) for f in frames], dtype=np.uint8).reshape(len(asked), 3, 8)
    for j, drive in enumerate(drives):
        said = read_frame(drive, data[:, j])
        s = drive.scaling
        for key, values, span, bits in (
            ("q", inside.q[:, j], 2 * s.p, 16),
            ("v", inside.v[:, j], 2 * s.v, 12),
            ("tau", inside.tau[:, j], 2 * s.tau, 12),
            ("kp", 37.0, 500.0, 12),
            ("kd", 1.3, 5.0, 12),
        ):
            assert np.abs(said[key] - values).max() <= 0.51 * span / (2**bits - 1)
        assert (np.abs(inside.v[:, j]) <= drive.speed).all()
        assert (np.abs(inside.tau[:, j]) <= drive.torque).all()


def test_known_frames_are_those_of_the_protocol() -> None:
    """The corners of the ranges, by hand: all zeros, all ones, and the middle."""
    drives = damiao_motors(("j",), {"j": {"motor": "DM4310", "id": 5, "kp": 500, "kd": 5, "v": 90,
                                      "tau": 90}})  # fmt: skip
    s = drives[0].scaling
    q, v, tau = (np.array([[-x], [x], [0.0]]) for x in (s.p, s.v, s.tau))
    made = Commands(("j",), np.array([0.0, 0.005, 1.5]), q, v, v, tau)
    low, high, middle = log_text(made, drives).splitlines()
    assert low == "(0.000000) can0 005#0000000FFFFFF000"
    assert high == "(0.005000) can0 005#FFFFFFFFFFFFFFFF"
    assert middle.startswith("(1.500000) can0 005#8000800FFFFFF800")


def test_python_can_reads_the_log_back(tmp_path: Path) -> None:
    asked = commands(1)
    drives = damiao_motors(asked.joints, {"all": {"motor": "DM4340"}})
    inside, _ = limit_commands(asked, drives, most=1.0)
    file = tmp_path / "motion.log"
    file.write_text(log_text(inside, drives))
    with can.LogReader(str(file)) as reader:
        messages = list(reader)
    assert len(messages) == len(asked) * 3
    for k, message in enumerate(messages):
        sample, j = divmod(k, 3)
        assert message.arbitration_id == drives[j].id
        assert not message.is_extended_id
        assert abs(message.timestamp - asked.t[sample]) < 1e-6
        said = read_frame(drives[j], np.array([list(message.data)], dtype=np.uint8))
        assert abs(said["q"][0] - inside.q[sample, j]) <= 25.0 / (2**16 - 1)


@pytest.mark.parametrize("name", PUBLISHED)
def test_clamping_counts_what_it_clamps(name: str) -> None:
    asked = commands(3, count=400, size=MOTORS[name].speed or 1.0)
    drives = damiao_motors(asked.joints, {"all": {"motor": name, "share": 0.5}})
    inside, report = limit_commands(asked, drives, most=1.0)
    for j, (drive, entry) in enumerate(zip(drives, report, strict=True)):
        assert drive.speed == pytest.approx(0.5 * (MOTORS[name].speed or 0.0))
        for key, limit in (("v", drive.speed), ("tau", drive.torque)):
            beyond = np.abs(getattr(asked, key)[:, j]) > limit
            assert entry["clamped"][key] == pytest.approx(beyond.mean())
            kept = ~beyond
            np.testing.assert_array_equal(
                getattr(inside, key)[kept, j], getattr(asked, key)[kept, j]
            )
    some = max(share for entry in report for share in entry["clamped"].values())
    assert some > 0
    with pytest.raises(UsageError, match="limit of its motor"):
        limit_commands(asked, drives, most=0.99 * some)


def test_scaling_never_stands_in_for_a_limit() -> None:
    for name in SECRET:
        with pytest.raises(UsageError, match="no physical limits"):
            damiao_motors(("j",), {"j": {"motor": name}})
        (drive,) = damiao_motors(("j",), {"j": {"motor": name, **OWN_LIMITS}})
        assert drive.speed <= 3.0
    (drive,) = damiao_motors(("j",), {"j": {"motor": "DM4340"}})
    assert drive.speed < 5.5 < drive.scaling.v  # 52.5 rpm is what it can do, 10 rad/s what bits say
    assert MOTORS["DM4340"].speed == pytest.approx(5.497787143782138)  # 52.5 turns a minute


@pytest.mark.parametrize(
    "bad",
    [
        {"motor": "DM4311"},
        {"motor": "DM4310", "kp": 10, "kd": 0},
        {"motor": "DM4310", "kp": 501},
        {"motor": "DM4310", "id": 0},
        {"motor": "DM4310", "id": 4096},
        {"motor": "DM4310", "v": -1},
        {"motor": "DM4310", "vmx": 1},
    ],
)
def test_drives_that_cannot_be_are_refused_in_words(bad: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        damiao_motors(("j",), {"j": bad})


def test_two_motors_never_share_an_id() -> None:
    with pytest.raises(UsageError, match="same CAN id"):
        damiao_motors(("a", "b"), {"all": {"motor": "DM4310", "id": 3}})


def test_names_of_joints_in_a_csv_are_not_formulas_and_read_back() -> None:
    names = ("=1+1", "-a, b")
    asked = replace(commands(2), joints=names)
    head = next(csv.reader(io.StringIO(commands_csv(asked))))
    assert head[1:3] == ["'=1+1.q", "'-a, b.q"]
    assert [cell_text(name) for name in head[1:3]] == ["=1+1.q", "-a, b.q"]


def test_csv_and_the_table_read_back() -> None:
    asked = commands(2)
    table = pd.read_csv(io.StringIO(commands_csv(asked)), dtype=str)
    for key in ("q", "v", "a", "tau"):
        names = [f"{joint}.{key}" for joint in asked.joints]
        np.testing.assert_array_equal(table[names].to_numpy(dtype=float), getattr(asked, key))
    drives = damiao_motors(asked.joints, {"all": {"motor": "DM4310"}})
    inside, report = limit_commands(asked, drives, most=1.0)
    text = table_text(inside, drives, report)
    table = pd.read_csv(io.StringIO(text), comment="#")
    assert_close(table["j1.v"], inside.v[:, 1], 1e-8)
    assert "VMAX 30" in text


def test_the_ros_message_holds_every_sample() -> None:
    asked = commands(4)
    design_problem = json.loads(json_text(asked))
    assert design_problem["joint_names"] == list(asked.joints)
    for k, point in enumerate(design_problem["points"]):
        since = point["time_from_start"]
        assert since["sec"] + 1e-9 * since["nanosec"] == pytest.approx(asked.t[k], abs=1e-9)
        np.testing.assert_array_equal(point["effort"], asked.tau[k])
    lines = ros2_text(asked).splitlines()
    assert [json.loads(line[2:]) for line in lines[3:]] == design_problem["points"]
    assert lines[2] == "points:"
