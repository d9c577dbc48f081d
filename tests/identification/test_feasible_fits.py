"""Physically consistent fits: certificates, optima, and directions that the prior decides."""

import time
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sysid_bench.apps.conformance.estimator import first_samples
from sysid_bench.errors import EstimationError
from sysid_bench.identification.estimators.feasible import (
    LMI,
    Bounded,
    Entropic,
    LMIEuclidean,
    LMIPullback,
    LogCholesky,
    Reconstruction,
)
from sysid_bench.identification.estimators.linear import WLS
from sysid_bench.identification.feasibility.cholesky_coordinates import coordinates
from sysid_bench.identification.feasibility.completion import DISTANCES, completed_parameters
from sysid_bench.identification.feasibility.divergence import divergence
from sysid_bench.identification.feasibility.feasible_set import (
    WEAK,
    FeasibleSet,
    feasible_point,
    feasible_set_of,
    scaled_coordinates,
    spread_of,
    start_of,
)
from sysid_bench.identification.identify import identify
from sysid_bench.spatial import body_mass_inertia, feasible_margins
from sysid_bench.types import Array, Estimate, Prior, Problem
from tests.experiments.experiment_world import ready
from tests.robots import random_phi

ROBOTS = ("ur5", "z1", "solo12", "random:3", "random:17")
METHODS = (LMI(), LMIEuclidean(), LMIPullback(), Entropic(), LogCholesky())


@cache
def problem(robot: str, noise: float = 0.02, task: str = "robot", payload: str = "none") -> Problem:
    made = ready(robot=robot, task=task, payload=payload, noise={"tau_relative": noise})
    return made.problem


def theta_of(estimate: Estimate) -> Array:
    assert estimate.status == "ok", estimate.reason
    assert estimate.theta is not None
    return estimate.theta


def objective(of: FeasibleSet, at: Problem, theta: Array) -> float:
    """Squares over the noise, as the fits weigh them, above those of least squares."""
    y = scaled_coordinates(of, at, theta / of.scale).y(theta / of.scale)
    return float(y[: at.base.rank] @ y[: at.base.rank])


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.02, 0.3])
@pytest.mark.parametrize("robot", ROBOTS)
def test_every_estimate_is_consistent_and_certified(robot: str, noise: float) -> None:
    at = problem(robot, noise)
    of = feasible_set_of(at)
    for method in METHODS:
        estimate = identify(method, at)
        theta = theta_of(estimate)
        assert feasible_margins(theta[of.indices]).min() >= 0
        assert theta[of.nonnegative].min(initial=0.0) >= 0
        assert estimate.stats["roundness"] > 0
        if "duality_gap" in estimate.stats:
            assert estimate.stats["duality_gap"] <= 1e-4 * max(1.0, estimate.stats["excess"])


@pytest.mark.parametrize(
    ("task", "payload"), [("payload", "box-2kg"), ("link", "rod-1kg"), ("terminal", "none")]
)
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_estimates_of_single_bodies_are_consistent(task: str, payload: str, noise: float) -> None:
    at = problem("ur5", noise, task, payload)
    for method in METHODS:
        theta = theta_of(identify(method, at))
        assert feasible_margins(theta[feasible_set_of(at).indices]).min() >= 0


@pytest.mark.parametrize("robot", ROBOTS)
def test_no_feasible_direction_decreases_the_objective(robot: str) -> None:
    """The optimum of a convex fit: every feasible direction goes up."""
    at = problem(robot)
    of = feasible_set_of(at)
    best = theta_of(LMI().solve(at))
    value = objective(of, at, best)
    rng = np.random.default_rng(0)
    for _ in range(20):
        other = rng.uniform(0, 1, len(best))
        other[of.indices] = random_phi(rng, len(of.indices)) * rng.uniform(0.01, 1)
        for share in (1e-3, 1e-5):
            moved = best + share * (other - best)
            assert objective(of, at, moved) > value - 1e-2


@pytest.mark.parametrize("robot", ROBOTS)
def test_exact_data_give_the_true_base_parameters(robot: str) -> None:
    made = ready(robot=robot, prior="none")
    truth = made.problem.base.K @ made.source.truth.theta
    for method in (LMI(), Bounded()):
        beta = identify(method, made.problem).beta
        assert beta is not None
        assert np.linalg.norm(beta - truth) <= 1e-8 * np.linalg.norm(truth)


