"""Gains of joints of their own: some joints, and currents; whatever the other torques are."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sysid_bench.diagnosis.contradictions import contradictions
from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import WARNING
from sysid_bench.diagnosis.gain_candidates import joint_gains
from sysid_bench.diagnosis.hypothesis import first_hypothesis
from sysid_bench.diagnosis.run_checks import diagnose
from sysid_bench.diagnosis.torque_candidates import open_gains
from sysid_bench.signals.log import read_log
from sysid_bench.signals.log_description import read_description
from tests.diagnosis.test_diagnosis import evidence, loaded_log, log_of
from tests.robots import named_robot
from tests.signals.logs import write


def numbers(edit: str) -> list[float]:
    return [float(x) for x in edit.split("gain = [")[1].split("]")[0].split(",")]


@pytest.mark.parametrize(
    ("wrong", "factor"),
    [
        pytest.param((0, 1, 2), 100.0, marks=pytest.mark.long),
        ((2, 3), 0.02),
        pytest.param((3, 4, 5), 100.0, marks=pytest.mark.long),
    ],
)
def test_one_factor_on_some_joints_is_named(
    tmp_path: Path, wrong: tuple[int, ...], factor: float
) -> None:
    log, robot = log_of("panda"), named_robot("panda")
    gains = np.where(np.isin(np.arange(len(robot.rows)), wrong), factor, 1.0)
    made = evidence(tmp_path, replace(log, tau=log.tau * gains), robot)
    first = contradictions(made)[0]
    assert first.name == "gain"
    assert first.joints == tuple(robot.rows[j] for j in sorted(wrong))
    np.testing.assert_allclose(np.array(numbers(first.edit)) * gains, 1.0, rtol=0.6)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
def test_currents_are_no_torques(tmp_path: Path, seed: int) -> None:
    log, robot = log_of("panda"), named_robot("panda")
    constants = np.exp(np.random.default_rng(seed).uniform(np.log(5), np.log(50), len(robot.rows)))
    made = evidence(tmp_path, replace(log, tau=log.tau / constants), robot)
    first = contradictions(made)[0]
    assert (first.name, first.joints) == ("current", robot.rows)
    assert 'unit = "A"' in first.edit
    ratio = np.array(numbers(first.edit)) / constants
    assert np.median(np.abs(np.log(ratio))) < np.log(1.5)


@pytest.mark.parametrize("name", ["panda", "xarm7", "scara", "kinova"])
def test_intact_torques_have_no_gains_of_their_own(tmp_path: Path, name: str) -> None:
    """The model file's masses are off by a third in turn."""
    log, robot = log_of(name), named_robot(name)
    factors = np.where(np.arange(len(robot.phi)) % 2, 1.33, 0.75)
    scaled = replace(robot, phi=robot.phi * factors[:, None])
    assert not list(joint_gains(first_hypothesis(evidence(tmp_path, log, scaled))))


@pytest.mark.parametrize(
    ("name", "mass"), [pytest.param("panda", 1.6, marks=pytest.mark.long), ("ur5", 2.0)]
)
@pytest.mark.parametrize("factor", [0.01, 3.0])
def test_a_gain_of_all_joints_is_found_behind_a_tool(
    tmp_path: Path, name: str, mass: float, factor: float
) -> None:
    """The tool alone would make a gain too large, or a small one too small."""
    log = replace(loaded_log(name, mass), joints=named_robot(name).rows)
    made = evidence(tmp_path, replace(log, tau=factor * log.tau), named_robot(name))
    first = contradictions(made)[0]
    assert first.name == "gain"
    np.testing.assert_allclose(
        float(first.alternatives[0].estimate.split()[0]), max(factor, 1 / factor), rtol=0.4
    )
    assert re.findall(r"load of ([\d.]+) kg", first.message)


@pytest.mark.filterwarnings("error")
def test_a_joint_without_motion_and_torque_has_no_gain(tmp_path: Path) -> None:
    log, robot = log_of("panda"), named_robot("panda")
    free = np.arange(len(robot.rows)) != 6
    log = replace(log, q=log.q * free, v=log.v * free, tau=log.tau * free)
    assert not list(joint_gains(first_hypothesis(evidence(tmp_path, log, robot))))


@pytest.mark.parametrize(
    ("name", "mass"), [("ur5", 3.0), pytest.param("panda", 3.0, marks=pytest.mark.long)]
)
def test_a_mistake_hidden_behind_a_load_comes_first(tmp_path: Path, name: str, mass: float) -> None:
    log = replace(loaded_log(name, mass), joints=named_robot(name).rows)
    signs = np.where(np.arange(log.tau.shape[1]) == 2, -1.0, 1.0)
    found = contradictions(evidence(tmp_path, replace(log, tau=log.tau * signs), named_robot(name)))
    assert [one.name for one in found[:2]] == ["sign", "load"]
    assert found[0].is_error
    assert found[0].joints == log.joints[2:3]


