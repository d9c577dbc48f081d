"""Recordings with a force/torque sensor: what is distal to it, from its wrench alone."""

from pathlib import Path

import numpy as np
import pytest

import sysid_bench
from sysid_bench.commands.identify_recorded import RecordedResult
from sysid_bench.commands.paper import paper_figures
from sysid_bench.commands.run import run
from sysid_bench.errors import SysidBenchError, UsageError
from sysid_bench.models.sensor import instruments_of, subtree_at
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.reporting.signal_figures import StoredCurves
from sysid_bench.types import Trajectory
from tests.closeness import assert_close
from tests.robots import named_robot

RATE = 100.0
SCALE = 1.3
"""Of the masses and moments of the recorded robot over those of its file."""
SUITE = """
schema = 1
name = "wrist"
[[log]]
name = "wrist"
robot = "panda"
task = "wrench"
train = ["run.toml"]
prior = { mass = "30 %", com = "20 mm", inertia = "40 %" }
[[estimator]]
use = "wls"
[[paper]]
name = "online"
show = "online"
"""
LONG = pytest.mark.long
SENSORS = {"l_arm": ("icub", ("l_arm",)), "l_leg": ("icub", ("l_leg", "l_foot")),
           "wrist": ("panda", ("wrist",))}  # fmt: skip


def written(
    folder: Path, sensor: str, seed: int, noise: float = 0.0, name: str = "run", head: str = ""
) -> Path:
    """A recording of random motion, with the wrench of the sensor and of those that end its
    sub-tree; forces come first, as drivers report them."""
    source, sensors = SENSORS[sensor]
    robot = named_robot(source)
    motion = smooth_motion(source, seed)
    cuts = tuple(subtree_at(robot, one) for one in sensors)
    instruments = instruments_of(robot, cuts)
    links = instruments.tree.link_parameters(SCALE * robot.phi)
    wrench = newton_euler(instruments.tree, links, instruments.motion(motion))[:, robot.nv :]
    wrench = wrench + noise * np.random.default_rng(seed).normal(size=wrench.shape)
    forces_first = [6 * k + i for k in range(len(cuts)) for i in (3, 4, 5, 0, 1, 2)]
    joints = [joint for joint in robot.joints if joint.kind in ("hinge", "slide")]
    q = motion.q[:, [joint.qadr for joint in joints]]
    v = motion.v[:, [joint.vadr for joint in joints]]
    np.savetxt(folder / f"{name}.csv", np.hstack([q, v, wrench[:, forces_first]]), delimiter=",")
    n = len(joints)
    entries = [
        f"{{ columns = {[2 * n + 6 * k + i + 1 for i in range(6)]}, sensor = '{one}' }}"
        for k, one in enumerate(sensors)
    ]
    (folder / f"{name}.toml").write_text(
        f"file = '{name}.csv'\nrate = '{RATE:g} Hz'\njoints = {[j.name for j in joints]}\n"
        f"q = {{ columns = {list(range(1, n + 1))} }}\n"
        f"v = {{ columns = {list(range(n + 1, 2 * n + 1))} }}\n"
        f"wrench = [{', '.join(entries)}]\n{head}"
    )
    return folder / f"{name}.toml"


def smooth_motion(source: str, seed: int) -> Trajectory:
    """Slow sums of sines of all joints: what a filter at 10 Hz leaves as it is."""
    robot, rng = named_robot(source), np.random.default_rng(seed)
    t = np.arange(0.0, 20.0, 1.0 / RATE)
    joints = [joint for joint in robot.joints if joint.kind in ("hinge", "slide")]
    q = np.tile(robot.mj.qpos0, (len(t), 1))
    v, a = np.zeros((2, len(t), robot.nv))
    for joint in joints:
        for f in rng.uniform(0.05, 0.6, 4):
            reach = robot.limits.q_high[joint.vadr] - robot.limits.q_low[joint.vadr]
            w, phase, size = 2 * np.pi * f, rng.uniform(0, 2 * np.pi), min(0.2, 0.1 * reach)
            q[:, joint.qadr] += size * np.sin(w * t + phase)
            v[:, joint.vadr] += size * w * np.cos(w * t + phase)
            a[:, joint.vadr] -= size * w**2 * np.sin(w * t + phase)
    return Trajectory(t, q, v, a)


def identified(sensor: str, *logs: Path, terms: tuple[str, ...] | None = None) -> RecordedResult:
    first, *others = logs
    found = sysid_bench.identify(
        SENSORS[sensor][0], "wrench", log=first, test=others, sensor=sensor, terms=terms
    )
    assert isinstance(found, RecordedResult)
    return found


def values(found: RecordedResult) -> dict[str, float]:
    """Base parameters by the sum that each stands for."""
    return {entry["expression"]: entry["value"] for entry in found.base}


@pytest.mark.parametrize(
    "sensor", ["wrist", *(pytest.param(name, marks=LONG) for name in ("l_leg", "l_arm"))]
)
def test_what_is_distal_is_identified(sensor: str, tmp_path: Path) -> None:
    found = identified(sensor, *(written(tmp_path, sensor, k, 1e-3, f"run{k}") for k in (0, 1)))
    assert found.rows == [f"{sensor}.{c}" for c in ("nx", "ny", "nz", "fx", "fy", "fz")]
    assert found.data_rank == found.rank
    assert found.torque_error is not None
    assert found.torque_error < 0.01
    assert all(row["relative"] < 0.05 for row in found.tests["run1"].values())


