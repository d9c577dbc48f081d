"""`identify --task actuators` on recorded legs: errors of the rollout stay below published ones."""

from pathlib import Path

import pytest

import sysid_bench
from reports.make.actuators_ranges import leg_log
from sysid_bench.apps.actuators.commands.actuators_result import CONFOUNDED, ActuatorsResult

TARGETS = {
    ("go2", 0): 4.10, ("go2", 1): 3.78, ("go2", 2): 3.72, ("go2", 3): 3.47, ("go2", 4): 3.47,
    ("go2", 5): 3.30, ("aliengo", 0): 6.57,
}  # fmt: skip
"""mrad: least squares without held commands and filtered friction, at whole samples of delay."""


@pytest.mark.data
@pytest.mark.parametrize(
    ("robot", "run"),
    [pytest.param(*t, marks=pytest.mark.long if 0 < t[1] < 5 else ()) for t in TARGETS],
)
def test_recorded_legs(data_folder: Path, tmp_path: Path, robot: str, run: int) -> None:
    data = data_folder / robot
    file = leg_log(data, tmp_path, run)
    result = sysid_bench.identify(data / f"{robot}.xml", task="actuators", log=file)
    assert isinstance(result, ActuatorsResult)
    assert result.rollout_error is not None
    assert 1e3 * result.rollout_error <= TARGETS[robot, run]
    assert result.confounded
    assert CONFOUNDED in result.summary()
    assert all(joint["Ia"] >= 0.0 for joint in result.joints.values())
