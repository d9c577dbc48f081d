"""Motions from files: what was written comes back, at any rate; others are refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.motion_file import MotionFile
from sysid_bench.excitation.random_motions import Fourier, PointToPoint
from sysid_bench.experiments.simulated.commanded import commanded_motion
from sysid_bench.types import Trajectory
from tests.experiments.experiment_world import OWN, robot_of, subject_of

ROBOTS = ("ur5", "tx40", OWN[0])
RNG = np.random.default_rng(0)


def written(folder: Path, robot: str, motion: Trajectory, turned: bool = False) -> Path:
    names = [joint.name for joint in robot_of(robot).joints]
    columns = {"t": motion.t} | dict(zip(names, motion.q.T, strict=True))
    order = list(columns)[::-1] if turned else list(columns)
    rows = zip(*(columns[name] for name in order), strict=True)
    lines = [",".join(order), *(",".join(f"{x:.12f}" for x in row) for row in rows)]
    path = folder / "motion.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_periodic_motion_is_exact_between_its_rows(tmp_path: Path, robot: str) -> None:
    """25 rows per second hold a series of 1.6 Hz; everything else is that series again."""
    series, brief = (
        Fourier(harmonics=8, period=5.0, cycles=1),
        design_problem(robot_of(robot), 25.0),
    )
    file = written(tmp_path, robot, series.design(brief, np.random.default_rng(1)), turned=True)
    fine = brief.at(400.0)
    found = MotionFile(str(file), 5.0).design(fine, RNG)
    exact = series.design(fine, np.random.default_rng(1))
    for name in ("t", "q", "v", "a"):
        np.testing.assert_allclose(getattr(found, name), getattr(exact, name), atol=1e-7)
    twice = MotionFile(str(file), 5.0, cycles=2).design(fine, RNG)
    np.testing.assert_allclose(twice.q[len(exact) :], exact.q, atol=1e-7)
    assert (found.name, found.period) == ("motion", 5.0)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_motion_without_a_period_is_a_smooth_curve_through_its_rows(
    tmp_path: Path, robot: str
) -> None:
    moves, brief = PointToPoint(moves=2), design_problem(robot_of(robot), 100.0)
    exact = moves.design(brief, np.random.default_rng(1))
    found = MotionFile(str(written(tmp_path, robot, exact))).design(brief, RNG)
    N = len(found)
    np.testing.assert_allclose(found.q, exact.q[:N], atol=1e-9)
    np.testing.assert_allclose(found.v, exact.v[:N], atol=1e-3 * np.abs(exact.v).max())
    assert np.abs(found.a - exact.a[:N]).max() < 0.05 * np.abs(exact.a).max()


def table(t: list[float], value: float = 0.0, header: str = "t,a") -> str:
    return header + "\n" + "".join(f"{x},{value}\n" for x in t)


EVEN = [0.1 * k for k in range(20)]
BAD: dict[str, tuple[str | None, dict[str, Any], str]] = {
    "absent": (None, {}, "not a table"),
    "words": ("t,a\n0,x\n", {}, "not a table"),
    "joints": (table(EVEN, header="t,b"), {}, "expected t, "),
    "few rows": (table(EVEN[:5]), {}, "ten rows"),
    "not finite": (table(EVEN, float("nan")), {}, "finite"),
    "back in time": (table([0.0, *EVEN]), {}, "rising"),
    "uneven": (table([*EVEN, 5.0]), {}, "evenly"),
    "another period": (table(EVEN), {"period": 3.0}, "not the period"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_no_motion_of_this_robot_is_reported(tmp_path: Path, case: str) -> None:
    robot = robot_of(OWN[0])
    text, settings, given = BAD[case]
    file = tmp_path / "bad.csv"
    if text is not None:
        names = [joint.name for joint in robot.joints]
        wide = [
            line.replace(",a", "," + ",".join(names))
            if line.startswith("t,a")
            else line + ("," + line.split(",")[1]) * (len(names) - 1)
            for line in text.splitlines()
        ]
        file.write_text("\n".join(wide))
    with pytest.raises(UsageError, match=given):
        MotionFile(str(file), **settings).design(design_problem(robot, 100.0), RNG)


def test_a_motion_beyond_the_limits_is_refused_or_marked(tmp_path: Path) -> None:
    subject = subject_of(OWN[0])
    names = [joint.name for joint in subject.robot.joints]
    file = tmp_path / "far.csv"
    rows = [",".join(["t", *names]), *(",".join([f"{t}"] + ["1e3"] * len(names)) for t in EVEN)]
    file.write_text("\n".join(rows))
    excitation = {"use": "file", "file": str(file)}
    problem = design_problem(subject.robot, 100.0)
    with pytest.raises(UsageError, match=r"position of \w+ exceeds its limit by .*limits = "):
        commanded_motion(excitation, subject, problem, 1)
    margins = commanded_motion({**excitation, "limits": "mark"}, subject, problem, 1).margins
    assert margins.q is not None
    assert margins.q < -1.0
    assert "exceeds its limit" in margins.broken
    with pytest.raises(UsageError, match="There are: mark, refuse"):
        commanded_motion({**excitation, "limits": "ignore"}, subject, problem, 1)


COUPLED = ("dvrk_mtm", "dvrk_psm", "random:four-bar:1", "random:slider-crank:2")


@pytest.mark.parametrize("robot", COUPLED)
@pytest.mark.parametrize("period", [5.0, None])
def test_recorded_motions_of_coupled_robots_are_replayed(
    tmp_path: Path, robot: str, period: float | None
) -> None:
    """All columns are written, those of dependent joints wrong: they are solved again."""
    subject = subject_of(robot)
    model, brief = subject.robot, design_problem(subject.robot, 200.0)
    exact = Fourier(period=5.0, cycles=1).design(brief, np.random.default_rng(1))
    assert model.coupling is not None
    noisy = exact.q.copy()
    noisy[:, model.coupling.qadr[model.coupling.dependent]] += 0.3
    file = written(tmp_path, robot, replace(exact, q=noisy))
    settings = {} if period is None else {"period": "5 s"}
    excitation = {"use": "file", "file": str(file), **settings}
    found = commanded_motion(excitation, subject, brief, 1)
    N = len(found.motion)
    for name, size in (("q", 1e-7), ("v", 1e-5), ("a", 2e-2 if period is None else 1e-3)):
        ours, theirs = getattr(found.motion, name), getattr(exact, name)[:N]
        np.testing.assert_allclose(ours, theirs, atol=size * max(1.0, np.abs(theirs).max()))
    assert found.margins.broken == ""


@pytest.mark.parametrize(
    "settings", [{"cycles": 0}, {"cycles": 2}, {"period": 0.0}, {"period": -1.0}]
)
def test_settings_that_make_no_motion_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(UsageError, match=r"cycles >= 1|several cycles need"):
        MotionFile("motion.csv", **settings)  # type: ignore[arg-type]


def test_an_orientation_has_no_column(tmp_path: Path) -> None:
    file = tmp_path / "motion.csv"
    file.write_text(table(EVEN))
    with pytest.raises(UsageError, match="hinges and slides"):
        MotionFile(str(file)).design(design_problem(robot_of("solo12"), 100.0), RNG)
