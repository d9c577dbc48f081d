"""The tasks `wrench` and `wrench-payload`: bodies behind a force/torque sensor, from it alone."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import UnsupportedError
from sysid_bench.experiments.cell_data import cell_data
from sysid_bench.experiments.simulated.problem import ProblemBuilder
from sysid_bench.experiments.tasks.task import task_of
from sysid_bench.identifiability.base_expressions import parameter_verdict
from sysid_bench.identifiability.base_map import structural_base
from sysid_bench.identification.estimators.linear import WLS
from sysid_bench.identification.estimators.recursive import RLS, RecursiveEstimator
from sysid_bench.identification.linear.least_squares import dense_rows, row_noise
from sysid_bench.models.manifest import Sensor, find_manifest
from sysid_bench.models.random_robot import random_robot
from sysid_bench.models.sensor import instruments_of, subtree_at
from sysid_bench.regressors.sensor_offset import measured_regression
from sysid_bench.regressors.wrench import subtree_regressor
from sysid_bench.simulation.plant import plant_of
from sysid_bench.simulation.wrench_sensors import (
    Contact,
    WrenchNoise,
    contact_torque,
    sensor_error,
    sensor_wrench,
)
from tests.closeness import assert_close
from tests.experiments.experiment_world import CLOSED_LOOP, argument, executed, ready, solved, spec
from tests.robots import NAMED, named_robot, relative_gap, robot_of, states
from tests.robots import random_robot as rich_robot

ARM = {"robot": "icub", "task": "wrench", "sensor": "l_arm"}
WRIST = {"robot": "ur5", "payload": "box-2kg", "task": "wrench-payload"}
WHITE = {"force": 0.15, "moment": 0.008}


@pytest.mark.parametrize("seed", range(8))
def test_mujocos_sensor_feels_what_the_regressor_predicts(seed: int) -> None:
    """Also with an external wrench, which X (Y_n phi - f) finds again at the body it acts on."""
    robot = robot_of(random_robot(seed)) if seed % 2 else rich_robot(seed)
    motion, rng = states(robot, 5, seed), np.random.default_rng(seed)
    for name in rng.permutation(robot.body_names)[:3]:
        cut = subtree_at(robot, name)
        made = subtree_regressor(robot, cut, motion)
        free = made.Y_n @ robot.phi[list(cut.bodies)].ravel()
        assert relative_gap(free, sensor_wrench(plant_of(robot), (cut,), motion)) < 1e-12
        touch = Contact(int(rng.choice(cut.bodies)), rng.normal(size=(5, 6)))
        felt = sensor_wrench(plant_of(robot), (cut,), motion, touch)
        base = robot.body_names[touch.body]
        found = np.einsum("nij,nj->ni", made.wrench_transform(base), free - felt)
        np.testing.assert_allclose(found, touch.wrench, atol=1e-10 * (1 + np.abs(free).max()))
        relief = contact_torque(plant_of(robot), touch, motion)[:, list(made.dofs)]
        there = np.einsum("nkc,nc->nk", made.jacobian(base), free - felt)
        np.testing.assert_allclose(there, relief, atol=1e-10 * (1 + np.abs(free).max()))


@pytest.mark.parametrize("sensor", ["l_arm", "r_leg", "l_foot", "chest"])
def test_exact_wrenches_close(sensor: str) -> None:
    """A sub-tree ends where the next sensor takes over: the leg at the foot's."""
    made = ready(**{**ARM, "sensor": sensor})
    assert made.problem.rows == tuple(f"{sensor}.{c}" for c in ("nx", "ny", "nz", "fx", "fy", "fz"))
    assert made.problem.kinds == ("wrench N m",) * 3 + ("wrench N",) * 3
    _, scores = solved(made, WLS())
    assert scores.rmse_test < 1e-10
    assert scores.beta_error < 1e-8


def test_a_robot_with_a_free_base_and_a_closed_loop_serve_too() -> None:
    free = ready(robot="solo12", task="wrench", sensor="FL_UPPER_LEG")
    assert free.problem.base.rank == 17
    loop = ready(**WRIST, simulation=CLOSED_LOOP)
    for made in (free, loop):
        assert solved(made, WLS())[1].beta_error < 1e-7
    with pytest.raises(UnsupportedError, match="no whole robot"):
        loop.experiment.simulate(loop.source.truth.theta)


