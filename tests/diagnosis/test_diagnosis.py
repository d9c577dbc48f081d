"""Diagnosis: intact recordings pass, planted mistakes are named, and cures are what they say."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import sysid_bench
from sysid_bench.commands.diagnose import diagnose as diagnose_log
from sysid_bench.commands.identify import identify
from sysid_bench.diagnosis.channel_checks import recorded_findings
from sysid_bench.diagnosis.contradictions import SEARCHES, contradictions
from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import ERROR, NOTE, WARNING, Finding
from sysid_bench.diagnosis.hypothesis import first_hypothesis
from sysid_bench.diagnosis.joint_checks import joints_without_fit, missing_terms, torque_delay
from sysid_bench.diagnosis.model_candidates import other_robot
from sysid_bench.diagnosis.run_checks import contradictions_left, diagnose
from sysid_bench.diagnosis.torque_candidates import torque_gain
from sysid_bench.errors import UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import parse_payload
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log import read_log
from sysid_bench.signals.log_description import read_description
from sysid_bench.spatial import phi_of
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


def evidence(folder: Path, log: Recorded, robot: RobotModel) -> DiagnoseInput:
    """The recording as it is read from its file."""
    return DiagnoseInput(read_log(read_description(write(folder, log)), robot), robot)


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


@pytest.mark.parametrize(
    ("name", "j", "zero"),
    [("ur5", 2, 0.25), ("ur5", 1, -0.4), ("ur5", 1, 0.8), ("xarm7", 1, 0.4), ("xarm7", 3, -0.3)],
)
def test_a_wrong_zero_is_measured(tmp_path: Path, name: str, j: int, zero: float) -> None:
    log, robot = log_of(name), named_robot(name)
    moved = replace(log, q=log.q + zero * np.eye(log.q.shape[1])[j])
    first, *others = doubts(diagnose(evidence(tmp_path, moved, robot)))
    assert (first.name, first.joints) == ("offset", (robot.rows[j],))
    # Centres of mass within their spread explain a part of an offset.
    cure = np.array([float(x) for x in first.edit.split("[")[1].split("]")[0].split(",")])
    np.testing.assert_allclose(cure, -zero * np.eye(len(cure))[j], atol=0.08 * abs(zero))
    assert "offset" not in [one.name for one in others]


@pytest.mark.parametrize(("name", "unit"), [("ur5", "deg"), ("xarm7", "deg"), ("z1", "mrad")])
def test_positions_in_another_unit_than_stated_are_found(
    tmp_path: Path, name: str, unit: str
) -> None:
    # Too large a motion breaks limits; too small a one looks like a robot that hardly moves.
    robot = named_robot(name)
    path = write(tmp_path, log_of(name), q={"unit": unit}, v=None)
    first, *_ = doubts(diagnose(DiagnoseInput(read_log(read_description(path), robot), robot)))
    assert (first.name, first.edit) == ("units", 'q = { unit = "rad" }')


def test_gravity_of_another_mounting_is_fitted(tmp_path: Path) -> None:
    robot = named_robot("ur5")
    mounted = replace(robot, tree=replace(robot.tree, gravity=np.array([9.81, 0.0, 0.0])))
    first, *_ = doubts(diagnose(evidence(tmp_path, log_of("ur5"), mounted)))
    assert first.name == "gravity"
    assert "90 degrees" in first.message
    assert first.edit.startswith("gravity = [0, 0, -9.81] in robot.toml")
    manifest = replace(robot.manifest, manifest_file=None, path=Path("arm.urdf"))
    lone = replace(mounted, manifest=manifest)
    first, *_ = doubts(diagnose(evidence(tmp_path, log_of("ur5"), lone)))
    assert first.edit.startswith("name the model 'arm.urdf?gravity=0,0,-9.81'")


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


@pytest.mark.long
def test_numbers_in_memory_are_diagnosed_like_their_file(tmp_path: Path) -> None:
    log = replace(log_of("ur5"), tau=-log_of("ur5").tau)
    arrays = {"t": log.t, "q": log.q, "v": log.v, "tau": log.tau}
    given = {"joints": list(log.joints)}
    written = diagnose_log(write(tmp_path, log, "npz"), "ur5")
    for data in (sysid_bench.log_of(arrays, given), frame_of(log)):
        found = diagnose_log(data, "ur5")
        # Edits of columns name those of the file.
        assert [dict(one, log="", alternatives=0) for one in found.findings] == [
            dict(one, log="", alternatives=0) for one in written.findings
        ]
    assert not written.ok


def frame_of(log: Recorded) -> pd.DataFrame:
    words = [f"{signal}_{joint}" for signal in ("q", "v", "tau") for joint in log.joints]
    return pd.DataFrame(np.column_stack([log.t, log.q, log.v, log.tau]), columns=["t", *words])


def test_an_accepted_contradiction_is_said_once(tmp_path: Path) -> None:
    log = _torque(lambda tau, j: _scaled(tau, j, 0))(log_of("ur5"), 5)
    with pytest.raises(UsageError, match="never changes"):
        identify("ur5", log=frame_of(log))
    result = identify("ur5", log=frame_of(log), accept=["zero"])
    assert len([text for text in result.warnings if "never changes" in text]) == 1
    assert len(set(result.warnings)) == len(result.warnings)


@pytest.mark.parametrize("seed", range(3))
def test_copies_are_found_behind_irregular_stamps(tmp_path: Path, seed: int) -> None:
    """Resampling changes each signal apart: copies are looked for in the samples of the file."""
    log, rng = log_of("ur5"), np.random.default_rng(seed)
    kept = np.sort(rng.permutation(len(log.t))[: 9 * len(log.t) // 10])
    tau = log.tau[kept].copy()
    tau[:, 2] = 3.0 * log.v[kept][:, 2]
    lost = Recorded(log.joints, log.t[kept], log.q[kept], log.v[kept], tau)
    found = diagnose(evidence(tmp_path, lost, named_robot("ur5")))
    assert [one.joints for one in found if one.name == "copied"] == [(log.joints[2],)]


@pytest.mark.parametrize("stamped", [True, False])
def test_time_stamps_are_advised_only_where_there_are_none(tmp_path: Path, stamped: bool) -> None:
    log, robot = log_of("ur5"), named_robot("ur5")
    kept = np.delete(np.arange(len(log.t)), np.arange(50, len(log.t) - 50, 50))
    lost = Recorded(log.joints, log.t[kept], log.q[kept], log.v[kept], log.tau[kept])
    timing: dict[str, Any] = {"time": 1, "rate": None} if stamped else {}
    read = read_log(read_description(write(tmp_path, lost, **timing)), robot)
    [gap] = [one for one in recorded_findings(DiagnoseInput(read, robot)) if one.name == "lost"]
    assert ("column of stamps" in gap.edit) != stamped


@pytest.mark.parametrize("known", [True, False])
def test_a_torque_of_friction_is_noted_and_one_of_nothing_is_a_doubt(
    tmp_path: Path, known: bool
) -> None:
    log = log_of("ur5")
    other = np.random.default_rng(0).normal(size=len(log.t) // 15 + 2)
    slow = np.interp(np.arange(len(log.t)) / 15, np.arange(len(other)), other)
    tau = log.tau.copy()
    tau[:, 5] = np.sign(log.v[:, 5]) + 0.2 * log.v[:, 5] if known else slow - slow.mean()
    made = evidence(tmp_path, replace(log, tau=tau), named_robot("ur5"))
    (found,) = (one for one in joints_without_fit(made) if log.joints[5] in one.joints)
    assert found.severity == (NOTE if known else WARNING)


@pytest.mark.parametrize("joint", [2, 4])
def test_a_torque_that_the_model_makes_worse_is_a_doubt(tmp_path: Path, joint: int) -> None:
    """The bodies that the other torques identify give this one the wrong sign, and its own columns
    explain it."""
    log, robot = log_of("ur5"), named_robot("ur5")
    tau = _scaled(log.tau.copy(), joint, -1.0)
    found = list(joints_without_fit(evidence(tmp_path, replace(log, tau=tau), robot)))
    (worse,) = (one for one in found if "worse than zero torque" in one.message)
    assert (worse.severity, worse.joints) == (WARNING, (robot.rows[joint],))
    intact = joints_without_fit(evidence(tmp_path, log, robot))
    assert not [one for one in intact if one.severity == WARNING]


@pytest.mark.parametrize("delay", [0.03, 0.06])
def test_only_long_delays_contradict(tmp_path: Path, delay: float) -> None:
    log = log_of("ur5")
    tau = log.tau.copy()
    tau[:, 1] = np.interp(log.t - delay, log.t, tau[:, 1])
    found = torque_delay(evidence(tmp_path, replace(log, tau=tau), named_robot("ur5")))
    severity = {one.joints[0]: one.severity for one in found}
    assert severity[log.joints[1]] == (ERROR if delay > 0.045 else NOTE)


@pytest.mark.parametrize(
    "joint", [1, None, *(pytest.param(j, marks=pytest.mark.long) for j in (0, 2))]
)
def test_a_gain_is_found_beside_joints_that_nothing_explains(
    tmp_path: Path, joint: int | None
) -> None:
    """Foreign torques on two wrists have most of the cost, and leave the other joints alone."""
    log = log_of("ur5")
    tau = log.tau.copy()
    for k in (4, 5):
        tau[:, k] += 0.5 * tau[:, k].std() * np.sin(2 * np.pi * (0.37 + 0.2 * k) * log.t)
    if joint is not None:
        tau[:, joint] *= 10.0
    foreign = Recorded(log.joints, log.t, log.q, log.v, tau)
    found = contradictions(evidence(tmp_path, foreign, named_robot("ur5")))
    wanted = [] if joint is None else [(log.joints[joint],)]
    assert [one.joints for one in found if one.name == "gain"][:1] == wanted
    assert not wanted or found[0].name == "gain"


@cache
def loaded_log(name: str, mass: float, seed: int = 0) -> Recorded:
    """A motion of a robot with a load that its model lacks, a box of 10 cm off the tool's axis."""
    spec = {"mass": mass, "com": [0.05, 0.0, 0.08], "inertia": "box 0.1 0.1 0.1 m"}
    log = recorded(load_robot(name, parse_payload(spec)), seed)
    size = 0.05 * np.sqrt((log.tau**2).mean(axis=0)) + 0.02
    return replace(log, tau=log.tau + size * np.sign(log.v) + size * log.v)


