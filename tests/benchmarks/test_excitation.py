"""Searches for a motion side by side, with the same CPU time: what 6000 evaluations of the
objective by Pinocchio's Python loop take.

A 7-joint arm, five harmonics of ten seconds; `SYSID_BENCH_DATA` holds its model. Random motions
are drawn in three ways: each joint scaled into its own limits (as `fourier` does), and all joints
by one factor, into the limits or to 0.8 of them, as published starts of such searches are. Which of
the three is called random decides what a design is worth against it.
"""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import Bounds, minimize

from sysid_bench.excitation.design_cost import DesignCost, SearchEnd
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.information import information_model
from sysid_bench.excitation.limits import joint_limits
from sysid_bench.excitation.optimised import Optimised, design_criterion
from sysid_bench.excitation.search import Search
from sysid_bench.identifiability.base_map import structural_base
from sysid_bench.models.load import load_robot
from sysid_bench.types import Array

DATA = os.environ.get("SYSID_BENCH_DATA")
EVALUATIONS = 6000
SEEDS = (0, 1, 2)

pytestmark = pytest.mark.skipif(DATA is None, reason="SYSID_BENCH_DATA is unset")


class Arm:
    """The arm, its limits and its question."""

    def __init__(self, objective: str) -> None:
        self.robot = load_robot(Path(str(DATA)) / "robots" / "kuka_iiwa_14__iiwa14.xml")
        self.base = structural_base(self.robot, self.robot.inertial_columns)
        brief = design_problem(self.robot, 200.0)
        self.brief = replace(
            brief,
            v=np.array([1.71, 1.71, 1.75, 2.27, 2.44, 3.14, 3.14]),
            a=np.full(7, 10.0),
            regress=information_model(self.robot, self.base.names),
        )
        self.made = Optimised(objective)
        self.space = self.made.space(self.brief)
        assert self.brief.regress is not None
        self.asked = self.brief.regress.smooth
        self.criterion = design_criterion(objective, self.asked, self.space, [])

    def search(self) -> Search:
        """A search that keeps the best feasible coefficients, with time stamps."""
        limits = self.made.limits(self.brief, 0.98)
        return Search(DesignCost(self.space, self.asked, self.criterion, limits))

    def by_one_factor(self, rng: np.random.Generator) -> Array:
        """Random coefficients, scaled by one factor into all limits."""
        C = rng.normal(size=(11, 7))
        C[0] *= 0.3
        motion = self.space.motion(C, self.space.curves.grid())
        limits = joint_limits(self.brief, self.space.dofs)
        return np.asarray(C / max(np.abs(limit.use(motion)).max() for limit in limits))

    def pinocchio_seconds(self) -> float:
        """CPU time of one evaluation by Pinocchio's Python loop and a decomposition."""
        pairing, t = self.robot.pairing, self.space.curves.grid()
        model, data = pairing.model, pairing.model.createData()
        C = self.space.random(np.random.default_rng(0), 0.9)
        places = [self.robot.inertial_columns.index(name) - 10 for name in self.base.names]

        def evaluate() -> None:
            m = self.space.motion(C, t)
            Y = np.empty((len(t), 7, 70))
            for k in range(len(t)):
                Y[k] = pin.computeJointTorqueRegressor(model, data, m.q[k], m.v[k], m.a[k])
            assert np.linalg.cond(Y.reshape(-1, 70)[:, places]) > 1

        evaluate()
        start = time.process_time()
        for _ in range(20):
            evaluate()
        return (time.process_time() - start) / 20


def timed(search: Search, work: Callable[[], None], budget: float) -> list[tuple[float, float]]:
    """(CPU seconds, best value) over the course of a search that is stopped at its budget."""
    start, course = time.process_time(), []

    def record(count: int, value: float) -> None:
        course.append((time.process_time() - start, value))
        if course[-1][0] > budget:
            raise SearchEnd

    search.evaluation.progress = record
    with suppress(SearchEnd):
        work()
    return course


def ours(arm: Arm, search: Search, rng: np.random.Generator) -> None:
    draws = arm.made.random_coefficients(arm.space, rng)
    values = [search.evaluation.criterion_value(C) for C in draws]
    (best,) = search.start([draws[int(np.argmin(values))]], arm.made.iterations)
    search.run_from(best, arm.made.iterations)


def by_differences(arm: Arm, search: Search, rng: np.random.Generator) -> None:
    """The same solver, slopes of the objective by finite differences."""
    draws = arm.made.random_coefficients(arm.space, rng)
    C = draws[int(np.argmin([search.evaluation.criterion_value(C) for C in draws]))]
    low, high = arm.space.limits()
    scale = np.tile(arm.brief.v, (11, 1))

    def value(x: Array) -> float:
        return search.evaluation.value(x.reshape(11, 7) * scale)

    for sharpness in (60.0, 240.0):
        constraint: Any = {
            "type": "ineq",
            "fun": lambda x, s=sharpness: (
                1 - search.evaluation.smooth_limits(x.reshape(11, 7) * scale, s)[0]
            ),
            "jac": lambda x, s=sharpness: (
                -search.evaluation.smooth_limits(x.reshape(11, 7) * scale, s)[1] * scale.ravel()
            ),
        }
        found = minimize(
            value, (C / scale).ravel(), method="SLSQP", constraints=[constraint],
            bounds=Bounds((low / scale).ravel(), (high / scale).ravel()),
            options={"maxiter": 150, "ftol": 1e-5},
        )  # fmt: skip
        C = found.x.reshape(11, 7) * scale


