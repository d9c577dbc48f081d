"""Diagnosis: intact recordings pass, planted mistakes are named, and cures are what they say."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sysid_bench.diagnosis.checks.missing_terms import missing_terms
from sysid_bench.diagnosis.evidence import Evidence
from sysid_bench.diagnosis.finding import NOTE, Finding
from sysid_bench.diagnosis.hypothesis import first_hypothesis
from sysid_bench.diagnosis.run_checks import contradictions_left, diagnose
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log import read_log
from sysid_bench.signals.log_description import read_description
from sysid_bench.spatial.inertia import phi_of
from sysid_bench.types import Array
from tests.robots import named_robot
from tests.signals.logs import Recorded, recorded, write


@cache
def log_of(name: str, seed: int = 0) -> Recorded:
    """A motion of a robot with friction of a twentieth of each joint's torque and some noise."""
    log = recorded(named_robot(name), seed)
    size = 0.05 * np.sqrt((log.tau**2).mean(axis=0)) + 0.02
    friction = size * np.sign(log.v) + size * log.v
    noise = 0.02 * size * np.random.default_rng(seed).normal(size=log.tau.shape)
    return replace(log, tau=log.tau + friction + noise)


def evidence(folder: Path, log: Recorded, robot: RobotModel) -> Evidence:
    """The recording as it is read from its file."""
    return Evidence(read_log(read_description(write(folder, log)), robot), robot)


def doubts(findings: list[Finding]) -> list[Finding]:
    return [finding for finding in findings if finding.severity != NOTE]


@pytest.mark.parametrize("name", ["ur5", "xarm7", "scara"])
def test_an_intact_recording_has_no_doubts(tmp_path: Path, name: str) -> None:
    found = diagnose(evidence(tmp_path, log_of(name), named_robot(name)))
    assert not doubts(found), doubts(found)


Change = Callable[[Recorded, int], Recorded]


def _torque(change: Callable[[Array, int], Array]) -> Change:
    return lambda log, j: replace(log, tau=change(log.tau.copy(), j))


def _scaled(tau: Array, j: int, factor: float) -> Array:
    tau[:, j] *= factor
    return tau


def _swapped(x: Array, j: int) -> Array:
    order = list(range(x.shape[1]))
    order[j], order[j + 1] = j + 1, j
    return x[:, order]


def _late(tau: Array, j: int) -> Array:
    tau[:, j] = np.interp(np.arange(len(tau)) - 10, np.arange(len(tau)), tau[:, j])
    return tau


def _turned(log: Recorded, j: int) -> Recorded:
    sign = np.ones(log.q.shape[1])
    sign[j] = -1
    return replace(log, q=log.q * sign, v=log.v * sign)


def _spiked(tau: Array, j: int) -> Array:
    tau[::97, j] = 4 * np.sqrt((tau[:, j] ** 2).mean())
    return tau


PLANTED: dict[str, tuple[str, Change]] = {
    "all torques negated": ("sign", lambda log, j: replace(log, tau=-log.tau)),
    "one torque negated": ("sign", _torque(lambda tau, j: _scaled(tau, j, -1))),
    "one drive constant wrong": ("gain", _torque(lambda tau, j: _scaled(tau, j, 0.2))),
    "motor-side torque": ("gain", lambda log, j: replace(log, tau=0.01 * log.tau)),
    "torque columns exchanged": ("columns", _torque(_swapped)),
    "positions exchanged": (
        "columns", lambda log, j: replace(log, q=_swapped(log.q, j), v=_swapped(log.v, j))),
    "one joint turned": ("direction", _turned),
    "torque late": ("delay", _torque(_late)),
    "torque column zero": ("zero", _torque(lambda tau, j: _scaled(tau, j, 0))),
    "spikes": ("spikes", _torque(_spiked)),
}  # fmt: skip


@pytest.mark.parametrize("kind", PLANTED)
def test_a_planted_mistake_is_named_first(tmp_path: Path, kind: str) -> None:
    name, change = PLANTED[kind]
    robot = named_robot("ur5")
    first, *_ = doubts(diagnose(evidence(tmp_path, change(log_of("ur5"), 1), robot)))
    assert first.name == name
    assert not first.joints or robot.rows[1] in first.joints
    assert first.edit


def test_a_wrong_zero_is_measured(tmp_path: Path) -> None:
    log = log_of("ur5")
    moved = replace(log, q=log.q + np.array([0, 0, 0.25, 0, 0, 0]))
    first, *_ = doubts(diagnose(evidence(tmp_path, moved, named_robot("ur5"))))
    assert (first.name, first.joints) == ("offset", ("elbow_joint",))
    assert "0.2" in first.message


def test_gravity_of_another_mounting_is_fitted(tmp_path: Path) -> None:
    robot = named_robot("ur5")
    mounted = replace(robot, tree=replace(robot.tree, gravity=np.array([9.81, 0.0, 0.0])))
    first, *_ = doubts(diagnose(evidence(tmp_path, log_of("ur5"), mounted)))
    assert first.name == "gravity"
    assert "90 degrees" in first.message


def test_gains_of_a_model_without_inertias_are_left_alone(tmp_path: Path) -> None:
    robot = named_robot("ur5")
    alike = phi_of(2.0, np.zeros(3), 0.01 * np.eye(3))
    bare = replace(robot, phi=np.tile(alike, (len(robot.phi), 1)))
    found = diagnose(evidence(tmp_path, log_of("ur5"), bare))
    assert not contradictions_left(found, ())
    assert "inertias" in [finding.name for finding in found]


def test_friction_never_pushes_in_a_fit_near_the_model(tmp_path: Path) -> None:
    log = log_of("ur5")
    for tau in (log.tau, -log.tau):
        fit = first_hypothesis(evidence(tmp_path, replace(log, tau=tau), named_robot("ur5"))).fit
        assert (fit.terms[:, :3] >= 0).all()
        assert np.isfinite(fit.cost)


def test_an_accepted_contradiction_lets_the_checks_go_on(tmp_path: Path) -> None:
    made = evidence(tmp_path, replace(log_of("ur5"), tau=-log_of("ur5").tau), named_robot("ur5"))
    stopped, further = diagnose(made), diagnose(made, ["sign"])
    assert contradictions_left(stopped, ())
    assert not contradictions_left(further, ["sign"])
    assert len(further) > len(stopped)


@pytest.mark.parametrize("joint", [3, 4, 5])
def test_rotors_are_advised_only_where_the_terms_of_the_robot_lack_them(
    tmp_path: Path, joint: int
) -> None:
    """ur5 names viscous and Coulomb friction; a manifest without terms has rotors by default.
    Rotors of the first joints are nearly one parameter with the inertia of what they carry."""
    named, log = named_robot("ur5"), log_of("ur5")
    a = np.gradient(log.v[:, joint], log.t)
    rotor = np.abs(log.tau[:, joint]).max() / np.abs(a).max() * np.eye(6)[joint]
    heavy = replace(log, tau=log.tau + np.outer(a, rotor))
    unnamed = replace(named, manifest=replace(named.manifest, terms=()))
    advised = [
        {
            finding.joints[0]
            for finding in missing_terms(evidence(tmp_path, heavy, robot))
            if finding.message.startswith("armature")
        }
        for robot in (named, unnamed)
    ]
    assert log.joints[joint] in advised[0]
    assert advised[1] == set()
