"""Binding constraints: found where a fit lies on them, and costly by what they add to its error."""

from dataclasses import replace

import numpy as np
import pytest

from sysid_bench.identification.estimators.feasible import LMI
from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.identification.feasibility.lmi_fit import binding_constraints, problem_without
from sysid_bench.types import Problem
from tests.identification.test_feasible_fits import objective, problem

ROBOTS = ("ur5", "scara", "panda")


def with_negative_friction(at: Problem, row: int) -> tuple[Problem, str]:
    """The problem, and a viscous friction that drives its joint."""
    name = f"{at.rows[row]}.fv"
    column = at.base.names.index(name)
    factors = []
    for factor in at.factors:
        R = factor.R.copy()
        here = np.flatnonzero(factor.columns == column)
        if len(here):
            R[:, -1] -= 5.0 * R[:, here[0]]
        factors.append(replace(factor, R=R))
    return replace(at, factors=tuple(factors)), name


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("row", [0, 1, -1])
def test_the_sign_of_a_friction_binds_and_is_relaxed(name: str, row: int) -> None:
    at, term = with_negative_friction(problem(name, 0.02), row)
    theta = LMI().solve(at).theta
    assert theta is not None
    found = binding_constraints(at, theta)
    assert term in found
    free = LMI().solve(problem_without(at, term)).theta
    assert free is not None
    assert free[at.parameters.index(term)] < -0.1
    assert objective(feasible_set_of(at), at, free) < objective(feasible_set_of(at), at, theta)


@pytest.mark.parametrize("name", ROBOTS)
def test_bodies_alone_leave_the_signs_of_all_terms_free(name: str) -> None:
    at, term = with_negative_friction(problem(name, 0.02), 0)
    alone = replace(at, signed=())
    assert len(feasible_set_of(alone).nonnegative) == 0
    theta = LMI().solve(alone).theta
    assert theta is not None
    assert theta[at.parameters.index(term)] < -0.1
    relative = feasible_set_of(alone).relative_margins(theta / feasible_set_of(alone).scale)
    assert relative.min() >= 0
    assert set(binding_constraints(alone, theta)) <= {body.name for body in at.bodies}


@pytest.mark.parametrize("name", ROBOTS)
def test_a_body_whose_constraint_binds_is_relaxed(name: str) -> None:
    at = problem(name, 0.3)
    theta = LMI().solve(at).theta
    assert theta is not None
    bodies = [name for name in binding_constraints(at, theta) if "." not in name]
    for body in bodies[:2]:
        free = problem_without(at, body)
        assert body not in {one.name for one in free.bodies}
        other = LMI().solve(free).theta
        assert other is not None
        assert objective(feasible_set_of(at), at, other) <= objective(
            feasible_set_of(at), at, theta
        ) * (1 + 1e-6)