def test_limits_of_mass_and_centre_are_kept() -> None:
    at = problem("ur5", 0.3)
    of = feasible_set_of(at)
    phi = theta_of(LMI(mass=(0.5, 4.0), com=0.2).solve(at))[of.indices]
    assert phi[:, 0].min() >= 0.5 - 1e-6
    assert phi[:, 0].max() <= 4.0 + 1e-6
    assert max(np.abs(body_mass_inertia(one)[1]).max() for one in phi) <= 0.2 + 1e-5
    with pytest.raises(EstimationError, match="Clarabel"):
        LMI(mass=(5.0, 4.0)).solve(at)


def test_bounds_of_single_parameters_are_weaker() -> None:
    at = problem("z1")
    excess = [method.solve(at).stats["excess"] for method in (Bounded(), LMI())]
    assert 0 < excess[0] < excess[1]


@pytest.mark.parametrize("robot", ["ur5", "random:3"])
def test_the_entropic_fit_is_where_its_gradient_vanishes(robot: str) -> None:
    at = problem(robot)
    of = feasible_set_of(at)
    assert at.prior is not None
    std = spread_of(of, at.prior)
    near = divergence(of, feasible_point(of, at.prior.theta / of.scale, std), std)
    x = theta_of(Entropic(weight=3.0).solve(at)) / of.scale

    def value(x: Array) -> float:
        return 0.5 * objective(of, at, of.scale * x) + 3.0 * near.value(x)

    rng = np.random.default_rng(1)
    for _ in range(5):
        step = 1e-4 * np.abs(x) * rng.normal(size=len(x))
        slope = (value(x + step) - value(x - step)) / 2
        curve = value(x + step) + value(x - step) - 2 * value(x)
        assert curve > 0
        assert abs(slope) < 0.1 * curve


@pytest.mark.parametrize(("robot", "noise"), [("icub", 0.0), ("panda", 0.0), ("random:3", 1e-4)])
def test_the_entropic_fit_converges_at_the_boundary(robot: str, noise: float) -> None:
    """Little noise beside a wrong prior drives bodies to the edge, where Newton's method on the
    divergence alone creeps."""
    estimate = identify(Entropic(), problem(robot, noise))
    theta_of(estimate)
    assert estimate.stats["decrement"] <= 1e-8
    assert estimate.stats["iterations"] <= 80


def test_the_divergence_is_invariant_to_frames_and_units() -> None:
    """-log det J + tr(J0^-1 J) is the same after a change of frame or of the unit of mass."""
    from sysid_bench.spatial import inertia_transform
    from tests.robots import random_rotation

    rng = np.random.default_rng(2)
    phi, phi0 = random_phi(rng, 2)
    of = feasible_set_of(problem("ur10", 0.02, "payload", "box-2kg"))
    X = inertia_transform(random_rotation(rng), rng.normal(size=3))

    def distance(phi: Array, phi0: Array) -> float:
        near = divergence(of, phi0 / of.scale, np.ones(10))
        return near.value(phi / of.scale) - near.value(phi0 / of.scale)

    assert distance(phi, phi0) > 0
    assert distance(X @ phi, X @ phi0) == pytest.approx(distance(phi, phi0), rel=1e-9)
    assert distance(7 * phi, 7 * phi0) == pytest.approx(distance(phi, phi0), rel=1e-9)


def test_log_cholesky_coordinates_and_their_derivatives() -> None:
    at = problem("random:3")
    of = feasible_set_of(at)
    assert at.prior is not None
    x0 = feasible_point(of, start_of(of, at.prior), spread_of(of, at.prior))
    made, rng = coordinates(of, x0), np.random.default_rng(3)
    np.testing.assert_allclose(made.x(made.eta0), x0, atol=1e-10)
    eta, d = made.eta0 + 0.2 * rng.normal(size=len(x0)), 1e-6 * rng.normal(size=len(x0))
    pull = rng.normal(size=len(x0))
    np.testing.assert_allclose(
        made.x(eta + d) - made.x(eta - d), 2 * made.jacobian(eta) @ d, atol=1e-12
    )
    change = pull @ (made.jacobian(eta + d) - made.jacobian(eta - d))
    np.testing.assert_allclose(change, 2 * made.newton_term(eta, pull) @ d, atol=1e-9)


