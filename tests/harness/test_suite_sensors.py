"""Where suites cut robots for force/torque sensors is looked up before anything runs."""

import pytest

from sysid_bench.errors import UsageError
from sysid_bench.harness.suite.read import parse_suite

SUITE = """schema = 1
name = "sensors"
[defaults]
task = "robot"
[[robot]]
use = {robots}
sensor = "{sensor}"
[[estimator]]
use = "wls"
"""


def read(robots: str, sensor: str) -> str | None:
    return parse_suite(SUITE.format(robots=robots, sensor=sensor)).robot[0].sensor


@pytest.mark.parametrize("sensor", ["wrist", "forearm_link", "ee_fixed_joint", "wrist, tool0"])
def test_names_of_the_manifest_fixed_joints_and_bodies_are_places(sensor: str) -> None:
    assert read('"ur5"', sensor) == sensor


def test_an_unknown_place_is_told_with_its_line_and_the_nearest_name() -> None:
    with pytest.raises(UsageError, match=r"suite.toml:7: robot\[0\].sensor: .* 'wirst'.*'wrist'"):
        read('["ur5", "z1"]', "wirst")
    with pytest.raises(UsageError, match=r"'l_wrst_1'\. Did you mean 'l_wrist_1'"):
        read('"icub"', "l_arm, l_wrst_1")
    with pytest.raises(UsageError, match="a joint that moves"):
        read('"z1"', "joint3")


def test_a_robot_that_is_not_there_is_told_once() -> None:
    with pytest.raises(UsageError) as caught:
        read('"ur55"', "wrist")
    assert len(str(caught.value).splitlines()) == 1