WRISTED = [name for name in NAMED if "wrist" in {s.name for s in find_manifest(name).sensors}]


@pytest.mark.parametrize("name", WRISTED)
def test_a_wrist_identifies_all_ten_numbers_of_a_payload(name: str) -> None:
    robot = named_robot(name, "box-2kg")
    task = task_of(robot, "wrench-payload", ("offset",), "wrist", lambda n: np.arange(6.0 * n))
    base = structural_base(robot, task.parameters, task.rows, task.cuts)
    assert base.rank == 16
    assert set(parameter_verdict(base)) == {"identifiable"}
    assert task.truth.theta[10:].tolist() == list(range(6))


def test_a_sensors_constants_are_found_or_spoil_the_rest() -> None:
    noise = {**WHITE, "force_offset": 2.0, "moment_offset": 0.1}
    biased = {**ARM, "noise": noise, "rate": 100.0, "excitation": {"use": "fourier"}}
    known = ready(**biased, terms=("offset",))
    assert (known.problem.base.rank, len(known.problem.parameters)) == (44, 96)
    found, scores = solved(known, WLS())
    _, worse = solved(ready(**biased), WLS())
    error = found.beta[-6:] - known.source.truth.theta[-6:]
    assert np.abs(known.source.truth.theta[-3:]).max() > 0.5
    assert np.abs(error[3:]).max() < 0.03
    assert np.abs(error[:3]).max() < 0.005
    assert worse.rmse_test > 10 * scores.rmse_test


@pytest.mark.parametrize("sensor", ["l_leg", "r_leg"])
def test_constants_of_the_sensor_that_ends_a_sub_tree_are_found_too(sensor: str) -> None:
    """The leg's reading less the foot's: both sensors have constants, and both are found."""
    noise = {**WHITE, "force_offset": 2.0, "moment_offset": 0.1}
    leg = {**ARM, "sensor": sensor, "noise": noise, "rate": 100.0}
    made = ready(**leg, terms=("offset",))
    foot = sensor.replace("leg", "foot")
    assert made.problem.parameters[-1] == f"{foot}.fz.offset"
    assert len(made.problem.parameters) == 10 * len(made.source.task.bodies) + 12
    assert made.problem.base.rank == 50
    found, scores = solved(made, WLS())
    true = made.problem.base.K @ made.source.truth.theta
    places = np.array([name.endswith("offset") for name in made.problem.base.names])
    forces = np.array([".f" in name for name in made.problem.base.names])
    error = np.abs(found.beta - true)
    assert places.sum() == 12
    assert error[places & forces].max() < 0.2
    assert error[places & ~forces].max() < 0.1
    assert np.abs(true[places]).max() > 0.5
    assert scores.torque_error < 0.02
    _, worse = solved(ready(**leg), WLS())
    assert worse.torque_error > 10 * scores.torque_error


@pytest.mark.parametrize("seed", range(6))
def test_exact_data_give_the_constants_of_every_sensor_of_a_tree(seed: int) -> None:
    """Sub-trees of random robots that end at other sensors: W theta is what remains of the
    readings, constants and all."""
    robot, rng = robot_of(random_robot(seed)), np.random.default_rng(seed)
    first = max(robot.body_names, key=lambda name: len(subtree_at(robot, name).bodies))
    behind = [robot.body_names[b] for b in subtree_at(robot, first).bodies[1:]]
    ends = [str(name) for name in rng.permutation(behind)[:2]]
    sensors = tuple(Sensor(name=f"s{k}", at=at) for k, at in enumerate([first, *ends]))
    robot = replace(robot, manifest=replace(robot.manifest, sensors=sensors))
    true = rng.normal(size=18)
    task = task_of(robot, "wrench", ("offset",), "s0", lambda n: true[: 6 * n])
    base = structural_base(robot, task.parameters, task.rows, task.cuts)
    instruments = instruments_of(robot, task.cuts)
    columns = measured_regression(robot, base.names, instruments, task.rows)
    motion = states(robot, 20, seed)
    wrench = sensor_wrench(plant_of(robot), task.cuts, motion) + true[: 6 * len(task.cuts)]
    measured = np.hstack([np.zeros((20, len(robot.torque_rows))), wrench])
    problem = ProblemBuilder(robot, task, base, columns).build(motion, measured)
    W, b = (np.concatenate(parts) for parts in zip(*problem.blocks(), strict=True))
    beta = base.K @ task.truth.theta
    assert relative_gap(W @ beta, b) < 1e-11
    whole = instruments.motion(motion)
    Y = np.concatenate([block.dense() for block in columns.blocks(whole)])
    assert relative_gap(columns.torque(whole, beta), Y @ beta) < 1e-13
    for factor in problem.factors:
        rest = np.linalg.norm(factor.R @ np.append(beta[factor.columns], -1.0))
        assert rest < 1e-10 * max(float(np.linalg.norm(factor.R[:, -1])), 1.0)