@pytest.mark.parametrize(
    ("name", "mass"), [("ur5", 3.0), ("kinova", 1.0), ("xarm7", 2.0), ("tx40", 3.0), ("panda", 3.0)]
)
def test_a_load_that_the_model_lacks_is_no_gain(tmp_path: Path, name: str, mass: float) -> None:
    robot = named_robot(name)
    log = replace(loaded_log(name, mass), joints=robot.rows)
    found = diagnose(evidence(tmp_path, log, robot))
    assert not contradictions_left(found, ())
    assert "gain" not in [one.name for one in found]
    (load,) = (one for one in found if one.name == "load")
    found_mass, low, high = map(float, re.findall(r"([\d.]+)(?: kg|,|\])", load.message)[:3])
    assert low <= mass <= high
    assert found_mass == pytest.approx(mass, rel=0.15)


@pytest.mark.parametrize("joint", [0, 1, 4, None])
@pytest.mark.parametrize("factor", [pytest.param(10.0, marks=pytest.mark.long), 0.2])
def test_a_gain_is_no_load(tmp_path: Path, factor: float, joint: int | None) -> None:
    log = log_of("tx40")
    tau = log.tau.copy()
    tau[:, slice(None) if joint is None else joint] *= factor
    found = contradictions(evidence(tmp_path, replace(log, tau=tau), named_robot("tx40")))
    # The torque of the wrist of this arm is friction: ten times it is a larger friction. Torques
    # that are all too small may be currents.
    names = [one.name for one in found if one.name != "current"]
    assert names == ([] if joint == 4 else ["gain"])


