"""Feasible fits of trees with joint terms: their time, and that of cvxpy with the same solver.

cvxpy builds the problem anew each time, as a user of it would for each fit; the base coordinates
that both work in are made before.
"""

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sysid_bench.identification.estimators.feasible import LMI, Entropic
from sysid_bench.identification.feasibility.feasible_set import (
    BASIS,
    feasible_set_of,
    scaled_coordinates,
    start_of,
)
from sysid_bench.types import Problem
from tests.experiments.experiment_world import ready

Compare = Callable[..., dict[str, float]]
Line = Callable[..., None]


def tree(links: int, branches: int) -> str:
    """Chains of hinged links side by side, every body plausible and none like another."""
    rng = np.random.default_rng(links)
    lengths = np.full(branches, links // branches)
    lengths[: links % branches] += 1
    return (
        f"<mujoco><worldbody>{''.join(_chain(int(n), rng) for n in lengths)}</worldbody></mujoco>"
    )


def _chain(links: int, rng: np.random.Generator) -> str:
    opened = ""
    for _ in range(links):
        axis = np.eye(3)[rng.integers(3)] + 0.1 * rng.normal(size=3)
        place, com = 0.25 * rng.normal(size=3), 0.05 * rng.normal(size=3)
        inertia = 0.02 + 0.01 * rng.uniform(size=3)
        numbers = [" ".join(map(repr, x.tolist())) for x in (place, axis, com, inertia)]
        opened += (
            f'<body pos="{numbers[0]}">'
            f'<joint axis="{numbers[1]}" damping="0.3" frictionloss="0.2"/>'
            f'<inertial pos="{numbers[2]}" mass="{rng.uniform(1, 4)!r}" '
            f'diaginertia="{numbers[3]}"/>'
        )
    return opened + "</body>" * links


def problem_of(links: int, branches: int, folder: Path) -> Problem:
    """1 % of torque noise; friction of every joint unknown too."""
    file = folder / f"tree{links}.xml"
    file.write_text(tree(links, branches))
    terms = ("viscous", "coulomb")
    return ready(robot=str(file), terms=terms, noise={"tau_relative": 0.01}).problem


def by_cvxpy(problem: Problem) -> Callable[[], None]:
    """The fit of `lmi`, as it is given to cvxpy."""
    cp = pytest.importorskip("cvxpy", reason="cvxpy, the peer of feasible fits, is not installed")
    of = feasible_set_of(problem)
    rows = scaled_coordinates(of, problem, start_of(of, problem.prior))
    seen = np.linalg.inv(rows.T)[: rows.rank]

    def solve() -> None:
        x = cp.Variable(len(problem.parameters))
        constraints = [x[i] >= 0 for i in of.nonnegative]
        for place in of.indices:
            J = sum(x[int(i)] * E for i, E in zip(place, BASIS, strict=True))
            constraints.append(J - 1e-7 * cp.trace(J) * np.eye(4) >> 0)
        fit = cp.Minimize(cp.sum_squares(seen @ (x - rows.origin)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # "may be inaccurate", it says
            cp.Problem(fit, constraints).solve(solver="CLARABEL")

    return solve


@pytest.mark.parametrize(("links", "branches"), [(7, 1), (33, 5)])
def test_feasible_fits(
    links: int, branches: int, compare: Compare, line: Line, tmp_path: Path
) -> None:
    problem = problem_of(links, branches, tmp_path)
    both = {"lmi": lambda: LMI().solve(problem), "entropic": lambda: Entropic().solve(problem)}
    seconds = compare(both, 9)
    targets = {"lmi": (10.0, 5.0), "entropic": (3.0, 1.5)}
    for name, spent in seconds.items():
        must, aim = targets[name] if links == 7 else (100.0, 50.0)
        line(f"{name}, {links} links", 1e3 * spent, must, aim, unit="ms")


@pytest.mark.parametrize(("links", "branches"), [(7, 1), (33, 5)])
def test_cvxpy_takes_longer(
    links: int, branches: int, compare: Compare, line: Line, tmp_path: Path
) -> None:
    problem = problem_of(links, branches, tmp_path)
    seconds = compare({"lmi": lambda: LMI().solve(problem), "cvxpy": by_cvxpy(problem)}, 3)
    line(f"cvxpy / lmi, {links} links", seconds["cvxpy"] / seconds["lmi"], 5.0, least=True)