@pytest.mark.parametrize("forgetting", [1.0, 0.998])
def test_rls_is_the_on_line_recursion_from_a_prior_that_says_nothing(forgetting: float) -> None:
    problem = ready(**WRIST, noise=WHITE, rate=50.0, terms=("offset",)).problem
    W, f = dense_rows(problem)
    start = np.zeros(16), np.full(16, 1e5)
    recursion = RecursiveEstimator(forgetting=forgetting, gate=False, every=10**6)
    track = recursion.run(W, f, row_noise(problem), *start)
    estimate: Any = RLS(forgetting).solve(problem)
    np.testing.assert_allclose(track.estimate, estimate.beta, rtol=1e-6, atol=1e-8)
    if forgetting == 1.0:
        np.testing.assert_allclose(track.covariance, estimate.covariance, rtol=1e-5, atol=1e-14)


def test_noise_draws_are_shared_by_all_levels_and_only_where_there_is_noise() -> None:
    exact, small, large = (
        np.asarray(ready(**WRIST, noise=noise).experiment.raw.wrench)
        for noise in ({}, {"force": 0.1}, {"force": 0.2})
    )
    np.testing.assert_allclose(large - exact, 2 * (small - exact), atol=1e-12)
    assert not (small - exact)[:, :3].any()
    assert (small - exact)[:, 3:].std() == pytest.approx(0.1, rel=0.1)
    tau = ready(**{**WRIST, "task": "payload"}).experiment.raw
    assert tau.wrench is None


