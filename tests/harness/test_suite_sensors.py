"""Where suites cut robots for force/torque sensors is looked up before anything runs."""

import pytest

from sysid_bench.errors import UsageError
from sysid_bench.harness.experiment.spec import prior_seed
from sysid_bench.harness.plan import expand
from sysid_bench.harness.suite.read import dump_suite, parse_suite

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


@pytest.mark.parametrize("contacts", ['"detect"', '"1 s to 2 s"', '["1 s to 2 s", "3 s to 4 s"]'])
def test_contacts_are_found_or_declared(contacts: str) -> None:
    text = SUITE.format(robots='"ur5"', sensor="wrist")
    made = parse_suite(
        text.replace("[[robot]]", f"signals = {{ contacts = {contacts} }}\n[[robot]]")
    )
    assert parse_suite(dump_suite(made)) == made
    assert len({cell.labels["signals"] for cell in expand(made).cells}) == 1
    assert "contacts" in expand(made).cells[0].labels["signals"]


def test_a_period_that_is_none_is_told() -> None:
    text = SUITE.format(robots='"ur5"', sensor="wrist")
    with pytest.raises(UsageError, match=r"signals.contacts: A period is a text like"):
        parse_suite(text.replace("[[robot]]", 'signals = { contacts = "often" }\n[[robot]]'))


def test_a_prior_that_is_drawn_again_is_another_with_each_repeat() -> None:
    text = SUITE.format(robots='"ur5"', sensor="wrist")
    for words, draws in (('{ mass = "10 %" }', 1), ('{ mass = "10 %", redrawn = true }', 3)):
        made = parse_suite(
            text.replace(
                "[[robot]]",
                f"prior = {words}\nnoise = {{ tau = '1 %' }}\n[run]\nrepeats = 3\n[[robot]]",
            )  # fmt: skip
        )
        assert len({prior_seed(cell.spec) for cell in expand(made).cells}) == draws
