"""Redundant equations of closed chains that contradict each other: rounded positions of sites."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sysid_bench.commands.crosscheck import crosscheck as crosscheck_files
from sysid_bench.errors import ModelError
from sysid_bench.evaluation.crosscheck import Crosscheck, crosscheck
from sysid_bench.models.robot import RobotModel
from tests.coupling.mechanisms import INERTIAL
from tests.robots import robot_of

RODS = (("front", 0.008), ("back", -0.007))


def _site(name: str, position: np.ndarray, rng: np.random.Generator, error: float) -> str:
    """A site with its position off by `error` (m) along each axis."""
    off = position + error * rng.choice([-1, 1], 3)
    return f'<site name="{name}" pos="{" ".join(repr(float(x)) for x in off)}"/>'


def neck(seed: int, error: float) -> str:
    """A head that two parallel rods turn, each held by connects at both ends of its pin: twelve
    equations, of which three are independent."""
    rng = np.random.default_rng(seed)
    length, width = rng.uniform(0.03, 0.06), rng.uniform(0.05, 0.1)
    rods, ends = "", ""
    for name, x in RODS:
        pin = (np.array([0, 0, -length]), np.array([0, width, -length]))
        sites = "".join(_site(f"{name}{k}", p, rng, error) for k, p in enumerate(pin))
        ends += "".join(
            _site(f"{name}{k}_base", np.array([x, 0, 0.02]) + p * [1, 1, 0], rng, error)
            for k, p in enumerate(pin)
        )
        rods += (
            f'<body name="{name}" pos="{x} 0 0"><joint name="{name}" axis="0 -1 0"/>'
            f"{INERTIAL}{sites}</body>"
        )
    plate = (
        f'<body name="plate" pos="0 0 {length}"><joint name="plate" axis="0 -1 0" '
        f'range="-.6 1"/>{INERTIAL}{rods}</body>'
    )
    head = (
        f'<body name="head" pos="0 0 .02"><joint name="head" axis="0 1 0"/>{INERTIAL}{plate}</body>'
    )
    equalities = "".join(
        f'<connect site1="{name}{k}" site2="{name}{k}_base"/>' for name, _ in RODS for k in (0, 1)
    )
    return (
        '<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body name="yaw" '
        f'euler=".2 .3 .1"><joint name="yaw"/>{INERTIAL}{ends}{head}</body></worldbody>'
        f'<equality>{equalities}</equality><actuator><motor joint="yaw"/><motor joint="plate"/>'
        "</actuator></mujoco>"
    )


def _checked(seed: int, error: float) -> tuple[RobotModel, Crosscheck]:
    robot = robot_of(neck(seed, error))
    return robot, crosscheck(robot, 8)


def assert_blamed(seed: int, error: float) -> None:
    """Torques agree as far as the loops close, and the note states how far that is."""
    robot, check = _checked(seed, error)
    assert robot.torque_rows == ("yaw", "plate")
    assert check.ok(), check.reason()
    assert check.coupling is not None
    assert check.coupling.inconsistency < max(1e-10, 1e4 * error)
    assert ("close to" in check.coupling.note) == (error > 0)


@pytest.mark.parametrize("error", [0.0, 2.7e-8])
def test_rounded_sites_are_blamed_and_torques_agree(error: float) -> None:
    assert_blamed(0, error)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(1, 6))
@pytest.mark.parametrize("error", [0.0, 1e-9, 2.7e-8, 1e-6])
def test_rounded_sites_of_many_necks(error: float, seed: int) -> None:
    assert_blamed(seed, error)


def test_sites_that_are_far_apart_are_an_error_of_the_file() -> None:
    with pytest.raises(ModelError, match="head, plate, front, back cannot be closed"):
        robot_of(neck(0, 1e-4))


def test_a_wrong_coupling_is_found_in_spite_of_the_slack() -> None:
    _, check = _checked(0, 2.7e-8)
    assert check.coupling is not None
    for name in ("gap", "closure", "jacobian"):
        wrong = replace(check, coupling=replace(check.coupling, **{name: 1e-3}))
        assert not wrong.ok()
        assert f"coupled {name} 0.001 is above" in wrong.reason()
        assert "contradict each other" in wrong.reason_text()
        assert "engines disagree" not in wrong.reason_text()
    disagreeing = replace(check, gap=1e-6)
    assert disagreeing.reason_text().startswith("the engines disagree: gap 1e-06")


def test_the_answer_states_how_far_the_loops_close(tmp_path: Path) -> None:
    file = tmp_path / "neck.xml"
    file.write_text(neck(1, 2.7e-8))
    (verdict,) = crosscheck_files(file, samples=3)
    assert verdict.ok
    assert "contradict each other: they close to" in verdict.summary()
    assert verdict["coupling"]["note"] in verdict.summary()
