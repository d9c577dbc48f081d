"""What an experiment costs, as a ratio to MuJoCo's bare simulation of the same motion and to the
pipelines that people write around Pinocchio.

Absolute times say more about the machine than about the code.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from mujoco.batch import Batch
from scipy.linalg import lapack, qr, solve_triangular

from sysid_bench.evaluation.score import data_figures
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import Fourier
from sysid_bench.experiments.simulated.composed_plant import composed_plant, size_limits
from sysid_bench.experiments.simulated.problem import ProblemBuilder
from sysid_bench.experiments.tasks.task import task_of
from sysid_bench.harness.suite.plugin_entries import SIGNALS, with_plant_file
from sysid_bench.identifiability.base_map import structural_base
from sysid_bench.identification.estimators.linear import OLS, WLS
from sysid_bench.models.load import load_robot
from sysid_bench.plugin_names import BUILTIN, build
from sysid_bench.regressors.regression import regression
from sysid_bench.signals.pipelines import Parallel
from sysid_bench.simulation.effects.presliding import Stribeck
from sysid_bench.simulation.plant import plant_of
from sysid_bench.simulation.tracking_control import TrackingControl, commands
from sysid_bench.simulation.tracking_model import tracking_model
from sysid_bench.types import Array, Oracle, Recording, Trajectory

Compare = Callable[..., dict[str, float]]
Line = Callable[..., None]


class Bench:
    """One 7-joint arm, 10 s at 1 kHz."""

    def __init__(self, terms: tuple[str, ...]) -> None:
        self.robot = load_robot("xarm7")
        self.terms = terms
        self.task = task_of(self.robot, "robot", terms)
        self.base = structural_base(self.robot, self.task.parameters)
        self.posing = ProblemBuilder(
            self.robot, self.task, self.base, regression(self.robot, self.base.names)
        )
        self.plant = plant_of(self.robot)
        self.loop = TrackingControl()
        rng = np.random.default_rng(0)
        self.motion = Fourier().design(design_problem(self.robot, 1000.0), rng)
        self.silence = np.zeros_like(self.motion.v)
        controller = self.loop.controller(self.plant)
        self.mj = tracking_model(self.plant, controller)
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
        problem = self.posing.build(oracle.motion, oracle.tau)
        assert OLS().solve(problem).beta is not None
        assert WLS().solve(problem).beta is not None
        assert data_figures(problem, {})["condition"] > 1

    def recorded(self) -> tuple[Array, Array, Array, Array]:
        """q, v, a and torque of the rollout."""
        oracle, _ = self.loop.run(self.plant, self.motion, self.silence)
        return oracle.motion.q, oracle.motion.v, oracle.motion.a, oracle.tau

    def stepped(self) -> tuple[Array, Array, Array, Array]:
        """The same by a loop over `mj_step`."""
        data = mujoco.MjData(self.mj)
        data.qpos[:], data.qvel[:] = self.motion.q[0], self.motion.v[0]
        q, v, a, tau = (np.empty((len(self.motion), self.mj.nv)) for _ in range(4))
        for k, u in enumerate(self.control[0]):
            data.ctrl[:] = u
            q[k], v[k] = data.qpos, data.qvel
            mujoco.mj_step(self.mj, data)
            a[k], tau[k] = data.qacc, data.qfrc_actuator
        return q, v, a, tau

    def stacked(self, q: Array, v: Array, a: Array) -> Array:
        """W of all standard parameters, with friction columns where they are identified."""
        model = self.robot.pairing.model
        data = model.createData()
        n, nv = v.shape
        W = np.zeros((n, nv, 10 * nv + len(self.terms) * nv))
        for k in range(n):
            W[k, :, : 10 * nv] = pin.computeJointTorqueRegressor(model, data, q[k], v[k], a[k])
        each = np.arange(nv)
        for place, column in enumerate([v, np.sign(v)][: len(self.terms)]):
            W[:, each, (10 + place) * nv + each] = column
        return W.reshape(n * nv, -1)

    def straightforward(self) -> float:
        """Simulation by steps, everything from the stacked matrix by its pseudoinverse."""
        q, v, a, tau = self.stepped()
        W, b = self.stacked(q, v, a), tau.ravel()
        _, R, order = qr(W, mode="economic", pivoting=True)
        size = np.abs(np.diag(R))
        W = W[:, np.sort(order[: int((size > 1e-5 * size[0]).sum())])]
        beta = np.linalg.pinv(W) @ b
        sigma = (b - W @ beta).reshape(-1, self.robot.nv).std(axis=0)
        weight = np.tile(1 / sigma, len(q))
        beta = np.linalg.pinv(W * weight[:, None]) @ (b * weight)
        assert np.linalg.matrix_rank(W) == len(beta)
        return float(np.linalg.cond(W))

    def well_written(self) -> float:
        """One rollout, base columns known beforehand, one `lstsq` for solution, rank, condition."""
        q, v, a, tau = self.recorded()
        W, b = self.stacked(q, v, a)[:, np.flatnonzero(self.columns_of_base())], tau.ravel()
        beta, _, rank, values = np.linalg.lstsq(W, b)
        assert rank == len(beta)
        sigma = (b - W @ beta).reshape(-1, self.robot.nv).std(axis=0)
        weight = np.tile(1 / sigma, len(q))
        np.linalg.lstsq(W * weight[:, None], b * weight)
        return float(values[0] / values[-1])

    def by_factors(self) -> float:
        """The same with one R factor per least-squares problem: what LAPACK can do at best."""
        q, v, a, tau = self.recorded()
        keep = np.flatnonzero(self.columns_of_base())
        W, b = self.stacked(q, v, a)[:, keep], tau.ravel()
        r = W.shape[1]

        def triangle(weight: Array) -> Array:
            stack = np.empty((len(b), r + 1), order="F")
            stack[:, :r], stack[:, r] = W * weight[:, None], b * weight
            packed, _, _, _ = lapack.dgeqrf(stack, lwork=64 * (r + 1), overwrite_a=1)
            return np.triu(packed[: r + 1])

        R = triangle(np.ones(len(b)))
        beta = solve_triangular(R[:r, :r], R[:r, r])
        sigma = (b - W @ beta).reshape(-1, self.robot.nv).std(axis=0)
        weighted = triangle(np.tile(1 / sigma, len(q)))
        solve_triangular(weighted[:r, :r], weighted[:r, r])
        values = np.linalg.svd(R[:r, :r], compute_uv=False)
        return float(values[0] / values[-1])

    def columns_of_base(self) -> Array:
        """Which columns of `stacked` are base parameters."""
        few = slice(None, None, 50)
        m = self.motion
        W = self.stacked(m.q[few], m.v[few], m.a[few])
        kept = np.zeros(W.shape[1], dtype=bool)
        R = qr(W / np.abs(W).max(), mode="r")[0]
        # From left to right: a column is kept where it adds a direction to those before it.
        basis = np.zeros((len(R), 0))
        for j, column in enumerate(R.T[:, : len(R)]):
            rest = column - basis @ (basis.T @ column)
            rest -= basis @ (basis.T @ rest)
            if np.linalg.norm(rest) > 1e-7:
                kept[j] = True
                basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
        return kept


@pytest.fixture(scope="module", params=[(), ("viscous", "coulomb")], ids=["rigid", "friction"])
def bench(request: pytest.FixtureRequest) -> Bench:
    """The arm, with and without joint friction to be identified, warmed up."""
    made = Bench(request.param)
    made.rollout()
    made.experiment()
    return made


def test_an_experiment_against_a_bare_rollout(bench: Bench, compare: Compare, line: Line) -> None:
    seconds = compare({"whole": bench.experiment, "bare": bench.rollout}, 9)
    must, aim = (2.2, 1.8) if bench.terms else (1.8, 1.5)
    what = "with friction" if bench.terms else "rigid"
    line(f"experiment / bare rollout, {what}", seconds["whole"] / seconds["bare"], must, aim)


def test_an_experiment_of_level_2_against_its_own_rollout(
    bench: Bench, compare: Compare, line: Line
) -> None:
    """The plant of L2, its sizes at the upper end of their ranges, and the filtered problem."""
    written = with_plant_file({"use": "L2"}, None)
    level = composed_plant({key: x for key, x in written.items() if key not in SIGNALS})
    effects = [
        build("plant", size_limits(entry.spec)[-1]) for entry in level if entry.group == "effects"
    ]
    plant, joints = plant_of(bench.robot, effects), bench.robot.joints

    def rollout() -> Oracle:
        return bench.loop.run(plant, bench.motion, bench.silence)[0]

    def experiment() -> None:
        oracle = rollout()
        motion = oracle.motion
        recording = Recording(motion.t, motion.q, oracle.tau, 1000.0, bench.robot.torque_rows)
        processed = Parallel().process(recording, joints)
        along_motion = processed.recording.motion
        along = bench.posing.rows_along(along_motion, processed.rows)
        problem = bench.posing.build(along_motion, processed.recording.tau, rows=along)
        assert WLS().solve(problem).beta is not None
        assert data_figures(problem, {})["condition"] > 1

    seconds = compare({"whole": experiment, "rollout": rollout}, 5)
    what = "with friction" if bench.terms else "rigid"
    line(f"experiment at L2 / its own rollout, {what}", seconds["whole"] / seconds["rollout"], 1.8)


def test_all_effects_together_against_a_bare_rollout(
    bench: Bench, compare: Compare, line: Line
) -> None:
    """Every effect of the plant in closed loop, at the step that its stiffest spring needs."""
    effects = [build("plant", name) for name in sorted({*BUILTIN["plant"]} - {"matched", "play"})]
    plant, motion = plant_of(bench.robot, effects), bench.motion
    controller = bench.loop.controller(plant)
    fine = tracking_model(plant, controller, bench.loop.step_choice).opt.timestep
    bare = tracking_model(bench.plant, controller, bench.loop.step_choice)
    bare.opt.timestep = fine
    one = Trajectory(motion.t[:1000], motion.q[:1000], motion.v[:1000], motion.a[:1000])
    each = round((one.t[1] - one.t[0]) / fine)
    control = np.repeat(bench.control[:, :1000], each, axis=1)

    def rollout() -> None:
        batch = Batch(bare, 1, nthread=1)
        batch.bind("qpos")[0], batch.bind("qvel")[0] = one.q[0], one.v[0]
        batch.rollout(control.shape[1], control, record=["qpos", "qvel", "qacc", "qfrc_actuator"])

    whole = partial(bench.loop.run, plant, one, bench.silence[:1000])
    seconds = compare({"whole": whole, "bare": rollout}, 5)
    line("all effects / bare rollout", seconds["whole"] / seconds["bare"], 2.0, 1.5)


def test_force_laws_and_company_against_a_bare_rollout(
    bench: Bench, compare: Compare, line: Line
) -> None:
    """Friction that MuJoCo has not, and eight simulations side by side in one batch."""
    effect = plant_of(bench.robot, [Stribeck()])
    eight = Batch(bench.mj, 8, nthread=1)

    def side_by_side() -> None:
        eight.bind("qpos")[:], eight.bind("qvel")[:] = bench.motion.q[0], bench.motion.v[0]
        control = np.repeat(bench.control, 8, axis=0)
        record = ["qpos", "qvel", "qacc", "qfrc_actuator"]
        eight.rollout(len(bench.motion), control, record=record)

    seconds = compare(
        {
            "laws": lambda: bench.loop.run(effect, bench.motion, bench.silence),
            "none": lambda: bench.loop.run(bench.plant, bench.motion, bench.silence),
            "bare": bench.rollout,
            "eight": side_by_side,
        },
        7,
    )
    what = "with friction" if bench.terms else "rigid"
    line(f"simulation with Stribeck friction / without, {what}", seconds["laws"] / seconds["none"])
    line(
        f"eight rollouts side by side / one by one, {what}", seconds["eight"] / 8 / seconds["bare"]
    )


def test_an_experiment_against_pipelines(bench: Bench, compare: Compare, line: Line) -> None:
    kept = bench.columns_of_base()
    assert kept.sum() == bench.base.rank
    bench.columns_of_base = lambda: kept  # type: ignore[method-assign]
    seconds = compare(
        {
            "ours": bench.experiment,
            "straightforward": bench.straightforward,
            "well": bench.well_written,
            "factors": bench.by_factors,
        },
        3,
    )
    what = "with friction" if bench.terms else "rigid"
    line(f"straightforward Pinocchio pipeline / experiment, {what}",
         seconds["straightforward"] / seconds["ours"], 8, 11, True)  # fmt: skip
    line(f"well-written Pinocchio pipeline / experiment, {what}",
         seconds["well"] / seconds["ours"], 3, 4, True)  # fmt: skip
    line(f"the same by R factors / experiment, {what}", seconds["factors"] / seconds["ours"])


def test_whole_experiment(bench: Bench, benchmark: Any) -> None:
    benchmark(bench.experiment)
