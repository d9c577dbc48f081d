"""Law of columns without names: in any order each block gets its role, or it is refused."""

import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sysid_bench import init_log
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.column_roles import explain_columns
from sysid_bench.signals.log_description import read_description
from sysid_bench.signals.log_guess import scalar_joints
from sysid_bench.signals.log_samples import read_samples
from sysid_bench.signals.log_source import read_time
from sysid_bench.signals.torque_scale import scale_contradiction
from sysid_bench.types import Array
from tests.robots import named_robot

from .logs import recorded


def layout(t: Array, q: Array, v: Array, tau: Array, seed: int) -> dict[str, Array]:
    """Blocks of a recording in a random order, some left out, among others of no use."""
    random = np.random.default_rng(seed)
    k, N = q.shape[1], len(t)
    gains = random.uniform(5.0, 15.0, k)
    noise = 0.01 * tau.std(axis=0) * random.standard_normal(tau.shape)
    warming = np.cumsum(random.uniform(0, 1, (N, k)), axis=0) / N * random.uniform(2, 8, k)
    blocks = {
        "position": q,
        "velocity": v,
        "acceleration": np.gradient(v, t, axis=0),
        "torque": tau,
        "current": (tau + noise) / gains,
        "time": t[:, None],
        "counter": np.arange(N)[:, None] + 17.0,
        "temperature": 30.0 + warming,
    }
    left_out = {1: ["torque"], 2: ["current"]}.get(seed % 3, []) + ["time"] * (seed % 5 == 4)
    names = [name for name in blocks if name not in left_out]
    random.shuffle(names)
    return {name: blocks[name] for name in names}


def mistakes(blocks: Mapping[str, Array], robot: RobotModel) -> dict[str, str]:
    """True role -> given one, of blocks that do not have theirs."""
    place, truth = 0, {}
    for name, x in blocks.items():
        truth[tuple(range(place, place + x.shape[1]))] = name
        place += x.shape[1]
    given = explain_columns(np.hstack(list(blocks.values())), robot, scalar_joints(robot))
    assert sorted(column for block in given for column in block.columns) == list(range(place))
    assert all(block.reason for block in given)
    roles = {column: block.role for block in given for column in block.columns}
    whole = {block.columns for block in given}
    return {
        name: roles[columns[0]]
        for columns, name in truth.items()
        if name not in ("temperature", "counter")
        and (columns not in whole or roles[columns[0]] != name)
    }


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("name", ["ur5", "z1"])
def test_blocks_in_any_order_are_recognised(name: str, seed: int) -> None:
    robot = named_robot(name)
    log = recorded(robot, seed, period=2.0)
    random = np.random.default_rng(seed)
    friction = 0.2 * log.tau.std(axis=0) * np.tanh(log.v / 0.05)
    tau = log.tau + friction + 0.01 * log.tau.std(axis=0) * random.standard_normal(log.tau.shape)
    wrong = mistakes(layout(log.t, log.q, log.v, tau, seed), robot)
    # A torque whose scale the motion does not show wants a gain, if only 1.
    assert wrong.items() <= {("torque", "current")}


@pytest.mark.long
@pytest.mark.data
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize(
    "motion",
    ["ur10/first", "fer/first", "ur10e/fourier-30s", "panda/first", "double_pendulum_a/small"],
)
def test_recorded_blocks_in_any_order_are_recognised(
    motion: str, seed: int, data_folder: Path
) -> None:
    assert data_folder.is_dir()
    robot = load_robot(find_manifest(f"dataset:{motion.partition('/')[0]}"))
    log = replace(read_description(Path(f"dataset:{motion}")), rows=None)
    samples = read_samples(log, robot)
    t = read_time(log, len(samples))
    assert t is not None
    assert samples.v is not None
    rows = np.concatenate([[True], np.diff(t) > 0])
    q, v, tau = (x[rows] for x in (samples.q, samples.v, samples.tau))
    assert mistakes(layout(t[rows], q, v, tau, seed), robot) == {}


@pytest.mark.parametrize("taken", ["position", "velocity", "acceleration"])
def test_blocks_that_are_no_torque_are_refused(taken: str, tmp_path: Path) -> None:
    robot = named_robot("ur5")
    log = recorded(robot, period=2.0)
    random = np.random.default_rng(0)
    blocks = {"time": log.t[:, None], "position": log.q, "velocity": log.v}
    blocks["acceleration"] = np.gradient(log.v, log.t, axis=0)
    blocks["noise"] = random.standard_normal(log.q.shape)
    blocks = {name: x for name, x in blocks.items() if name != taken}
    np.savetxt(tmp_path / "run.csv", np.hstack(list(blocks.values())), delimiter=",")
    doubts = init_log(tmp_path / "run.csv", "ur5").doubts
    assert "without torques" in doubts[0]
    # Rates and their derivative look as positions and theirs; only a torque tells.
    said = any("or velocities and accelerations" in doubt for doubt in doubts)
    assert said == (taken != "velocity")  # of positions the second derivative is known


def test_times_that_fall_say_nothing_about_the_scale() -> None:
    robot = named_robot("ur5")
    log = recorded(robot, 0, period=8.0)
    assert scale_contradiction(log.q, 50 * log.tau, log.t[::-1], robot, robot.rows) == ""


