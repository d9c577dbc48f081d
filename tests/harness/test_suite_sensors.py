"""Where suites cut robots for force/torque sensors is looked up before anything runs."""

import pytest

from sysid_bench.errors import UsageError
from sysid_bench.experiments.spec import prior_seed
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.suite.load_suite import parse_suite, suite_text

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


def test_an_unknown_place_is_reported_with_its_line_and_the_nearest_name() -> None:
    with pytest.raises(UsageError, match=r"suite.toml:7: robot\[0\].sensor: .* 'wirst'.*'wrist'"):
        read('["ur5", "z1"]', "wirst")
    with pytest.raises(UsageError, match=r"'l_wrst_1'\. Did you mean 'l_wrist_1'"):
        read('"icub"', "l_arm, l_wrst_1")
    with pytest.raises(UsageError, match="a moving joint"):
        read('"z1"', "joint3")


def test_a_robot_that_is_not_there_is_reported_once() -> None:
    with pytest.raises(UsageError) as caught:
        read('"ur55"', "wrist")
    assert len(str(caught.value).splitlines()) == 1


def changed(more: str) -> str:
    """The suite of a ur5 with more lines before its robot."""
    text = SUITE.format(robots='"ur5"', sensor="wrist")
    return text.replace("[[robot]]", f"{more}\n[[robot]]")


@pytest.mark.parametrize("contacts", ['"detect"', '"1 s to 2 s"', '["1 s to 2 s", "3 s to 4 s"]'])
def test_contacts_are_found_or_declared(contacts: str) -> None:
    made = parse_suite(changed(f"signals = {{ contacts = {contacts} }}"))
    assert parse_suite(suite_text(made)) == made
    assert "contacts" in cells_of_suite(made).cells[0].labels["signals"]


def test_a_period_that_is_none_is_reported() -> None:
    with pytest.raises(UsageError, match=r"signals.contacts: A period is a text like"):
        parse_suite(changed('signals = { contacts = "often" }'))


@pytest.mark.parametrize(
    ("prior", "draws"), [('{ mass = "10 %" }', 1), ('{ mass = "10 %", redrawn = true }', 3)]
)
def test_a_prior_that_is_drawn_again_is_another_with_each_repeat(prior: str, draws: int) -> None:
    more = f"prior = {prior}\nnoise = {{ tau = '1 %' }}\n[run]\nrepeats = 3"
    cells = cells_of_suite(parse_suite(changed(more))).cells
    assert len(cells) == 3
    assert len({prior_seed(cell.spec) for cell in cells}) == draws