def test_a_gain_that_few_samples_leave_open_is_not_named(tmp_path: Path) -> None:
    log = log_of("panda")
    short = Recorded(log.joints, log.t[:60], log.q[:60], log.v[:60], log.tau[:60])
    found = diagnose(evidence(tmp_path, short, named_robot("panda")))
    assert not {"gain", "load"} & {one.name for one in found}


@pytest.mark.parametrize(("name", "factor"), [("ur5", 1.0), ("ur5", -0.3), ("scara", 5.0)])
def test_accelerations_are_no_torques(tmp_path: Path, name: str, factor: float) -> None:
    log, robot = log_of(name), named_robot(name)
    noise = np.random.default_rng(0).normal(size=log.v.shape)
    a = np.gradient(log.v + 1e-4 * noise, log.t, axis=0)
    found = diagnose(evidence(tmp_path, replace(log, tau=factor * a), robot))
    (copied,) = (one for one in found if one.is_error)
    assert (copied.name, copied.joints) == ("copied", robot.rows)
    with pytest.raises(UsageError, match="accelerations"):
        identify(name, log=frame_of(replace(log, tau=factor * a)))


@pytest.mark.parametrize("name", ["ur5", "rv2sq"])
def test_the_robot_that_a_recording_fits_better_is_searched_for_mistakes(
    tmp_path: Path, name: str
) -> None:
    """Its joints have other names than those of the log."""
    log, robot = log_of("kinova"), named_robot(name)
    tau = log.tau.copy()
    tau[:, 0] *= 10.0
    given = evidence(tmp_path, replace(log, tau=tau, joints=robot.rows), robot)
    candidates = other_robot(first_hypothesis(given))
    (kinova,) = (one for one in candidates if one.edit == "--model kinova")
    (gain,) = (
        one for one in torque_gain(kinova.hypothesis) if one.joints == (0,) and one.name == "gain"
    )
    assert gain.edit.startswith("tau = { gain = [0.1, 1, 1, 1, 1, 1]")
    for search in SEARCHES:
        assert all(one.edit for one in search(kinova.hypothesis))


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("j", [0, 2, 3])
def test_torques_too_small_to_be_squared_leave_no_warning(tmp_path: Path, j: int) -> None:
    log, robot = log_of("scara"), named_robot("scara")
    tau = log.tau.copy()
    tau[:, j] *= 1e-300
    assert diagnose(evidence(tmp_path, replace(log, tau=tau), robot))


