"""`init log` of positions and commands: gains of the model's position actuators are a start."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sysid_bench
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.mjcf import stated_actuators
from tests.actuators.leg import JOINTS, MODEL, RATE, Case

POSITION = '<position joint="{0}" kp="{1}" kv="{2}" gear="{3}"/>'


def with_actuators(folder: Path, texts: list[str]) -> Path:
    start = MODEL.partition("<actuator>")[0]
    file = folder / "servo.xml"
    file.write_text(f"{start}<actuator>{''.join(texts)}</actuator></mujoco>", encoding="utf-8")
    return file


def recorded(folder: Path) -> Path:
    commands = Case(0, delay=0.004, seconds=4.0).commands()
    columns = {f"{j}.{kind}": getattr(commands, kind)[:, i]
               for kind in ("q", "q_des") for i, j in enumerate(JOINTS)}  # fmt: skip
    table = np.column_stack([np.arange(len(commands)) / RATE, *columns.values()])
    file = folder / "run.csv"
    np.savetxt(file, table, delimiter=",", header=",".join(["t", *columns]), comments="")
    return file


def test_gains_of_the_file_are_a_start(tmp_path: Path) -> None:
    texts = [POSITION.format(joint, 10 + i, 0.5, 2) for i, joint in enumerate(JOINTS)]
    model = with_actuators(tmp_path, texts)
    # Force of the actuator times the gear, at a position times the gear.
    assert [stated_actuators(find_manifest(str(model)))[joint].kp for joint in JOINTS] == [
        40.0,
        44.0,
        48.0,
    ]
    result = sysid_bench.init_log(recorded(tmp_path), model=str(model))
    text = Path(result.file).read_text(encoding="utf-8")
    assert "kp = [40.0, 44.0, 48.0]" in text
    assert "--also gain" in result.next
    assert any("a start" in doubt for doubt in result.doubts)


@pytest.mark.parametrize("without", range(3))
def test_a_joint_without_a_position_actuator_leaves_the_gains_open(
    tmp_path: Path, without: int
) -> None:
    texts = [POSITION.format(joint, 10, 0.5, 1) for joint in JOINTS]
    texts[without] = f'<motor joint="{JOINTS[without]}" ctrlrange="-3 4" gear="5"/>'
    model = with_actuators(tmp_path, texts)
    assert stated_actuators(find_manifest(str(model)))[JOINTS[without]].limit == 15.0
    result = sysid_bench.init_log(recorded(tmp_path), model=str(model))
    assert "complete tau" in result.next


def test_actuators_are_read_as_the_robot_is(tmp_path: Path) -> None:
    """From a text that MuJoCo takes with repairs alone, and from one without a file."""
    texts = [POSITION.format(joint, 10, 0.5, 1) for joint in JOINTS]
    model = with_actuators(tmp_path, texts)
    text = model.read_text(encoding="utf-8")
    place = '<inertial pos="0 .02 -.03"'
    assert place in text
    # MuJoCo refuses an inertial frame without a place.
    model.write_text(text.replace(place, "<inertial"), encoding="utf-8")
    repaired = load_robot(find_manifest(str(model)))
    assert repaired.repairs
    assert stated_actuators(repaired.manifest)[JOINTS[0]].kp == 10.0
    without = replace(find_manifest(str(model)), path=tmp_path / "no file.xml", text=text)
    assert stated_actuators(without)[JOINTS[0]].kp == 10.0