@pytest.mark.parametrize("seed", range(3))
def test_a_fault_is_gain_crosstalk_and_a_turn(seed: int) -> None:
    rng = np.random.default_rng(seed)
    wrench = rng.normal(size=(50, 6)) * np.repeat([0.2, 8.0], 3)
    t = np.arange(50.0)
    turned = sensor_error(WrenchNoise(mounting=0.01), np.random.default_rng(seed))
    R = turned.A[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    assert np.arccos((np.trace(R) - 1) / 2) == pytest.approx(0.01, rel=1e-3)
    np.testing.assert_array_equal(turned.A[3:, 3:], R)
    gained = sensor_error(WrenchNoise(gain=0.01), np.random.default_rng(seed))
    assert np.count_nonzero(gained.A) == 6
    assert 0.002 < np.std(np.diag(gained.A)) < 0.02
    crossed = sensor_error(WrenchNoise(crosstalk=0.01), np.random.default_rng(seed))
    np.testing.assert_array_equal(np.diag(crossed.A), np.ones(6))
    added = crossed.read(wrench, t) - wrench
    share = np.sqrt((added**2).mean(axis=0) / (wrench**2).mean(axis=0))
    assert ((share > 1e-4) & (share < 0.2)).all()
    for drift, constant in (("force_drift", slice(3)), ("moment_drift", slice(3, 6))):
        slow = sensor_error(WrenchNoise(**{drift: 0.1}), np.random.default_rng(seed))
        assert not slow.offset.any()
        assert not slow.slope[constant].any()
        assert_close(slow.read(wrench, t)[-1] - wrench[-1], 49 * slow.slope)


def test_requests_that_make_no_sense_say_why() -> None:
    with pytest.raises(UnsupportedError, match="the sensors l_arm, r_arm"):
        ready(**{**ARM, "sensor": None})
    with pytest.raises(UnsupportedError, match="does not measure joint terms: viscous"):
        ready(**ARM, terms=("viscous",))
    with pytest.raises(UnsupportedError, match="No payload is mounted behind"):
        ready(**{**WRIST, "payload": "none"})
    with pytest.raises(UnsupportedError, match="No payload is mounted behind"):
        ready(robot="icub", payload="box-2kg", task="wrench-payload", sensor="r_arm")


def test_rows_and_pictures_are_of_the_sensor() -> None:
    made = spec(**WRIST, noise=WHITE)
    (row,) = executed(made, "wls")
    assert row["status"] == "ok"
    assert row["mass_error"] < 0.01
    assert row["inertia_error"] < 0.5
    assert row["joints"][0]["name"] == "wrist.nx"
    shown = cell_data(argument(made, "wls"), row)
    assert shown.rows[0] == "wrist.nx"
    assert shown.predicted is not None
    assert np.abs(shown.predicted - shown.measured).max() < 1.0
    assert shown.gap_map.shape == (6, len(shown.gap_columns))
    assert shown.gap_map.max() < 1e-12


def test_the_specification_is_written_only_where_it_says_something() -> None:
    assert "sensor" not in spec().to_json()
    assert spec(**ARM).to_json()["sensor"] == "l_arm"


@pytest.mark.parametrize("sensors", ["l_arm", "l_arm, r_arm, l_leg, r_leg, l_foot, r_foot"])
def test_sensors_combine_with_joint_torques(sensors: str) -> None:
    """They add rows, and identify what the torques of a held robot do not."""
    alone = ready(robot="icub", noise={"tau": 0.05})
    both = ready(robot="icub", sensor=sensors, noise={"tau": 0.05, **WHITE})
    count = 6 * len(sensors.split(","))
    assert len(both.problem.rows) == 32 + count
    assert both.problem.rows[32] == "l_arm.nx"
    assert both.problem.base.rank > alone.problem.base.rank
    scores = [solved(made, WLS())[1] for made in (alone, both)]
    elbow = [next(j for j in one.joints if j["name"] == "l_elbow") for one in scores]
    assert elbow[1]["rmse_test"] < elbow[0]["rmse_test"]


def test_a_payload_is_found_better_with_both() -> None:
    noise = {"tau": 0.5, **WHITE}
    made = [
        ready(**{**WRIST, "task": task}, sensor=sensor, noise=noise, rate=200.0)
        for task, sensor in (("payload", None), ("wrench-payload", "wrist"), ("payload", "wrist"))
    ]
    std = []
    for one in made:
        # Noise of 0.5 and 0.008 N m in one problem: the first weights come from a rough solution.
        found, _ = solved(one, WLS(iterations=8))
        std.append(np.sqrt(np.diag(found.covariance)))
    assert (std[2] < 1.2 * std[0]).all()
    assert (std[2] < 1.2 * std[1]).all()
    assert (std[1][4:] < std[0][4:]).all()


TOUCHED = {"robot": "icub", "task": "wrench", "sensor": "l_arm", "rate": 100.0, "excitation":
           {"use": "wander", "duration": "45 s"}}  # fmt: skip
TOUCH = {**WHITE, "touch": 5.0}


@pytest.mark.parametrize("repeat", [0, *(pytest.param(k, marks=pytest.mark.long) for k in (1, 2))])
def test_contacts_are_left_out_where_they_are_declared_or_found(repeat: int) -> None:
    """5 N on the hand for the middle third of a recording; without any, nothing is found."""
    exact = {"filter": "none", "derivatives": "exact"}
    settings = {
        "clean": (WHITE, exact),
        "quiet": (WHITE, exact | {"contacts": "detect"}),
        "blind": (TOUCH, exact),
        "declared": (TOUCH, exact | {"contacts": ["15 s to 30 s"]}),
        "found": (TOUCH, exact | {"contacts": "detect"}),
    }
    share: dict[str, float] = {}
    error: dict[str, float] = {}
    for name, (noise, signals) in settings.items():
        made = ready(**TOUCHED, noise=noise, signals=signals, repeat=repeat)
        share[name], error[name] = made.source.left_out, solved(made, WLS())[1].torque_error
    assert share["clean"] == share["blind"] == 0.0
    assert share["quiet"] < 0.03
    assert share["declared"] == pytest.approx(1 / 3, abs=1e-3)
    assert share["found"] == pytest.approx(1 / 3, abs=0.03)
    assert error["blind"] > 10 * error["declared"]
    assert error["found"] < 2 * error["declared"]
    assert error["declared"] < 3 * error["clean"]
