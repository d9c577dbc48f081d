"""The command excite: its files agree with its report, and it reports what it cannot do."""

import json
from pathlib import Path
from typing import Any

import can
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner, Result

from sysid_bench.commands.excite import ExciteRequest
from sysid_bench.commands.excite import excite as design
from sysid_bench.commands.main import main
from sysid_bench.errors import UsageError

QUICK = ("--harmonics", "2", "--period", "5 s", "--iterations", "5")
MOTORS = ("--motors", "DM10010,DM10010,DM10010,DM8009,DM8009,DM8009")
PROMISED = {
    "robot", "objective", "condition", "start_condition", "seconds", "limits", "violations", "file",
}  # fmt: skip


def excite(*words: str) -> Result:
    return CliRunner().invoke(main, ["excite", *words])


def test_the_motion_and_its_figures_are_written(tmp_path: Path) -> None:
    file = tmp_path / "motion.csv"
    done = excite("ur5", *QUICK, "--json", "--seed", "3", "-o", str(file))
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)
    assert set(result) >= PROMISED
    assert result["violations"] == []
    assert result["condition"] < result["start_condition"]
    assert set(result["limits"]) == {"position", "velocity", "acceleration", "torque", "collision"}
    assert all(used["margin"] >= 0 for used in result["limits"].values())
    table = pd.read_csv(file)
    assert len(table) == 1000
    np.testing.assert_allclose(np.diff(table["t"]), 0.005, atol=1e-12)
    for joint in result["joints"]:
        slope = np.gradient(table[f"{joint}.q"], table["t"])
        np.testing.assert_allclose(slope[1:-1], table[f"{joint}.v"][1:-1], atol=1e-3)
        assert f"{joint}.tau" in table


def test_a_can_log_holds_a_frame_per_motor_and_sample(tmp_path: Path) -> None:
    file = tmp_path / "motion.log"
    words = ("--export", "can", *MOTORS, "--rate", "100 Hz", "--json", "--clamp", "100 %")
    done = excite("ur5", *QUICK, *words, "-o", str(file))
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)
    assert result["rest"]
    assert result["family"] == "fourier-polynomial"
    assert {drive["motor"] for drive in result["export"]} == {"DM10010", "DM8009"}
    with can.LogReader(str(file)) as reader:
        frames = list(reader)
    assert len(frames) == 500 * 6
    assert {frame.arbitration_id for frame in frames} == set(range(1, 7))


@pytest.mark.long
def test_the_next_motion_reads_the_last_one(tmp_path: Path) -> None:
    first = tmp_path / "first.csv"
    assert excite("ur5", *QUICK, "--objective", "D", "-o", str(first)).exit_code == 0
    alone, after = (
        json.loads(excite("ur5", *QUICK, "--objective", "D", "--json", *more).stdout)
        for more in ((), ("--after", str(first)))
    )
    assert alone["log_det"] != after["log_det"]


def test_a_file_of_another_kind_is_not_replaced(tmp_path: Path) -> None:
    notes, motion = tmp_path / "notes.txt", tmp_path / "motion.csv"
    notes.write_text("mine\n")
    words: dict[str, Any] = {"settings": {"iterations": 1, "harmonics": 2, "period": 3.0}}
    with pytest.raises(UsageError, match="would be lost"):
        design(ExciteRequest("scara", out=notes, **words))
    assert notes.read_text() == "mine\n"
    motion.write_text("t,shoulder.q\n0,0\n")  # as excite writes it
    assert design(ExciteRequest("scara", out=motion, **words)).file == str(motion)


def test_a_file_without_its_format_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"\.csv.*--export"):
        design(ExciteRequest("scara", out=tmp_path / "motion.yaml"))
