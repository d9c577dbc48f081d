"""Recordings on which mistakes are planted: real arms of SYSID_BENCH_DATA, and simulated ones."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.experiments.recorded.process_log import lock_manifest
from sysid_bench.experiments.simulated.prepare import prepare_simulated
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log_description import LogDescription, log_description
from sysid_bench.signals.log_samples import read_samples
from sysid_bench.signals.log_source import read_time
from sysid_bench.types import Array

UR: Final = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint",
             "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")  # fmt: skip
PANDA: Final = tuple(f"panda_joint{i}" for i in range(1, 8))


@dataclass(frozen=True, eq=False)
class Signals:
    """One recording in SI, joint side: t (N,), q, v, tau (N, n), and how its time is stated."""

    joints: tuple[str, ...]
    t: Array
    q: Array
    v: Array | None
    tau: Array
    stamps: bool = True  # else the rate is declared
    rate: float = 0.0


@dataclass(frozen=True, eq=False)
class Subject:
    """A robot with a training and a test recording; `model` names its file."""

    name: str
    robot: RobotModel
    training: Signals
    test: Signals


def _columns(first: int, count: int) -> list[int]:
    return list(range(first, first + count))


def _signal(columns: Sequence[int | str], unit: str, **more: Any) -> dict[str, Any]:
    return {"columns": list(columns), "unit": unit, **more}


def _named(joints: Sequence[str], word: str, unit: str, **more: Any) -> dict[str, Any]:
    return _signal([f"{joint}_{word}" for joint in joints], unit, **more)


def _ur10e(file: str, rows: list[int]) -> dict[str, Any]:
    gains = [11.976, 11.976, 9.839, 10.763, 10.761, 10.76]
    return {
        "file": f"$SYSID_BENCH_DATA/ur10e/{file}", "time": 1, "rows": rows, "joints": list(UR),
        "q": _signal(_columns(2, 6), "rad"), "v": _signal(_columns(8, 6), "rad/s"),
        "tau": _signal(_columns(14, 6), "A", gain=gains),
    }  # fmt: skip


def _ur10(rows: list[int]) -> dict[str, Any]:
    return {
        "file": "$SYSID_BENCH_DATA/ur10/ur10_exciting_trajectory.csv", "time": "t", "rows": rows,
        "joints": list(UR), "q": _named(UR, "position", "rad"),
        "v": _named(UR, "velocity", "rad/s"), "tau": _named(UR, "effort", "N m"),
    }  # fmt: skip


def _panda(rows: list[int]) -> dict[str, Any]:
    folder, each = "$SYSID_BENCH_DATA/panda_gaz/exciting_traj", _columns(1, 7)
    return {
        "time": {"column": 1, "file": f"{folder}_time.txt"}, "rows": rows, "joints": list(PANDA),
        "q": _signal(each, "rad", per_row=7, file=f"{folder}_positions.txt"),
        "v": _signal(each, "rad/s", per_row=7, file=f"{folder}_velocity.txt"),
        "tau": _signal(each, "N m", per_row=7, file=f"{folder}_torques.txt"),
    }  # fmt: skip


def _fer(rows: list[int]) -> dict[str, Any]:
    names = [f"fer_joint{i}" for i in range(1, 8)]
    return {
        "file": "$SYSID_BENCH_DATA/fer/panda_exciting_trajectory.csv", "time": "t", "rows": rows,
        "joints": list(PANDA), "q": _named(names, "position", "rad"),
        "v": _named(names, "velocity", "rad/s"), "tau": _named(names, "effort", "N m"),
    }  # fmt: skip


def _tx40(rows: list[int]) -> dict[str, Any]:
    G = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
    G[5, 4] = 32.0
    offset = [0, -0.5 * np.pi, 0.5 * np.pi, 0, 0, 0]
    folder = "$SYSID_BENCH_DATA/tx40"
    return {
        "rate": "5 kHz", "rows": rows, "joints": [f"joint_{i}" for i in range(1, 7)],
        "transmission": np.linalg.inv(G).tolist(),
        "q": _signal(_columns(1, 6), "rad", offset=offset, file=f"{folder}/pos_read_data.csv"),
        "tau": _signal(_columns(1, 6), "N m", file=f"{folder}/curr_data.csv"),
    }  # fmt: skip


def _psm(rows: list[int]) -> dict[str, Any]:
    G = np.eye(7)
    G[4:, 4:] = [[1.0186, 0, 0], [-0.8306, 0.6089, 0.6089], [0, -1.2177, 1.2177]]
    return {
        "file": "$SYSID_BENCH_DATA/dvrk/psm_train.csv", "rate": "200 Hz", "rows": rows,
        "joints": ["j1", "j2", "j3", "j4", "j5", "j6", "-"], "transmission": G.tolist(),
        "q": {"columns": _columns(1, 7)}, "v": {"columns": _columns(8, 7)},
        "tau": {"columns": _columns(15, 7)},
    }  # fmt: skip


TRAINING: Final = "ur-20_02_10-30sec_12harm.csv"
TEST: Final = "ur-20_02_12-40sec_12harm.csv"
RECORDED: Final[Mapping[str, tuple[str, Any, Any]]] = {
    "ur10e": ("$/ur10e/ur10e.urdf", _ur10e(TRAINING, [635, 3510]), _ur10e(TEST, [500, 4460])),
    "panda": ("panda", _panda([1, 14000]), _panda([14001, 20544])),
    "tx40": ("$/tx40/tx40_mdh_modified.urdf", _tx40([6001, 36000]), _tx40([1, 6000])),
    "ur10": ("ur10", _ur10([1, 2200]), _ur10([2201, 3441])),
    "fer": ("panda", _fer([1, 460]), _fer([461, 727])),
    "psm": ("dvrk_psm", _psm([1, 3500]), _psm([3501, 5999])),
}
"""Model, description of the training part, description of the test part."""

SIMULATED: Final = {
    "ur5": "L1", "kinova": "L2", "xarm7": "L1",
    "ur3": "L2", "z1": "L1", "rv2sq": "L2",
}  # fmt: skip
"""Robots and the plants that they are simulated on, in closed loop."""

TUNED: Final = ("ur10e", "panda", "tx40", "ur5", "kinova", "xarm7")
"""Robots on which thresholds were set; figures are those of the others."""


def subject(name: str) -> Subject:
    """The recordings of a robot: recorded ones by their name, simulated ones by "sim:" + name."""
    if name.startswith("sim:"):
        return _simulated(name.removeprefix("sim:"))
    model, training, test = RECORDED[name]
    manifest = find_manifest(model.replace("$", os.environ["SYSID_BENCH_DATA"], 1), None)
    descriptions = [log_description(one, Path()) for one in (training, test)]
    robot = load_robot(lock_manifest(manifest, load_robot(manifest), descriptions))
    signals = [_signals(one, robot) for one in descriptions]
    return Subject(name, robot, *signals)


def _signals(log: LogDescription, robot: RobotModel) -> Signals:
    raw = read_samples(log, robot)
    stamps = read_time(log, len(raw))
    keep = [k for k, joint in enumerate(log.joints) if joint != "-"]
    samples = raw.columns(keep)
    t = np.arange(len(raw)) / (log.rate or 1.0) if stamps is None else stamps
    joints = tuple(log.joints[k] for k in keep)
    rate = log.rate or 0.0
    return Signals(joints, t, samples.q, samples.v, samples.tau, stamps is not None, rate)


SUITE: Final = """
schema = 1
name = "mistakes"
title = "Recordings to plant mistakes on"
seed = 5
[defaults]
task = "robot"
plant = "{plant}"
excitation = {{ use = "fourier", harmonics = 5, period = "{period} s", cycles = 1 }}
held_out = ["fourier-other"]
rate = "200 Hz"
[[robot]]
use = ["{robot}"]
payloads = ["none"]
[[estimator]]
use = "ols"
"""


def _simulated(name: str) -> Subject:
    loaded = loaded_robot(name, "none", None, None)
    parts = []
    for period in (8, 9):  # other lengths draw other motions of the same plant
        suite = parse_suite(SUITE.format(plant=SIMULATED[name], period=period, robot=name))
        (spec,) = cells_of_suite(suite).spec_list
        raw = prepare_simulated(spec, loaded).experiment.raw
        parts.append(_of_robot(loaded.robot, raw))
    return Subject(f"sim:{name}", _told(loaded.robot), *parts)


def _of_robot(robot: RobotModel, raw: Any) -> Signals:
    joints = [joint for joint in robot.joints if joint.kind in ("hinge", "slide")]
    columns = [robot.torque_rows.index(joint.dofs[0]) for joint in joints]
    return Signals(
        tuple(joint.dofs[0] for joint in joints), raw.t, raw.q[:, [j.qadr for j in joints]],
        None if raw.v is None else raw.v[:, [j.vadr for j in joints]], raw.tau[:, columns],
        False, raw.rate,
    )  # fmt: skip


def _told(robot: RobotModel) -> RobotModel:
    """The robot as its model file states it: masses off by 20 %, centres by 15 % of their reach."""
    rng = np.random.default_rng(len(robot.name))
    factor = np.exp(0.2 * rng.normal(size=len(robot.phi)))
    phi = robot.phi * factor[:, None]
    phi[:, 1:4] *= 1 + 0.15 * rng.normal(size=(len(phi), 3))
    return replace(robot, phi=phi)