@pytest.mark.parametrize("factor", [0.1, pytest.param(10.0, marks=pytest.mark.long)])
def test_a_factor_that_is_not_sure_is_no_number_in_a_cure(tmp_path: Path, factor: float) -> None:
    """Whatever is found: numbers in a cure are right within 3 on each joint that they change."""
    log, robot = log_of("tx40"), named_robot("tx40")
    for wrong in ((0,), (1, 2), (4, 5)):
        gains = np.where(np.isin(np.arange(6), wrong), factor, 1.0)
        made = evidence(tmp_path, replace(log, tau=log.tau * gains), robot)
        for found in contradictions(made):
            if "gain = [" in found.edit:
                cure = np.array(numbers(found.edit))
                changed = cure != 1.0
                assert (np.abs(np.log(cure * gains))[changed] < np.log(3)).all(), found.message


@pytest.mark.parametrize("name", ["ur5", "kinova"])
def test_friction_far_beyond_what_a_drive_holds_is_a_unit(tmp_path: Path, name: str) -> None:
    """Friction alone: no link decides the factor."""
    robot, log = named_robot(name), log_of(name)
    held = evidence(tmp_path, log, robot).holding
    friction = 0.1 * held * np.tanh(log.v / 0.02)
    slow = replace(log, tau=1e-3 * log.tau + friction)
    scores = [
        first_hypothesis(evidence(tmp_path, replace(slow, tau=k * slow.tau), robot)).fit.score
        for k in (1.0, 1e3)
    ]
    assert scores[1] - scores[0] > 6.0


def test_explanations_with_a_number_have_its_interval(tmp_path: Path) -> None:
    log = log_of("ur5")
    moved = replace(log, q=log.q + 0.4 * np.eye(6)[1])
    first, *_ = contradictions(evidence(tmp_path, moved, named_robot("ur5")))
    zero = first.alternatives[0]
    assert (zero.name, zero.estimate.split()[1]) == ("offset", "rad")
    low, high = zero.interval or (0.0, 0.0)
    assert 0.0 < low < 0.4 < high


@pytest.mark.parametrize("factor", [0.2, 5.0])
def test_a_gain_that_friction_hides_is_named_as_undecided(tmp_path: Path, factor: float) -> None:
    """The last joint of this arm carries next to nothing: its torque is friction."""
    log, robot = log_of("tx40"), named_robot("tx40")
    tau = log.tau * np.where(np.arange(6) == 5, factor, 1.0)
    found = diagnose(evidence(tmp_path, replace(log, tau=tau), robot))
    assert not [one for one in found if one.name == "gain" and log.joints[5] in one.joints]
    (note,) = (one for one in found if one.name == "undecided")
    assert log.joints[5] in note.joints
    assert log.joints[1] not in note.joints


@pytest.mark.parametrize(("name", "signed"), [("kinova", False), ("ur5", True)])
def test_currents_of_joints_that_follow_the_model_are_named(
    tmp_path: Path, name: str, signed: bool
) -> None:
    """Each joint has a torque constant of its own, some a sign, and friction leaves wrists open."""
    log, robot = log_of(name), named_robot(name)
    rng = np.random.default_rng(0)
    constants = np.exp(rng.uniform(np.log(5), np.log(50), len(robot.rows)))
    constants *= np.where(signed & (np.arange(len(constants)) % 2 == 1), -1.0, 1.0)
    factors = np.where(np.arange(len(robot.phi)) % 2, 1.2, 0.8)
    scaled = replace(robot, phi=robot.phi * factors[:, None])
    first = contradictions(evidence(tmp_path, replace(log, tau=log.tau / constants), scaled))[0]
    assert (first.name, first.is_error) == ("current", True)
    for text in (first.message, first.edit):
        assert "current" in text


@pytest.mark.parametrize("stated", [{}, {"unit": ("N m",)}, {"ratio": (100.0,)}])
def test_torques_that_may_be_currents_are_a_doubt_unless_their_scale_is_stated(
    tmp_path: Path, stated: dict[str, tuple[str | float, ...]]
) -> None:
    """Friction is most of each torque: its size says nothing of the unit."""
    log, robot = log_of("ur5"), named_robot("ur5")
    size = 3.0 * np.sqrt((log.tau**2).mean(axis=0))
    rubbed = replace(log, tau=(log.tau + size * np.sign(log.v) + size * log.v) / 10.0)
    rubbed = replace(rubbed, tau=rubbed.tau / (100.0 if "ratio" in stated else 1.0))
    path = write(tmp_path, rubbed)
    described = read_description(path)
    described = replace(described, tau=described.tau.model_copy(update=stated))
    found = list(open_gains(DiagnoseInput(read_log(described, robot), robot)))
    doubts = [one for one in found if one.severity == WARNING]
    assert len(doubts) == (0 if stated else 1)
    assert all("currents" in one.message and "unit" in one.edit for one in doubts)