@pytest.mark.parametrize(
    ("name", "mass"),
    [("ur5", 3.0), ("kinova", 1.0), pytest.param("xarm7", 2.0, marks=pytest.mark.long)],
)
def test_explanations_of_a_contradiction_stand_in_one_table(
    tmp_path: Path, name: str, mass: float
) -> None:
    log = replace(loaded_log(name, mass), joints=named_robot(name).rows)
    result = diagnose_log(write(tmp_path, log), name)
    (load,) = (one for one in result.findings if one["name"] == "load")
    rows = load["alternatives"]
    assert rows[0]["name"] == "load"
    assert "gain" in [row["name"] for row in rows]
    assert len({row["name"] for row in rows}) == len(rows)
    evidence_of = [row["evidence"] for row in rows]
    assert evidence_of == sorted(evidence_of, reverse=True)
    assert all(row["interval"] is None or np.less(*row["interval"]) for row in rows)
    assert f"other explanations: {rows[1]['text']}" in result.summary()


def test_explanations_that_are_as_likely_are_both_named(tmp_path: Path) -> None:
    """Friction alone tells the sign of the last joint, that of its torque or of its motion."""
    log, robot = log_of("ur5"), named_robot("ur5")
    tau = log.tau * np.array([1, 1, 1, 1, 1, -1])
    first, *_ = contradictions(evidence(tmp_path, replace(log, tau=tau), robot))
    assert {one.name for one in first.alternatives} >= {"sign", "direction"}
    assert "as likely" in first.message
    assert all(one.edit in first.edit for one in first.alternatives[:2])


@pytest.mark.parametrize("name", ["ur5", "kinova", "xarm7"])
@pytest.mark.parametrize("link", [1, 2])
def test_a_wrong_link_of_the_model_is_no_mistake_of_the_recording(
    tmp_path: Path, name: str, link: int
) -> None:
    robot = named_robot(name)
    body = int(np.flatnonzero(robot.tree.carrier == link)[0])
    phi = robot.phi.copy()
    phi[body] *= 2.5
    wrong = replace(robot, phi=phi)
    found = contradictions(evidence(tmp_path, log_of(name), wrong))
    assert not [one.name for one in found if one.is_error]


@pytest.mark.parametrize("factor", [0.6, 1.7])
def test_a_small_common_gain_is_a_doubt_and_never_a_refusal(tmp_path: Path, factor: float) -> None:
    log = log_of("ur5")
    found = contradictions(
        evidence(tmp_path, replace(log, tau=factor * log.tau), named_robot("ur5"))
    )
    (gain,) = (row for one in found for row in one.alternatives if row.name == "gain")
    low, high = gain.interval or (0.0, 0.0)
    assert 1.0 < low <= max(factor, 1 / factor) <= high
    assert not [one for one in found if one.is_error]
