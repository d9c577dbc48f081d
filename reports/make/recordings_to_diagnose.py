"""Recordings on which mistakes are planted: the data sets with measured torque, and simulated
robots."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput, terms
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.experiments.recorded.process_log import lock_manifest
from sysid_bench.experiments.simulated.prepare import prepare_simulated
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.models.data_sets import find_dataset
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.model_checks import length
from sysid_bench.models.robot import RobotModel
from sysid_bench.package_folders import dataset_files
from sysid_bench.signals.log import read_log
from sysid_bench.signals.log_data import log_of
from sysid_bench.signals.log_description import NO_JOINT, LogDescription, read_description
from sysid_bench.signals.log_samples import read_samples, scalar_kinds
from sysid_bench.signals.log_source import read_time
from sysid_bench.spatial import phi_of
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class Signals:
    """One recording in SI, joint side: t (N,), q, v, tau (N, n), and how its time is stated.
    `hinges` (n,): joints that turn; `gains` (n,): torque per unit of a recorded current.
    """

    joints: tuple[str, ...]
    hinges: tuple[bool, ...]
    t: Array
    q: Array
    v: Array | None
    tau: Array
    stamps: bool = True  # else the rate is declared
    rate: float = 0.0
    gains: Array | None = None


@dataclass(frozen=True, eq=False)
class Subject:
    """A recording to plant mistakes on, and others of the same robot to judge what they cost.
    `accepted`: contradictions of the recording itself that its data set states."""

    name: str
    robot: RobotModel
    training: Signals
    tests: tuple[Signals, ...]
    accepted: tuple[str, ...] = ()


def evidence(signals: Signals, robot: RobotModel) -> DiagnoseInput:
    """The recording as it is read."""
    arrays: dict[str, Any] = {"q": signals.q, "tau": signals.tau}
    given: dict[str, Any] = {"joints": list(signals.joints)}
    if signals.v is not None:
        arrays["v"] = signals.v
    if signals.stamps:
        arrays["t"] = signals.t
    else:
        given["rate"] = f"{signals.rate:.9g} Hz"
    return DiagnoseInput(read_log(log_of(arrays, given, "run"), robot), robot)


def recorded_motions() -> Iterator[tuple[str, str]]:
    """Names of every data set here and of its motions."""
    for name in dataset_files():
        for motion in find_dataset(name).described.motions:
            yield name, motion


def recorded_subjects(word: str = "") -> Iterator[Subject]:
    """The first training and the first test motion of each data set with measured torque, of those
    whose name holds a word."""
    for name in (one for one in dataset_files() if word in one):
        found = find_dataset(name).described
        motions = {m: read_description(Path(f"dataset:{name}/{m}")) for m in found.motions}
        chosen = [found.train[0], *found.test[:1]]
        if motions[chosen[0]].tau.pd is not None or not motions[chosen[0]].has_torque:
            continue
        manifest = find_manifest(f"dataset:{name}", None)
        robot = load_robot(lock_manifest(manifest, load_robot(manifest), list(motions.values())))
        for one in chosen:
            tests = found.test if one in found.train else found.train
            others = tuple(_signals(motions[other], robot) for other in tests)
            training, accepted = _signals(motions[one], robot), tuple(found.accept)
            yield Subject(f"{name}/{one}", robot, training, others, accepted)


def _signals(log: LogDescription, robot: RobotModel) -> Signals:
    raw = read_samples(log, robot)
    stamps = read_time(log, len(raw))
    keep = [k for k, joint in enumerate(log.joints) if joint != NO_JOINT]
    samples = raw.columns(keep)
    t = np.arange(len(raw)) / (log.rate or 1.0) if stamps is None else stamps
    gains = log.joint_values("tau.gain", log.tau.gain)[keep]
    joints = tuple(log.joints[k] for k in keep)
    kind_of = scalar_kinds(robot)
    hinges = tuple(kind_of[joint] == "hinge" for joint in joints)
    return Signals(
        joints, hinges, t, samples.q, samples.v, samples.tau,
        stamps is not None, log.rate or 0.0, gains if (gains != 1).any() else None,
    )  # fmt: skip


LIGHTEST: Final = 0.5
HEAVIEST: Final = 3.0
"""kg; tools of a tenth of the moving links weigh between these."""


def tool_mass(robot: RobotModel) -> float:
    """Mass (kg) of the tool that a robot is given; 0 where its tool body does not move."""
    if robot.tree.carrier[robot.tool_body] < 0:
        return 0.0
    moving = robot.phi[np.asarray(robot.tree.carrier) >= 0, 0].sum()
    return float(np.clip(0.1 * moving, LIGHTEST, HEAVIEST))


def with_tool(one: Subject) -> Subject:
    """The recordings with the torque of a tool that the model does not know: a box of 10 cm."""
    mass = tool_mass(one.robot)
    reach = min(1.0, length(one.robot))
    box = mass * 0.1**2 / 6 * np.eye(3)
    phi = phi_of(mass, reach * np.array([0.05, 0.0, 0.08]), box)
    return replace(
        one,
        name=f"{one.name} + {mass:.2g} kg",
        training=_loaded(one.training, one.robot, phi),
        tests=tuple(_loaded(test, one.robot, phi) for test in one.tests),
    )


def _loaded(signals: Signals, robot: RobotModel, phi: Array) -> Signals:
    e = replace(evidence(signals, robot), loaded=True)
    torque = e.regressor(e.motion)[..., -10:] @ phi
    # The ends, where the filter of the motion is not reliable, are cut off by every check as well.
    t = _times(signals)
    grid = np.linspace(t[0], t[-1], len(e.log.recording))[e.kept]
    added = [np.interp(t, grid, column) for column in torque.T]
    return replace(signals, tau=signals.tau + np.column_stack(added))


def _times(signals: Signals) -> Array:
    """Times (N,) that rise, whatever the stamps."""
    if signals.stamps:
        return np.maximum.accumulate(signals.t)
    return np.arange(len(signals.t)) / signals.rate


def plain_error(training: DiagnoseInput, tests: tuple[DiagnoseInput, ...]) -> float:
    """Error on other motions of a fit to one, over the RMS of their torque: weighted least squares,
    cut off at 1e-6 of the largest singular value; each joint divided by its own torque, like
    `torque_error`."""
    W, b, _ = _rows(training)
    size = np.linalg.norm(W, axis=0)
    kept = size > 1e-9 * size.max()
    beta, *_ = np.linalg.lstsq(W[:, kept] / size[kept], b, rcond=1e-6)
    wrong, power = [], []
    for test in tests:
        A, target, rms = _rows(test)
        predicted = A[:, kept] / size[kept] @ beta
        wrong.append((((predicted - target).reshape(-1, len(rms))) * rms) ** 2)
        power.append((target.reshape(-1, len(rms)) * rms) ** 2)
    rms2 = np.concatenate(power).mean(axis=0)
    used = rms2 > 1e-4 * rms2.max()
    return float(np.sqrt((np.concatenate(wrong).mean(axis=0)[used] / rms2[used]).mean()))


def _rows(e: DiagnoseInput) -> tuple[Array, Array, Array]:
    """Rows W, b of all joints, each over its RMS torque, and these RMS torques (n,)."""
    motion, tau = e.fit_samples
    own = terms(motion)
    N, n, m = own.shape
    rms = np.maximum(np.sqrt((tau**2).mean(axis=0)), 1e-12)
    blocks = np.zeros((N, n, n * m))
    for j in range(n):
        blocks[:, j, j * m : (j + 1) * m] = own[:, j]
    W = np.concatenate([e.regressor(motion), blocks], axis=2) / rms[:, None]
    return W.reshape(N * n, -1), (tau / rms).ravel(), rms


SIMULATED: Final = {
    "ur5": "L1", "kinova": "L2", "xarm7": "L1", "ur3": "L2", "z1": "L1", "rv2sq": "L2",
}  # fmt: skip
"""Robots and the plants that they are simulated on, in closed loop."""

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


def simulated_subject(name: str) -> Subject:
    """Motions of a robot in closed loop, judged by a model that differs from it."""
    loaded = loaded_robot(name, "none", None, None)
    parts = []
    for period in (8, 9):  # other lengths draw other motions of the same plant
        suite = parse_suite(SUITE.format(plant=SIMULATED[name], period=period, robot=name))
        (spec,) = cells_of_suite(suite).spec_list
        raw = prepare_simulated(spec, loaded).experiment.raw
        parts.append(_of_robot(loaded.robot, raw))
    return Subject(f"sim:{name}", _told(loaded.robot), parts[0], (parts[1],))


def _of_robot(robot: RobotModel, raw: Any) -> Signals:
    joints = [joint for joint in robot.joints if joint.kind in ("hinge", "slide")]
    columns = [robot.torque_rows.index(joint.dofs[0]) for joint in joints]
    return Signals(
        tuple(joint.dofs[0] for joint in joints), tuple(joint.kind == "hinge" for joint in joints),
        raw.t, raw.q[:, [j.qadr for j in joints]],
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