def test_a_written_convention_is_one_wrench(tmp_path: Path) -> None:
    """Order, sign and units as drivers have them; and constants of the sensor."""
    sensor = "wrist"
    plain = written(tmp_path, sensor, 0)
    data, text = np.loadtxt(tmp_path / "run.csv", delimiter=","), plain.read_text()
    first = data.shape[1] - 6
    reaction = data.copy()
    reaction[:, first:] = -np.roll(data[:, first:], 3, axis=1) * 1e3
    reaction[:, first + 3 :] /= 1e6
    np.savetxt(tmp_path / "reaction.csv", reaction, delimiter=",")
    other = tmp_path / "reaction.toml"
    words = "first = 'moment', gain = -1, unit = ['mN m', 'kN'], sensor"
    other.write_text(text.replace("run.csv", "reaction.csv").replace("sensor", words))
    expected, same = values(identified(sensor, plain)), values(identified(sensor, other))
    assert same.keys() == expected.keys()
    assert_close([*same.values()], [*expected.values()], 1e-9)
    shifted = tmp_path / "shifted.toml"
    words = "offset = [3, 0, 0, 0, 0, -0.2], sensor"
    shifted.write_text(text.replace("sensor", words))
    found = identified(sensor, shifted, terms=("offset",))
    assert values(found)["wrist.fx.offset"] == pytest.approx(3, abs=1e-2)
    assert values(found)["wrist.nz.offset"] == pytest.approx(-0.2, abs=1e-2)


@pytest.mark.parametrize("has_torque", [True, pytest.param(False, marks=LONG)])
def test_a_recording_converges_on_line(has_torque: bool, tmp_path: Path) -> None:
    """From an arm's wrench alone to the torques of the joints behind it, as Fig. 3 of Traversaro et
    al. (2015); the measured ones take no part."""
    log = written(tmp_path, "wrist", 0)
    if has_torque:
        add_torques(log)
    suite = tmp_path / "s.toml"
    suite.write_text(SUITE)
    result = run(suite, tmp_path / "out", jobs=1)
    assert result.exit_code == 0, result.counts
    sample = dict(paper_figures(result.folder))["online"]
    assert isinstance(sample, StoredCurves)
    *torques, error = sample.curves
    assert torques
    assert error.series["on-line"][-1] < 0.1 * error.series["CAD"][-1]
    for curve in torques:
        assert ("measured" in curve.series) == has_torque
        if has_torque and np.abs(curve.series["measured"]).max() > 0.1:
            late = slice(len(curve.t) // 2, None)
            measured, found, cad = (
                curve.series[name][late] for name in ("measured", "on-line", "CAD")
            )
            assert np.std(found - measured) < 0.2 * np.std(cad - measured)


def add_torques(log: Path) -> None:
    """Torques of all joints as further columns."""
    robot, motion = named_robot("panda"), smooth_motion("panda", 0)
    tau = newton_euler(robot.tree, robot.tree.link_parameters(SCALE * robot.phi), motion)
    table = np.loadtxt(log.with_suffix(".csv"), delimiter=",")
    columns = [dof for joint in robot.joints for dof in joint.dofs]
    first = table.shape[1] + 1
    np.savetxt(log.with_suffix(".csv"), np.hstack([table, tau]), delimiter=",")
    log.write_text(
        f"{log.read_text()}\ntau = {{ columns = {list(range(first, first + len(columns)))} }}\n"
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("l_foot", "r_foot"), "no wrench of the sensor 'l_foot'.*l_leg, r_foot"),
        (("wrench = [{ columns = [", "wrench = [{ columns = [1, "), "has 7 columns; write 6"),
        (("sensor = 'l_leg'", "sensor = 'l_leg', unit = ['N m', 'N']"), "a force: .*'N m'"),
        (("sensor = 'l_leg'", "sensor = 'l_leg', unit = ['N']"), "write two"),
        (("sensor = 'l_leg'", "sensor = 'l_leg', gain = [1, 2]"), "has 2 numbers"),
        (("sensor = 'l_leg'", "sensors = 'l_leg'"), "sensor"),
    ],
)
def test_what_is_wrong_is_one_sentence(change: tuple[str, str], words: str, tmp_path: Path) -> None:
    log = written(tmp_path, "l_leg", 0)
    log.write_text(log.read_text().replace(*change, 1))
    with pytest.raises(SysidBenchError, match=words):
        identified("l_leg", log)


def test_torques_that_are_absent_are_asked_for(tmp_path: Path) -> None:
    log = written(tmp_path, "wrist", 0)
    with pytest.raises(UsageError, match="no torques, which the task 'robot' needs"):
        sysid_bench.identify("panda", "robot", log=log)
    with pytest.raises(UsageError, match="--sensor: of a recording"):
        sysid_bench.identify("panda", "robot", log=log, sensor="wrist")
    with pytest.raises(UsageError, match="no torques of joints"):
        sysid_bench.diagnose(log, "panda")
    without = log.read_text().replace("wrench = ", "# wrench = ")
    log.write_text(without)
    with pytest.raises(UsageError, match="tau is missing"):
        identified("wrist", log)
