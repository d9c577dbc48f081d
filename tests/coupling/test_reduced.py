"""Reduced regressors and torques: three references, folding, tasks, closed loop."""

from dataclasses import replace

import numpy as np
import pytest

from sysid_bench.errors import UnsupportedError
from sysid_bench.evaluation.crosscheck import crosscheck
from sysid_bench.identification.identify import identify
from sysid_bench.identification.linear.least_squares import residual_norm
from sysid_bench.models.coupling.constraints import PolynomialCoupling
from sysid_bench.models.coupling.group import Group
from sysid_bench.models.load import load_robot
from sysid_bench.plugin_names import build
from sysid_bench.regressors.block_qr import motion_factors
from sysid_bench.regressors.coupled import torque_regression
from sysid_bench.simulation.candidate import kinematics_of
from sysid_bench.simulation.inverse import Inverse, independent_rows, inverse_torque
from sysid_bench.simulation.plant import plant_of
from sysid_bench.simulation.tracking_control import TrackingControl
from sysid_bench.simulation.tracking_model import StepChoice, tracking_model
from tests.coupling.mechanisms import KINDS, LOOPS, chain, four_bar, mechanism, mjcf
from tests.experiments.experiment_world import executed, ready, spec
from tests.robots import relative_gap, robot_of, states

SEEDS = range(4)
SHORT = {"use": "fourier", "period": "2 s", "cycles": 1, "harmonics": 4}
LOOP = {"use": "closed-loop", "rate": "1 kHz", "substeps": 1}


@pytest.mark.parametrize("kind", KINDS)
def test_engines_agree_on_random_mechanisms(kind: str) -> None:
    for seed in SEEDS:
        check = crosscheck(mechanism(kind, seed), 8)
        assert check.coupling is not None
        assert check.gap <= 1e-12, seed
        assert check.closure <= 1e-11, seed
        assert check.coupling.gap <= 1e-10, seed
        assert check.coupling.closure <= 1e-10, seed
        assert check.coupling.jacobian <= 1e-7, seed
        assert check.coupling.violation <= 1e-12, seed
        assert check.ok(), seed


