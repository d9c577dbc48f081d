"""Figures of a training motion with its limits, and of an on-line estimate, from stored cells."""

from pathlib import Path

import numpy as np
import pytest

from sysid_bench.commands.figure import figure
from sysid_bench.commands.paper import paper_figures
from sysid_bench.commands.run import run
from sysid_bench.errors import UsageError
from sysid_bench.experiments.paper_data import motion_curves
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.models.random_states import random_states
from sysid_bench.reporting.signal_figures import StoredCurves
from tests.robots import named_robot

SUITE = """
schema = 1
name = "curves"
[defaults]
task = "wrench"
rate = "100 Hz"
prior = { mass = "20 %", com = "15 mm", inertia = "30 %" }
excitation = { use = "wander", duration = "5 s" }
noise = { force = "0.15 N", moment = "0.008 N m" }
[[robot]]
use = "panda"
sensor = "wrist"
[[estimator]]
use = "wls"
[[paper]]
name = "online"
show = "online"
[[paper]]
name = "motion"
show = "motion"
"""


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    folder = tmp_path_factory.mktemp("curves")
    (folder / "s.toml").write_text(SUITE)
    result = run(folder / "s.toml", folder / "out", jobs=1)
    assert result.exit_code == 0, result.counts
    return result.folder


def test_a_run_stores_the_curves_of_its_figures(ran: RunFolder) -> None:
    found = dict(paper_figures(ran))
    sample = found["online"]
    assert isinstance(sample, StoredCurves)
    online = sample.curves
    assert all(set(curve.series) >= {"CAD", "on-line"} for curve in online)
    error = online[-1].series
    assert error["on-line"][-1] < 0.5 * error["CAD"][-1]
    files = figure(ran.path, "motion").files
    assert [Path(file).suffix for file in files] == [".pdf", ".png"]


def test_stored_curves_that_are_damaged_are_one_sentence(ran: RunFolder) -> None:
    (file,) = (ran.path / "artifacts").glob("*/paper/motion.npz")
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UsageError, match="cannot be read"):
        dict(paper_figures(ran))
    file.write_bytes(whole)


@pytest.mark.parametrize("name", ["ur5", "dvrk_psm", "dvrk_mtm"])
def test_curves_are_the_motion_and_the_limits_of_the_independent_joints(name: str) -> None:
    robot = named_robot(name)
    motion = random_states(robot, 7, np.random.default_rng(0))
    curves = motion_curves(robot, motion)
    joints = {joint.name: joint for joint in robot.joints}
    assert [curve.name for curve in curves[::2]] == [
        joint.name for joint in robot.joints if joint.vadr in robot.torque_dofs
    ]
    for position, velocity in zip(curves[::2], curves[1::2], strict=True):
        joint = joints[position.name]
        np.testing.assert_array_equal(position.series[""], motion.q[:, joint.qadr])
        np.testing.assert_array_equal(velocity.series[""], motion.v[:, joint.vadr])
        limit = robot.limits.v[joint.vadr]
        assert velocity.limits == ((-limit, limit) if np.isfinite(limit) else None)
