"""Simulatable parameters: physically consistent, and with the given beta where that is feasible."""

from dataclasses import replace

import numpy as np
import pytest

from sysid_bench.experiments.simulated.problem import known_model
from sysid_bench.identification.feasibility.simulatable import simulatable_set
from sysid_bench.identification.linear.least_squares import stacked_factor
from sysid_bench.simulation.candidate import plant_of_model
from sysid_bench.spatial import pseudo_inertia
from sysid_bench.types import Array, Problem
from tests.experiments.experiment_world import RICH, SMOOTH, ready_once

ROBOTS = ("ur5", "tx40", SMOOTH, "random:1")


def metric(problem: Problem) -> Array:
    return stacked_factor(problem)[:-1, :-1]


def exists(problem: Problem, theta: Array) -> bool:
    places = {name: i for i, name in enumerate(problem.parameters)}
    J = pseudo_inertia(np.array([theta[[places[c] for c in b.columns]] for b in problem.bodies]))
    terms = [theta[i] for name, i in places.items() if name.endswith((".fv", ".fc", ".Ia"))]
    diagonal = np.diagonal(J, axis1=1, axis2=2)
    if not (diagonal > 0).all():
        return False
    # A congruence keeps definiteness. Without it, second moments of 1e-8 beside a mass of 10 are
    # below the rounding of the eigenvalues, whose last bits depend on the processor.
    scale = 1.0 / np.sqrt(diagonal)
    margins = np.linalg.eigvalsh(scale[:, :, None] * J * scale[:, None, :])[:, 0]
    return bool((margins > 0).all()) and all(x > 0 for x in terms)


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_feasible_beta_is_reproduced(robot: str, given: bool) -> None:
    made = ready_once(robot)
    problem = made.problem if given else replace(made.problem, prior=None)
    K, prior = problem.base.K, made.problem.prior
    assert prior is not None
    beta = K @ (
        0.5 * (prior.theta + simulatable_set(made.problem).centre)
    )  # of a robot that exists
    theta = simulatable_set(problem).nearest(beta, metric(problem))
    assert exists(problem, theta)
    np.testing.assert_allclose(K @ theta, beta, atol=1e-9 * np.abs(beta).max())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("robot", ROBOTS)
def test_any_beta_gives_simulatable_parameters(robot: str, seed: int) -> None:
    made = ready_once(robot)
    problem = made.problem
    rng = np.random.default_rng(seed)
    beta = problem.base.K @ made.source.truth.theta
    wild = beta * rng.normal(size=len(beta)) * 3
    theta = simulatable_set(problem).nearest(wild, metric(problem))
    assert exists(problem, theta)
    assert (
        plant_of_model(known_model(made.robot, made.source.task), theta).contact_free_model.nv
        == made.robot.nv
    )


@pytest.mark.parametrize("robot", ROBOTS)
def test_an_infeasible_beta_is_projected(robot: str) -> None:
    """Nearer than other robots that exist: the prior, the centre of no prior, the truth."""
    made = ready_once(robot)
    problem, R = made.problem, metric(made.problem)
    K, truth = problem.base.K, made.source.truth.theta
    beta = K @ truth
    step = np.random.default_rng(1).normal(size=len(beta))
    wild = beta + 0.5 * np.linalg.norm(R @ beta) / np.linalg.norm(R @ step) * step
    simulatable = simulatable_set(problem)
    found = np.linalg.norm(R @ (K @ simulatable.nearest(wild, R) - wild))
    for other in (simulatable.centre, simulatable_set(replace(problem, prior=None)).centre, truth):
        assert found <= np.linalg.norm(R @ (K @ other - wild)) * (1 + 1e-4)


def test_the_right_inverse_changes_beta_alone() -> None:
    problem = ready_once(RICH).problem
    simulatable = simulatable_set(problem)
    lift = simulatable.pseudo_inverse(simulatable.centre)
    K = problem.base.K
    rounding = 1e-11 * (np.abs(K) @ np.abs(lift)).max()
    np.testing.assert_allclose(K @ lift, np.eye(problem.base.rank), atol=rounding)
    for direction in lift.T:
        for sign in (1, -1):
            end = (
                simulatable.centre
                + sign * simulatable.step_limit(simulatable.centre, direction) * direction
            )
            assert np.isfinite(simulatable.divergence(end))


def test_derivatives_of_the_divergence() -> None:
    problem = ready_once(RICH).problem
    first, prior = simulatable_set(replace(problem, prior=None)), simulatable_set(problem)
    theta = 0.5 * (first.centre + prior.centre)
    gradient, hessian = prior.newton_terms(theta)
    for j in range(len(theta)):
        size = 1e-6 * max(abs(theta[j]), 1e-4)
        step = size * (np.arange(len(theta)) == j)
        rise = (prior.divergence(theta + step) - prior.divergence(theta - step)) / (2 * size)
        bend = (prior.newton_terms(theta + step)[0] - prior.newton_terms(theta - step)[0]) / (
            2 * size
        )
        assert rise == pytest.approx(gradient[j], rel=1e-4, abs=1e-4 * np.abs(gradient).max())
        np.testing.assert_allclose(bend, hessian[j], atol=1e-4 * np.abs(hessian[j]).max())
