"""Motions that leave directions of the parameters open: said first, and a failed test is a code."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sysid_bench
from sysid_bench.evaluation.open_directions import open_directions
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import Fourier
from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.simulated.prepare import prepare_simulated
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.plant import plant_of
from sysid_bench.types import Array, Factor, Problem
from tests.experiments.experiment_world import spec
from tests.robots import named_robot
from tests.signals.logs import RATE, Recorded, recorded, write

from .conftest import Run

SAMPLES = 500


@pytest.fixture(scope="module")
def problem() -> Problem:
    """A problem whose factors are replaced."""
    return prepare_simulated(spec(robot="scara"), LoadedRobot(named_robot("scara"))).problem


def with_data(problem: Problem, W: Array, b: Array) -> Problem:
    """The problem with one row of its robot, N samples [W | b]."""
    columns = np.arange(problem.base.rank)
    factor = Factor(
        problem.rows[0], columns, np.asarray(np.linalg.qr(np.column_stack([W, b]), "r")), len(b)
    )
    return replace(problem, rows=problem.rows[:1], factors=(factor,), samples=len(b))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("noise", [1e-3, 1e-2, 0.3])
def test_a_direction_is_open_once_noise_decides_it(
    problem: Problem, seed: int, noise: float
) -> None:
    """Two columns that differ by a small share leave one direction open; so do scaled columns."""
    rng = np.random.default_rng(seed)
    r = problem.base.rank
    W, e = rng.normal(size=(SAMPLES, r)), rng.normal(size=SAMPLES)
    limit = noise / np.sqrt(SAMPLES)
    for share, count in ((1.0, 0), (30 * limit, 0), (0.03 * limit, 1)):
        near = W.copy()
        near[:, -1] = W[:, 0] + share * W[:, -1]
        b = near @ np.ones(r)
        b += noise * np.linalg.norm(b) / np.sqrt(SAMPLES) * e
        for units in (np.ones(r), np.logspace(-4, 4, r)):
            found = open_directions(with_data(problem, near * units, b))
            assert (found.count, found.rank) == (count, r)
            if count:
                assert {found.names[0]} <= {problem.base.names[0], problem.base.names[-1]}


def test_without_excitation_all_directions_are_open(problem: Problem) -> None:
    r = problem.base.rank
    for W in (np.zeros((SAMPLES, r)), np.ones((SAMPLES, r))):
        found = open_directions(with_data(problem, W, np.ones(SAMPLES)))
        assert found.count == (r if not W.any() else r - 1)
        assert found.names


def test_exact_data_of_a_rich_motion_leave_nothing_open(problem: Problem) -> None:
    assert open_directions(problem).count == 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """small.toml: a ur5 that hardly moves, with noise; rich.toml and other.toml: two motions."""
    folder, robot = tmp_path_factory.mktemp("logs"), named_robot("ur5")
    rng = np.random.default_rng(3)
    for name, log in (
        ("small", small_motion(0.02)), ("rich", recorded(robot, 0)), ("other", recorded(robot, 1)),
    ):  # fmt: skip
        noise = 0.02 * log.tau.std(axis=0) * rng.normal(size=log.tau.shape)
        write(folder, replace(log, tau=log.tau + noise), name=name)
    return folder


def small_motion(share: float) -> Recorded:
    """A motion of a ur5 with this share of the amplitude."""
    robot = named_robot("ur5")
    whole = Fourier(period=4.0, cycles=1).design(
        design_problem(robot, RATE), np.random.default_rng(0)
    )
    q = whole.q[0] + share * (whole.q - whole.q[0])
    moved = replace(whole, q=q, v=share * whole.v, a=share * whole.a)
    oracle, _ = Inverse().run(plant_of(robot), moved, np.zeros_like(moved.v))
    return Recorded(robot.rows, moved.t, moved.q, moved.v, oracle.tau)


def test_an_answer_worse_than_zero_torque_ends_with_3_and_is_written(
    cli: Run, folder: Path, tmp_path: Path
) -> None:
    small, other = str(folder / "small.toml"), str(folder / "other.toml")
    logs = ("--log", small, "--test", other, "--estimator", "wls")
    done = cli("identify", "ur5", *logs, "--model-out", "out.urdf")
    assert done.returncode == 3
    assert "torque error" in done.stderr
    first, second = done.stdout.splitlines()[:2]
    assert "open" in first
    assert "torque error" in second
    again = cli("identify", "ur5", *logs, "--json")
    assert again.returncode == 3
    written = json.loads(again.stdout)
    assert written["torque_error"] > 1
    assert written["open_directions"] > 0
    assert "open" in written["warnings"][0]
    assert written["warnings"][1] == written["failure"]
    assert (tmp_path / "out.urdf").exists()


def test_from_python_it_is_a_field(folder: Path) -> None:
    small, other = folder / "small.toml", folder / "other.toml"
    result = sysid_bench.identify("ur5", log=small, test=other, estimator="wls")
    assert result.get("failure") == result.warnings[1]
    guarded = sysid_bench.identify("ur5", log=small, test=other)
    assert (guarded.prior_weight or 0) > 0
    assert guarded.open_directions == result.open_directions
    assert not guarded.beaten_by
    alone = sysid_bench.identify("ur5", log=folder / "small.toml", estimator="wls")
    assert alone.get("failure") is None
    assert "open" in alone.warnings[0]
    prior = sysid_bench.identify(
        "ur5", log=folder / "small.toml", test=folder / "other.toml", estimator="lmi"
    )
    assert prior.torque_error is not None
    assert prior.torque_error < 1


def test_a_rich_motion_has_no_such_warning(cli: Run, folder: Path) -> None:
    logs = ("--log", str(folder / "rich.toml"), "--test", str(folder / "other.toml"))
    done = cli("identify", "ur5", *logs, "--json")
    assert done.returncode == 0
    answer = json.loads(done.stdout)
    assert answer["open_directions"] == 0
    assert "failure" not in answer
    assert not any("open" in warning for warning in answer["warnings"])


def test_simulated_data_fail_their_test_in_the_same_way(cli: Run) -> None:
    assert cli("identify", "ur5", "--simulate").returncode == 0
    done = cli("identify", "ur5", "--simulate", "--noise", "tau=20000 %", "--json")
    answer = json.loads(done.stdout)
    assert answer["torque_error"] > 1
    assert (done.returncode, bool(answer["failure"])) == (3, True)
