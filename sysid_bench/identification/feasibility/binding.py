"""Constraints of a feasible fit that bind, and the same problem without one of them."""

from dataclasses import replace
from typing import Final

import numpy as np

from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.types import Array, Problem

NEARLY_SINGULAR: Final = 1e-6
"""Smallest eigenvalue of a pseudo-inertia over its trace below which its constraint binds."""

NEARLY_ZERO: Final = 1e-6
"""Joint term over the largest of the same kind below which its sign constraint binds."""


def binding_constraints(problem: Problem, theta: Array) -> tuple[str, ...]:
    """Return the names of the bodies and joint terms whose constraints bind at theta (p,), the
    estimate of `lmi`."""
    feasible = feasible_set_of(problem)
    singular = feasible.relative_margins(theta / feasible.scale) < NEARLY_SINGULAR
    bodies = [b.name for b, binds in zip(problem.bodies, singular, strict=True) if binds]
    return (*bodies, *_zero_terms(problem, theta))


def _zero_terms(problem: Problem, theta: Array) -> list[str]:
    """Joint terms that are zero beside the largest of their kind."""
    signed = feasible_set_of(problem).nonnegative
    kinds = np.array([problem.parameters[i].rpartition(".")[2] for i in signed])
    values = np.abs(theta[signed])
    largest = np.array([values[kinds == kind].max() for kind in kinds])
    at_zero = values <= NEARLY_ZERO * largest
    return [problem.parameters[i] for i, zero in zip(signed, at_zero, strict=True) if zero]


def problem_without(problem: Problem, *constraints: str) -> Problem:
    """Return the problem without the constraints on these bodies and joint terms."""
    kept = tuple(body for body in problem.bodies if body.name not in constraints)
    signed = tuple(name for name in _signed(problem) if name not in constraints)
    return replace(problem, bodies=kept, signed=signed)


def _signed(problem: Problem) -> tuple[str, ...]:
    """Names of the joint terms that must not be negative."""
    return tuple(problem.parameters[i] for i in feasible_set_of(problem).nonnegative)