@pytest.mark.parametrize("distance", DISTANCES)
@pytest.mark.parametrize("robot", ROBOTS)
def test_completion_keeps_beta_and_lies_nearest(robot: str, distance: str) -> None:
    made = ready(robot=robot)
    at, of = made.problem, feasible_set_of(made.problem)
    beta = at.base.K @ made.source.truth.theta
    assert at.prior is not None
    theta = completed_parameters(of, at.base, beta, at.prior, distance)
    assert np.linalg.norm(at.base.K @ theta - beta) <= 1e-8 * np.linalg.norm(beta)
    assert feasible_margins(theta[of.indices]).min() >= 0
    x0 = feasible_point(of, at.prior.theta / of.scale, spread_of(of, at.prior))
    near = divergence(of, x0, spread_of(of, at.prior))
    if distance == "entropic":
        solid = 0.999 * theta + 0.001 * made.source.truth.theta  # has beta too, and can exist
        assert near.value(theta / of.scale) <= near.value(solid / of.scale) + 1e-9


@pytest.mark.parametrize("robot", ["ur5", "z1"])
def test_a_prior_with_the_right_beta_is_its_own_completion(robot: str) -> None:
    made = ready(robot=robot)
    at, of = made.problem, feasible_set_of(made.problem)
    assert at.prior is not None
    x = feasible_point(of, at.prior.theta / of.scale, spread_of(of, at.prior))
    prior = Prior(of.scale * x, at.prior.std)
    for distance in DISTANCES:
        theta = completed_parameters(of, at.base, at.base.K @ prior.theta, prior, distance)
        np.testing.assert_allclose(theta / of.scale, x, atol=2e-3)


def test_infeasible_base_parameters_are_not_reconstructed() -> None:
    estimate = identify(Reconstruction(), problem("z1", 0.3))
    assert estimate.status == "failed"
    assert "physically consistent bodies" in estimate.reason


def test_methods_that_need_a_prior_fail_without_one() -> None:
    at = replace(problem("ur5"), prior=None)
    for method in (LMIEuclidean(), LMIPullback(), Entropic(), LogCholesky(), Reconstruction()):
        estimate = identify(method, at)
        assert estimate.status == "failed"
        assert "prior" in estimate.reason
    assert identify(LMI(), at).status == "ok"


def test_a_motion_of_two_samples_has_a_feasible_fit() -> None:
    at = first_samples(problem("ur5"), 2)
    assert identify(WLS(), at).status == "failed"
    for method in METHODS[:4]:  # log-Cholesky creeps along the valley of so few samples
        theta = theta_of(identify(method, at))
        assert feasible_margins(theta[feasible_set_of(at).indices]).min() >= 0


@pytest.mark.parametrize("robot", ["ur5", "random:17"])
def test_cvxpy_finds_the_same_fit_and_takes_longer(robot: str) -> None:
    cp = pytest.importorskip("cvxpy", reason="the oracle of feasible fits is not installed")
    at = problem(robot)
    of = feasible_set_of(at)
    mine = theta_of(LMI().solve(at))
    rows = scaled_coordinates(of, at, start_of(of, at.prior))
    inverse = np.linalg.inv(rows.T)
    inverse[rows.rank :] *= np.sqrt(WEAK)
    start = time.perf_counter()
    x = cp.Variable(len(mine))
    constraints = [x[i] >= 0 for i in of.nonnegative]
    from sysid_bench.identification.feasibility.feasible_set import BASIS

    for place in of.indices:
        J = sum(x[int(i)] * E for i, E in zip(place, BASIS, strict=True))
        constraints.append(J - 1e-7 * cp.trace(J) * np.eye(4) >> 0)
    fit = cp.Minimize(cp.sum_squares(inverse @ (x - rows.origin)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # "may be inaccurate", it says
        cp.Problem(fit, constraints).solve(solver="CLARABEL")
    theirs = time.perf_counter() - start
    ours = []
    for _ in range(5):
        start = time.perf_counter()
        LMI().solve(at)
        ours.append(time.perf_counter() - start)

    def cost(x: Array) -> float:
        return float(np.sum((inverse @ (x - rows.origin)) ** 2))

    assert cost(mine / of.scale) == pytest.approx(cost(x.value), rel=1e-3, abs=1e-3)
    assert theirs > 5 * min(ours)