@pytest.mark.parametrize("kind", KINDS)
def test_the_cross_check_sees_a_wrong_G(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    right = Group.follow
    monkeypatch.setattr(Group, "follow", lambda group, x: 1.001 * right(group, x))
    check = crosscheck(mechanism(kind), 5)
    assert check.coupling is not None
    assert not check.ok()
    wrong = ["coupled gap", "coupled closure", *(["coupled jacobian"] if kind in LOOPS else [])]
    for figure in wrong:
        assert figure in check.reason()


def test_the_cross_check_sees_another_closure_than_the_models() -> None:
    robot = mechanism("geared-pair")
    assert robot.coupling is not None
    (group,) = robot.coupling.groups
    (gear,) = group.constraints
    assert isinstance(gear, PolynomialCoupling)
    wrong = replace(group, constraints=(replace(gear, second=1.1 * gear.second),))
    check = crosscheck(replace(robot, coupling=replace(robot.coupling, groups=(wrong,))), 5)
    assert not check.ok()
    assert "violation" in check.reason()


@pytest.mark.parametrize("kind", KINDS)
def test_torque_is_linear_in_all_parameters_along_closed_motions(kind: str) -> None:
    """With friction, springs and armature of joints that follow, seen through G."""
    robot = mechanism(kind, 1)
    motion = states(robot, 15)
    terms = ("viscous", "coulomb", "offset", "armature", "spring")
    columns = robot.inertial_columns + robot.term_columns(terms)
    theta = np.concatenate([robot.phi.ravel(), robot.term_values(terms)])
    oracle, _ = Inverse().run(plant_of(robot), motion, np.zeros_like(motion.v))
    regression = torque_regression(robot, columns)
    Y = regression.dense(motion).Y
    assert Y.shape == (15, len(robot.torque_rows), len(columns))
    assert relative_gap(Y @ theta, oracle.tau) <= 1e-11
    assert relative_gap(regression.torque(motion, theta), oracle.tau) <= 1e-11


@pytest.mark.parametrize("kind", KINDS)
def test_folded_rows_hold_what_the_dense_rows_hold(kind: str) -> None:
    robot = mechanism(kind, 2)
    motion = states(robot, 40)
    regression = torque_regression(robot, robot.inertial_columns + robot.term_columns(("viscous",)))
    Y = regression.dense(motion).Y
    b = np.random.default_rng(0).normal(size=Y.shape[:2])
    for i, factor in enumerate(motion_factors(regression, motion, b)):
        assert factor.row == robot.torque_rows[i]
        W = np.column_stack([Y[:, i, factor.columns], b[:, i]])
        np.testing.assert_allclose(factor.R.T @ factor.R, W.T @ W, atol=1e-9 * (W**2).sum())
        left = np.setdiff1d(np.arange(Y.shape[2]), factor.columns)
        assert not Y[:, i, left].any()


@pytest.mark.parametrize("task", ["robot", "payload", "link", "terminal"])
@pytest.mark.parametrize("kind", ["four-bar", "mimic-gripper"])
def test_every_task_is_exact_without_noise(kind: str, task: str) -> None:
    (row,) = executed(
        spec(robot=f"random:{kind}:0", payload="box-2kg", task=task, excitation=SHORT), "ols"
    )
    assert row["status"] == "ok", row["reason"]
    assert row["crosscheck"] == "ok"
    assert row["rank"] == row["data_rank"] > 0
    assert row["torque_error"] <= 1e-8


@pytest.mark.parametrize("kind", KINDS)
def test_identified_from_a_closed_loop_next_to_nothing_is_left(kind: str) -> None:
    made = ready(robot=f"random:{kind}:3", excitation=SHORT, simulation=LOOP, rate=500.0)
    estimate = identify(build("estimator", "ols"), made.problem, made.experiment)
    assert estimate.status == "ok", estimate.reason
    assert estimate.beta is not None
    recorded = np.linalg.norm(made.experiment.recording.tau, axis=0)
    assert (residual_norm(made.problem, estimate.beta) <= 5e-4 * recorded).all()


@pytest.mark.parametrize("kind", ["slider-crank", "tendon"])
def test_a_method_simulates_the_same_closed_robot(kind: str) -> None:
    """With true parameters its own model does what the plant did, and it knows no numbers."""
    made = ready(robot=f"random:{kind}:3", excitation=SHORT, simulation=LOOP, rate=500.0)
    again, raw = made.experiment.simulate(made.source.truth.theta), made.experiment.raw
    assert again.tau.shape == raw.tau.shape
    assert relative_gap(again.tau, raw.tau) <= 1e-6
    motion = states(made.robot, 10)
    robot = kinematics_of(made.robot)
    assert independent_rows(robot, motion, inverse_torque(robot, motion))[1] <= 1e-12


@pytest.mark.parametrize("kind", LOOPS)
def test_noisy_encoders_are_read_where_motors_are_and_the_rest_follows(kind: str) -> None:
    noise = {"q": 1e-4, "tau": 0.01, "quantum": 1e-4}
    signals = {"filter": "butter 4 20 Hz zero-phase", "derivatives": "from q"}
    robot = f"random:{kind}:0"
    made = ready(robot=robot, excitation=SHORT, rate=200.0, noise=noise, signals=signals)
    recording, coupling = made.experiment.recording, made.robot.coupling
    assert coupling is not None
    motion = recording.motion
    again = coupling.completed(motion.q, motion.v, motion.a)
    for ours, theirs in zip(again, (motion.q, motion.v, motion.a), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-8 * np.abs(theirs).max())
    assert recording.tau.shape[1] == len(made.robot.torque_rows) == len(recording.rows)


@pytest.mark.parametrize(
    ("equality", "moving"),
    [
        ('<weld body1="a6" body2="b3"/>', 3),
        ('<connect body1="a4" anchor="0.1 0 0.1"/>', 6),
        ('<connect body1="a3" body2="b3" anchor="0 0 0.1"/><joint joint1="a6" joint2="a5"/>', 5),
    ],
)
def test_loops_in_space_agree(equality: str, moving: int) -> None:
    """Two arms with any axes: their hands joined, one held at a point, a loop and a gear."""
    rng = np.random.default_rng(3)
    robot = robot_of(mjcf(chain("a", 6, "0 0 0", rng) + chain("b", 3, "0.3 0 0", rng), equality))
    assert len(robot.torque_rows) == moving
    check = crosscheck(robot, 8)
    assert check.ok(), check.reason()
    assert check.coupling is not None
    assert check.coupling.gap <= 1e-10
    assert check.coupling.closure <= 1e-10


def test_a_loop_on_a_floating_base_agrees_too() -> None:
    robot = robot_of(four_bar(base="<freejoint/>"))
    assert robot.torque_rows[-1] == "crank"
    assert len(robot.torque_rows) == 7
    check = crosscheck(robot, 10)
    assert check.ok(), check.reason()
    (row,) = executed(spec(robot="random:four-bar:0", excitation=SHORT), "ols")
    assert row["status"] == "ok"


def test_a_robot_without_couplings_is_its_own_uncoupled_robot() -> None:
    robot = load_robot("ur5")
    assert robot.coupling is None
    assert robot.without_coupling is robot
    assert robot.torque_rows == robot.rows
    tau = np.ones((3, robot.nv))
    assert robot.reduced(np.zeros((3, robot.nv)), tau) is tau


@pytest.mark.parametrize("kind", KINDS)
def test_couplings_take_explicit_integrators_alone(kind: str) -> None:
    plant = plant_of(mechanism(kind))
    controller = TrackingControl().controller(plant)
    for name in ("auto", "euler", "rk4"):
        assert tracking_model(plant, controller, StepChoice(4, name)).opt.timestep <= 0.25e-3
    for name in ("implicit", "implicitfast"):
        with pytest.raises(UnsupportedError, match="coupled joints"):
            tracking_model(plant, controller, StepChoice(4, name))