def by_evolution(arm: Arm, search: Search, rng: np.random.Generator) -> None:
    """CMA-ES (Hansen 2016) with a penalty on the limits, in its plain form."""
    draws = arm.made.random_coefficients(arm.space, rng)
    C = draws[int(np.argmin([search.evaluation.criterion_value(C) for C in draws]))]
    scale = np.tile(arm.brief.v, (11, 1))
    mean, n, sigma = (C / scale).ravel(), C.size, 0.05
    lam = 4 + int(3 * np.log(n))
    mu = lam // 2
    w = np.log(mu + 0.5) - np.log(np.arange(1, mu + 1))
    w /= w.sum()
    mueff = 1 / (w**2).sum()
    cc, cs = (4 + mueff / n) / (n + 4 + 2 * mueff / n), (mueff + 2) / (n + mueff + 5)
    c1 = 2 / ((n + 1.3) ** 2 + mueff)
    cmu = min(1 - c1, 2 * (mueff - 2 + 1 / mueff) / ((n + 2) ** 2 + mueff))
    damp = 1 + 2 * max(0.0, np.sqrt((mueff - 1) / (n + 1)) - 1) + cs
    pc, ps, cov = np.zeros(n), np.zeros(n), np.eye(n)
    chi = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
    while True:
        values, axes = np.linalg.eigh(cov)
        root = axes * np.sqrt(np.maximum(values, 1e-20))
        steps = rng.normal(size=(lam, n)) @ root.T
        cost = [penalised(search, (mean + sigma * s).reshape(11, 7) * scale) for s in steps]
        best = steps[np.argsort(cost)[:mu]]
        move = w @ best
        mean = mean + sigma * move
        whitened = axes @ ((axes.T @ move) / np.sqrt(np.maximum(values, 1e-20)))
        ps = (1 - cs) * ps + np.sqrt(cs * (2 - cs) * mueff) * whitened
        pc = (1 - cc) * pc + np.sqrt(cc * (2 - cc) * mueff) * move
        cov = (1 - c1 - cmu) * cov + c1 * np.outer(pc, pc) + cmu * (best.T * w) @ best
        sigma *= np.exp((cs / damp) * (np.linalg.norm(ps) / chi - 1))


def penalised(search: Search, C: Array) -> float:
    value = search.evaluation.value(C)
    over = max(float(np.abs(use).max()) for use in search.evaluation.uses) - 1.0
    return value + 100 * max(over, 0.0)


def at_random(arm: Arm, search: Search, rng: np.random.Generator) -> None:
    while True:
        search.evaluation.evaluate(arm.space.random(rng, 0.97))


METHODS = {
    "analytic SLSQP (ours)": ours,
    "finite-difference SLSQP": by_differences,
    "CMA-ES": by_evolution,
    "random search": at_random,
}


def courses(arm: Arm, budget: float) -> Iterator[tuple[str, int, list[tuple[float, float]]]]:
    for name, method in METHODS.items():
        for seed in SEEDS if method is ours else SEEDS[:1]:
            search, rng = arm.search(), np.random.default_rng(seed)
            work = lambda m=method, s=search, r=rng: m(arm, s, r)  # noqa: E731
            yield name, seed, timed(search, work, budget)


@pytest.mark.parametrize("objective", ["cond", "D"])
def test_searches_side_by_side(objective: str) -> None:
    arm = Arm(objective)
    budget = EVALUATIONS * arm.pinocchio_seconds()
    search, rng = arm.search(), np.random.default_rng(99)
    apart = [search.evaluation.criterion_value(arm.space.random(rng, 0.97)) for _ in range(400)]
    one = [search.evaluation.criterion_value(arm.by_one_factor(rng)) for _ in range(400)]
    shown = np.exp if objective == "cond" else (lambda x: -43 * np.asarray(x))
    gentle = [search.evaluation.criterion_value(0.8 * arm.by_one_factor(rng)) for _ in range(400)]
    print(f"\n{objective}: budget {budget:.1f} CPU s ({EVALUATIONS} evaluations of Pinocchio)")
    for words, values in (
        ("each joint scaled", apart),
        ("one factor", one),
        ("one factor, to 0.8 of the limits", gentle),
    ):
        best, middle = shown(min(values)), shown(np.median(values))
        print(f"  400 random motions, {words}: median {middle:.1f}, best {best:.1f}")
    ends: dict[str, list[float]] = {}
    for name, seed, course in courses(arm, budget):
        third = min((v for t, v in course if t <= budget / 3), default=np.inf)
        final = min(v for t, v in course if t <= budget)
        seconds = course[-1][0]
        print(
            f"  {name:<26} seed {seed}: {shown(final):8.2f} in {seconds:5.1f} s; "
            f"after a third {shown(third):8.2f}"
        )
        ends.setdefault(name, []).append(final)
        if name.endswith("(ours)"):
            assert seconds <= budget
            if objective == "cond":
                assert np.exp(third) <= 1.2 * np.exp(final)
                assert np.exp(final) <= np.exp(np.median(gentle)) / 15
            else:
                assert -43 * final >= -43 * min(apart) + 40
    mine = max(ends.pop("analytic SLSQP (ours)"))
    assert all(mine <= min(others) for others in ends.values())
