"""What an experiment costs, as a ratio to MuJoCo's bare simulation of the same motion.

Both are timed in turn in one process, CPU time, and the medians are compared: absolute times say
more about the machine than about the code.
"""

import time
from collections.abc import Callable
from statistics import median

import numpy as np
import pytest
from mujoco.batch import Batch

from sysid_bench.evaluation.score import data_figures
from sysid_bench.excitation.brief import brief_of
from sysid_bench.excitation.fourier import Fourier
from sysid_bench.harness.experiment.prepare import Posing
from sysid_bench.identifiability.structural import structural_base
from sysid_bench.identification.estimators.ols import OLS
from sysid_bench.identification.estimators.wls import WLS
from sysid_bench.models.load import load_robot
from sysid_bench.models.task import task_of
from sysid_bench.regressors.regression import regression
from sysid_bench.simulation.closed_loop import ClosedLoop, commands, controlled_model
from sysid_bench.simulation.plant import plant_of

ROUNDS = 9


class Bench:
    """One 7-joint arm, 10 s at 1 kHz."""

    def __init__(self) -> None:
        self.robot = load_robot("xarm7")
        self.task = task_of(self.robot, "robot", ("viscous", "coulomb"))
        self.base = structural_base(self.robot, self.task.parameters)
        self.posing = Posing(
            self.robot, self.task, self.base, regression(self.robot, self.base.names)
        )
        self.plant = plant_of(self.robot)
        self.loop = ClosedLoop()
        rng = np.random.default_rng(0)
        self.motion = Fourier().design(brief_of(self.robot, 1000.0), rng)
        self.silence = np.zeros_like(self.motion.v)
        controller = self.loop.controller(self.plant)
        self.mj = controlled_model(self.plant, controller)
        self.control = commands(controller, self.motion, self.silence, self.robot)[None]

    def rollout(self) -> None:
        """The simulation alone."""
        batch = Batch(self.mj, 1, nthread=1)
        batch.bind("qpos")[0], batch.bind("qvel")[0] = self.motion.q[0], self.motion.v[0]
        record = ["qpos", "qvel", "qacc", "qfrc_actuator"]
        batch.rollout(len(self.motion), self.control, record=record)

    def experiment(self) -> None:
        """Simulation, regressor, R factors, OLS, WLS, rank and condition."""
        oracle, _ = self.loop.run(self.plant, self.motion, self.silence)
        problem = self.posing.pose(oracle.motion, oracle.tau)
        assert OLS().solve(problem).beta is not None
        assert WLS().solve(problem).beta is not None
        assert data_figures(problem, {})["condition"] > 1


def cpu_seconds(function: Callable[[], None]) -> float:
    """CPU time of one call."""
    start = time.process_time()
    function()
    return time.process_time() - start


@pytest.fixture(scope="module")
def bench() -> Bench:
    """The arm, warmed up."""
    made = Bench()
    made.rollout()
    made.experiment()
    return made


def test_an_experiment_costs_at_most_three_bare_rollouts(bench: Bench) -> None:
    pairs = [(cpu_seconds(bench.experiment), cpu_seconds(bench.rollout)) for _ in range(ROUNDS)]
    ratio = median(whole / bare for whole, bare in pairs)
    print(f"experiment / bare rollout: {ratio:.2f}")
    assert ratio <= 3.0


def test_rollout(bench: Bench, benchmark: Callable[..., None]) -> None:
    benchmark(bench.rollout)


def test_whole_experiment(bench: Bench, benchmark: Callable[..., None]) -> None:
    benchmark(bench.experiment)