def test_a_misspelt_joint_is_doubted(tmp_path: Path) -> None:
    robot = named_robot("ur5")
    log = recorded(robot, 0, period=8.0)
    columns = {"t": log.t}
    for name, x in (("q", log.q), ("tau", log.tau)):
        columns |= {f"{joint}.{name}": x[:, i] for i, joint in enumerate(robot.rows)}
    table = pd.DataFrame(columns)
    table.to_csv(tmp_path / "right.csv", index=False)
    assert not any("still" in doubt for doubt in init_log(tmp_path / "right.csv", "ur5").doubts)
    wrong = table.rename(columns=lambda name: name.replace("elbow_", "elbo_"))
    wrong.to_csv(tmp_path / "wrong.csv", index=False)
    doubts = init_log(tmp_path / "wrong.csv", "ur5").doubts
    assert any("'elbow_joint'" in doubt and "'elbo_joint.q'" in doubt for doubt in doubts)


@pytest.mark.parametrize("scale", [1.0, 0.01, 0.1, 180 / np.pi])
@pytest.mark.parametrize("seed", range(3))
def test_currents_by_the_name_of_torques_are_found(scale: float, seed: int) -> None:
    robot = named_robot("ur5")
    log = recorded(robot, seed, period=8.0)
    gains = scale * np.random.default_rng(seed).uniform(0.8, 1.25, 6)
    said = scale_contradiction(log.q, gains * log.tau, log.t, robot, robot.rows)
    assert ("per N m: a current" in said) == (scale != 1.0)
    size = scale_contradiction(log.q, np.abs(log.tau), log.t, robot, robot.rows)
    assert "without its sign" in size


def test_columns_of_one_joint_after_the_other_are_recognised() -> None:
    robot = named_robot("ur5")
    log = recorded(robot, period=2.0)
    joints = [x for j in range(6) for x in (log.q[:, j], log.v[:, j], log.tau[:, j])]
    found = explain_columns(np.column_stack([log.t, *joints]), robot, robot.rows)
    roles = {block.role: block.columns for block in found}
    for first, role in enumerate(("position", "velocity", "torque"), start=1):
        assert roles[role] == tuple(range(first, 19, 3))
    assert roles["time"] == (0,)


@pytest.mark.parametrize("seed", range(3))
def test_positions_without_rates_are_those_of_the_model_and_rates_are_none(seed: int) -> None:
    robot = named_robot("ur5")
    log = recorded(robot, seed, period=2.0)
    found = explain_columns(np.hstack([log.tau, log.q, log.t[:, None]]), robot, robot.rows)
    roles = {block.role: block.columns for block in found}
    assert roles["position"] == tuple(range(6, 12))
    assert roles.get("torque", roles.get("current")) == tuple(range(6))
    found = explain_columns(np.hstack([log.v, log.tau]), robot, robot.rows)
    assert {block.role for block in found} == {"unexplained"}


@pytest.mark.long
@pytest.mark.data
def test_no_torque_of_a_known_robot_is_taken_for_a_current(data_folder: Path) -> None:
    tried = 0
    for file in sorted((data_folder / "robots").glob("*.xml")):
        robot = load_robot(file)
        scalar = all(joint.kind in ("hinge", "slide") for joint in robot.joints)
        if robot.nv > 14 or robot.coupling is not None or not scalar:
            continue
        log = recorded(robot, period=4.0)
        friction = 0.15 * log.tau.std(axis=0) * np.tanh(log.v / 0.05)
        said = scale_contradiction(log.q, log.tau + friction, log.t, robot, log.joints)
        assert said == "", file.name
        tried += 1
    assert tried >= 5


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("desired", [True, False])
def test_gains_of_currents_are_those_of_the_controller(
    desired: bool, named: bool, tmp_path: Path
) -> None:
    """The controller's own torques and currents state them; measured currents do not, even where
    the model explains them: they carry a load that it lacks."""
    robot = load_robot(replace(find_manifest("ur5"), joints={}))  # computed without friction
    log = recorded(robot, period=8.0)
    random = np.random.default_rng(3)
    gains = random.uniform(6.0, 14.0, 6)
    size = log.tau.std(axis=0)
    wanted = (log.tau + 0.2 * size * np.tanh(log.v / 0.02)) / gains
    measured = (1.3 * log.tau + 0.2 * size * np.tanh(log.v / 0.02)) / gains
    measured += 0.05 * measured.std(axis=0) * random.standard_normal(log.q.shape)
    blocks = {"timestamp": log.t[:, None], "actual_q": log.q, "actual_qd": log.v}
    blocks |= {"actual_current": measured, "target_moment": log.tau}
    blocks |= {"target_current": wanted} if desired else {}
    names = ["timestamp", *(f"{b}_{j}" for b in list(blocks)[1:] for j in range(6))]
    table = np.hstack(list(blocks.values()))
    pd.DataFrame(table, columns=names).to_csv(tmp_path / "run.csv", header=named, index=False)
    result = init_log(tmp_path / "run.csv", "ur5")
    assert result.next.startswith("complete tau") != desired
    found = tomllib.loads((tmp_path / "run.toml").read_text()).get("tau", {}).get("gain")
    assert found == pytest.approx(gains, rel=0.01) if desired else found is None
