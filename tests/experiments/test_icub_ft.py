"""The simulated iCub: identification of the arm behind a sensor in the upper arm."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sysid_bench.evaluation.wrench_estimation import (
    SensorNewtonEuler,
    sensor_newton_euler,
    wrench_errors,
)
from sysid_bench.experiments.tasks.prior import PriorSpread, prior_of
from sysid_bench.experiments.tasks.task import Task, task_of
from sysid_bench.identifiability.subspaces import structural_subspaces
from sysid_bench.identification.estimators.recursive import RecursiveEstimator
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorSubtree, instruments_of
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.regressors.wrench import subtree_dofs, subtree_regressor
from sysid_bench.signals.processing import processing_of
from sysid_bench.simulation.wrench_sensors import contact_torque, sensor_wrench
from sysid_bench.types import Array, Prior, Recording, Trajectory
from tests.experiments.icub_arm import BASE, REST, SIGMA, arm, motion, noisy, touched, training
from tests.identification.batch_solution import batch_estimate

DRAWS = 30


@cache
def basis() -> Array:
    robot, cut, _ = arm()
    return structural_subspaces(robot, cut, (BASE,)).wrench


@cache
def task() -> Task:
    return task_of(arm()[0], "wrench", (), "l_arm")


def cad(draw: int) -> Prior:
    return prior_of(task(), PriorSpread(), np.random.default_rng(100 + draw))


@cache
def rows() -> Array:
    """Y_n B (N, 6, 38) of the training motion."""
    robot, cut, _ = arm()
    return np.asarray(subtree_regressor(robot, cut, training()[0]).Y_n @ basis())


@cache
def test_run() -> tuple[SensorNewtonEuler, Array, Array, Array]:
    """The method with its base at the hand, the sensor, the torques and the touch of the test."""
    robot, cut, plant = arm()
    made = motion(30.0, 1.0, 12)
    touch = touched(made)
    method = sensor_newton_euler(robot, cut, made, BASE)
    tau = newton_euler(robot.tree, robot.tree.link_parameters(robot.phi), made)
    tau = (tau - contact_torque(plant, touch, made))[:, list(method.tree.dofs)]
    return method, sensor_wrench(plant, (cut,), made, touch), tau, touch.wrench


test_run.__test__ = False  # type: ignore[attr-defined]


def solved(W: Array, f: Array) -> Array:
    r = W.shape[-1]
    G = (W / SIGMA[:, None]).reshape(-1, r)
    return np.asarray(np.linalg.lstsq(G, (f / SIGMA).ravel(), rcond=None)[0])


def test_exact_parameters_give_exact_torques_and_wrenches() -> None:
    method, f_b, tau, contact = test_run()
    phi = task().truth.theta
    np.testing.assert_allclose(method.joint_torque(phi, f_b), tau, atol=1e-11)
    np.testing.assert_allclose(method.contact_wrench(phi, f_b), contact, atol=1e-10)


def test_identified_parameters_serve_as_well_as_the_true_ones() -> None:
    """30 CAD models, noise of 0.15 N and 0.008 N m: errors over those of the true parameters, over
    those of CAD without the sensor, and of the 38 parameters."""
    method, f_b, tau, contact = test_run()
    B, phi = basis(), task().truth.theta
    worst, alone, error = 0.0, [], []
    for draw in range(DRAWS):
        beta = solved(rows(), noisy(training()[1], draw))
        sets = {"true": phi, "CAD": cad(draw).theta, "identified": B @ beta}
        errors = wrench_errors(method, sets, noisy(f_b, 1000 + draw), tau, contact)
        true, found = errors["true"], errors["identified"]
        worst = max(worst, found.torque / true.torque, found.force / true.force,
                    found.moment / true.moment)  # fmt: skip
        assert errors["CAD"].torque > 1.1 * found.torque
        alone.append(found.torque_alone / errors["CAD"].torque_alone)
        error.append(np.linalg.norm(beta - B.T @ phi))
    assert worst < 1.02
    assert np.median(alone) < 0.05
    assert np.median(error) < 1e-3


def upstream_torque(
    robot: RobotModel, cut: SensorSubtree, motion: Trajectory, phi: Array, f_b: Array
) -> tuple[tuple[str, ...], Array]:
    """Names and torques tau (N, u) of the joints proximal to the sensor (Traversaro et al. 2015).

    f_b (N, 6) is the measured wrench [n; f]; phi (nb, 10) are the parameters of the whole robot, of
    which those distal to the sensor are not used. Rigid-body torques, as for `SensorNewtonEuler`.
    """
    instruments = instruments_of(robot, (cut,))
    whole = instruments.motion(motion)
    link = int(instruments.tree.carrier[cut.body])
    distal = {*subtree_dofs(robot, cut), *instruments.wrench_rows(cut)}
    dofs = [int(dof) for dof in instruments.tree.links[link].dofs if dof not in distal]
    upstream = phi.copy()
    upstream[list(_distal_bodies(robot, cut))] = 0.0
    tau = newton_euler(instruments.tree, instruments.tree.link_parameters(upstream), whole)[:, dofs]
    J = subtree_regressor(robot, cut, motion).link_jacobian(link, dofs)
    return tuple(robot.rows[dof] for dof in dofs), tau + np.einsum("nuc,nc->nu", J, f_b)


def _distal_bodies(robot: RobotModel, cut: SensorSubtree) -> set[int]:
    """Bodies distal to a sensor, also those distal to further sensors: its reading contains their
    wrench."""
    inside = {cut.body}
    for b in range(cut.body + 1, len(robot.body_names)):
        if int(robot.mj.body_parentid[b + 1]) - 1 in inside:
            inside.add(b)
    return inside


def test_joints_before_the_sensor_need_the_links_between() -> None:
    robot, cut, plant = arm()
    method, f_b, _, _ = test_run()
    made = replace(method.tree.motion)
    short = Trajectory(made.t, made.q[:, :-6], made.v[:, :-6], made.a[:, :-6])
    names, tau = upstream_torque(robot, cut, short, robot.phi, f_b)
    assert names[-3:] == ("l_shoulder_pitch", "l_shoulder_roll", "l_shoulder_yaw")
    whole = newton_euler(robot.tree, robot.tree.link_parameters(robot.phi), short)
    whole -= contact_torque(plant, touched(short), short)
    columns = [robot.rows.index(name) for name in names[-3:]]
    np.testing.assert_allclose(tau[:, -3:], whole[:, columns], atol=1e-11)
    _, without = upstream_torque(robot, cut, short, np.zeros_like(robot.phi), f_b)
    assert np.abs(without[:, -3:] - whole[:, columns]).max() > 0.03


def _prior_in_basis(prior: Prior) -> tuple[Array, Array]:
    B = basis()
    return B.T @ prior.theta, B.T @ np.diag(prior.std**2) @ B


def test_recursion_ends_where_the_batch_does() -> None:
    f = noisy(training()[1], 0)
    start, P = _prior_in_basis(cad(0))
    track = RecursiveEstimator().run(rows(), f, SIGMA, start, P)
    whole = batch_estimate(rows(), f, SIGMA, start, P)
    np.testing.assert_allclose(track.estimate, whole, atol=1e-10)
    weak = RecursiveEstimator(every=1000).run(rows(), f, SIGMA, np.zeros(38), np.full(38, 10.0))
    np.testing.assert_allclose(weak.estimate, solved(rows(), f), atol=1e-7)
    assert track.used.all()
    assert track.gap[1000:].mean() == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("draw", [0, 2, 8, 9])
def test_on_line_torques_start_at_cad_and_leave_it_behind(draw: int) -> None:
    robot, cut, _ = arm()
    made, f = training()
    tree = subtree_regressor(robot, cut, made)
    prior = cad(draw)
    track = RecursiveEstimator(every=20).run(rows(), noisy(f, draw), SIGMA, *_prior_in_basis(prior))
    running = np.repeat(track.beta @ basis().T, 20, axis=0)[: len(made)]
    true = tree.Y_c @ task().truth.theta
    on_line = np.einsum("nkp,np->nk", tree.Y_c, running) - true
    old = tree.Y_c @ prior.theta - true

    def ratio(start: float, end: float) -> float:
        part = (made.t >= start) & (made.t < end)
        return float(np.linalg.norm(on_line[part]) / np.linalg.norm(old[part]))

    assert ratio(0.5, REST) < 2.0
    assert ratio(REST, 7.0) < 2.0
    assert ratio(20.0, 40.0) < 0.2


def test_a_sensors_constants_are_six_more_unknowns() -> None:
    constant = np.array([0.1, -0.05, 0.08, 2.0, -1.5, 3.0])
    f = noisy(training()[1], 3) + constant
    W = np.concatenate([rows(), np.broadcast_to(np.eye(6), (len(f), 6, 6))], axis=2)
    G = (W / SIGMA[:, None]).reshape(-1, 44)
    values = np.linalg.svd(G, compute_uv=False)
    assert (values > 1e-9 * values[0]).sum() == 44
    found = solved(W, f)
    assert np.abs(found[-3:] - constant[3:]).max() < 6e-3
    assert np.abs(found[-6:-3] - constant[:3]).max() < 1e-3
    true = basis().T @ task().truth.theta
    right, wrong = (np.linalg.norm(x[:38] - true) for x in (found, solved(rows(), f)))
    assert wrong > 10 * right


def test_noisy_encoders_and_filtered_rates_suffice() -> None:
    robot, cut, _ = arm()
    made, f = training()
    error = []
    for seed in range(3):
        q = made.q + 1e-4 * np.random.default_rng(seed).normal(size=made.q.shape)
        held = np.flatnonzero(np.ptp(made.q, axis=0) == 0)
        q[:, held] = made.q[:, held]
        raw = Recording(
            made.t, q, np.zeros_like(q), 100.0, robot.rows, wrench=noisy(f, seed),
            wrench_rows=cut.rows,
        )  # fmt: skip
        signals = {"filter": "butter 4 8 Hz zero-phase", "derivatives": "from q"}
        done = processing_of(signals).apply(raw, robot.joints)
        assert done.wrench is not None
        W = subtree_regressor(robot, cut, done.motion).Y_n @ basis()
        error.append(np.linalg.norm(solved(W, done.wrench) - basis().T @ task().truth.theta))
    assert np.median(error) < 2e-3


def test_contacts_are_left_out_where_they_are_known_and_where_they_stand_out() -> None:
    _, cut, plant = arm()
    made, _ = training()
    touch = touched(made)
    f = noisy(sensor_wrench(plant, (cut,), made, touch), 5)
    start, P = _prior_in_basis(cad(5))
    free = np.asarray(~touch.wrench.any(axis=1))
    true = basis().T @ task().truth.theta
    blind = RecursiveEstimator().run(rows(), f, SIGMA, start, P)
    informed = RecursiveEstimator().run(rows(), f, SIGMA, start, P, free)
    alert = RecursiveEstimator(reject=6.0, settled=900).run(rows(), f, SIGMA, start, P)
    np.testing.assert_allclose(
        informed.estimate, batch_estimate(rows(), f, SIGMA, start, P, free), atol=1e-10
    )
    assert alert.used[free].mean() > 0.99
    assert alert.used[~free].mean() < 0.1
    error = [np.linalg.norm(x.estimate - true) for x in (blind, informed, alert)]
    assert error[0] > 10 * error[1]
    assert error[2] < 3 * error[1]


def test_a_gate_keeps_what_is_not_excited_as_certain_as_the_prior() -> None:
    """At rest, forgetting winds the covariance up; with a gate it stays within the prior's."""
    W, f = rows()[:400], noisy(training()[1], 0)[:400]  # the first four seconds: rest
    start, P = _prior_in_basis(cad(0))
    limit = np.sqrt(np.diag(P))
    gated = RecursiveEstimator(forgetting=0.98).run(W, f, SIGMA, start, P)
    wild = RecursiveEstimator(forgetting=0.98, gate=False).run(W, f, SIGMA, start, P)
    assert (gated.std[-1] <= limit * (1 + 1e-9)).all()
    assert (wild.std[-1] > 10 * limit).any()
    np.testing.assert_array_equal(gated.estimate, start)
    assert np.abs(wild.estimate - start).max() > 1e-3


@pytest.mark.long
def test_the_kalman_version_follows_what_changes() -> None:
    """The hand picks up half a kilogram after 30 s; least squares averages, the walk follows."""
    robot, cut, _ = arm()
    made, f = training()
    load = np.zeros(len(task().parameters))
    load[task().parameters.index("l_hand.m")] = 0.5
    tree = subtree_regressor(robot, cut, made)
    later = (made.t > 30)[:, None] * (tree.Y_n @ load)
    start, P = _prior_in_basis(cad(0))
    new = basis().T @ (task().truth.theta + load)
    still, follows = (
        RecursiveEstimator(walk=walk).run(rows(), noisy(f + later, 0), SIGMA, start, P).estimate
        for walk in (0.0, 0.02)
    )
    assert np.linalg.norm(follows - new) < 0.2 * np.linalg.norm(still - new)
