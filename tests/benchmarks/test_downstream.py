"""What follows the regressor: factors row by row against LAPACK on stacked rows, and streams."""

import resource
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from scipy.linalg import lapack, solve_triangular

from sysid_bench.identifiability.base_map import structural_base
from sysid_bench.identification.estimators.robust import IRLS, ArGls, Huber, Tukey
from sysid_bench.identification.linear.least_squares import scaled_fit
from sysid_bench.numerics import qr_factor
from sysid_bench.regressors.block_qr import MotionBlocks, factors_of_motions, motion_factors
from sysid_bench.regressors.kernel_c import select_kernel
from sysid_bench.regressors.regression import Regression, regression
from sysid_bench.types import Array, Factor, Problem, Trajectory
from tests.robots import named_robot, states

Compare = Callable[..., dict[str, float]]
Line = Callable[..., None]


class Subject:
    """The base regressor of an arm."""

    def __init__(self, name: str, samples: int = 10_000) -> None:
        self.robot = named_robot(name)
        self.base = structural_base(self.robot, self.robot.inertial_columns)
        self.columns: Regression = regression(self.robot, self.base.names)
        self.motion: Trajectory = states(self.robot, samples)
        self.b = np.random.default_rng(0).normal(size=self.motion.v.shape)


@pytest.mark.parametrize("name", ["xarm7", "ur5", "panda"])
def test_kernel_and_factors_against_a_dense_factorisation(
    name: str, compare: Compare, line: Line
) -> None:
    arm = Subject(name)
    W = arm.columns.dense(arm.motion).Y.reshape(-1, arm.base.rank)
    stack = np.asfortranarray(np.column_stack([W, arm.b.ravel()]))
    again = np.empty_like(stack, order="F")

    def dense() -> None:
        lapack.dgeqrf(again, lwork=64 * stack.shape[1], overwrite_a=1)

    seconds = compare(
        {
            "copy": lambda: np.copyto(again, stack),
            "dense": dense,
            "fold": lambda: motion_factors(arm.columns, arm.motion, arm.b),
        },
        5,
    )
    must = (1.0, 0.7) if name == "xarm7" else ()
    line(f"kernel + R per joint / LAPACK's QR of the rows alone, {name}",
         seconds["fold"] / seconds["dense"], *must)  # fmt: skip


def solution(factors: tuple[Factor, ...], r: int) -> Array:
    """beta of all rows' factors."""
    parts = []
    for factor in factors:
        wide = np.zeros((len(factor.R), r + 1))
        wide[:, [*factor.columns, r]] = factor.R
        parts.append(wide)
    R = qr_factor(parts)
    return solve_triangular(R[:r, :r], R[:r, r])


def test_ten_million_samples(benchmark: Any, line: Line) -> None:
    """65,536 different samples again and again: memory does not grow, theta is exact."""
    arm = Subject("xarm7", 65_536)
    beta = np.random.default_rng(1).normal(size=arm.base.rank)
    tau = arm.columns.torque(arm.motion, beta)
    passes = 153

    def stream() -> Iterator[tuple[Trajectory, Array]]:
        for _ in range(passes):
            yield arm.motion, tau

    factors_of_motions(arm.columns, [(arm.motion, tau)])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    factors = benchmark.pedantic(lambda: factors_of_motions(arm.columns, stream()), rounds=1)
    growth = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    error = np.linalg.norm(solution(factors, arm.base.rank) - beta) / np.linalg.norm(beta)
    assert factors[0].samples == passes * 65_536
    assert growth < 50
    assert error < 1e-11
    line("memory growth over 10 million streamed samples, xarm7", growth, 50, 50, unit="MB")
    line("theta error after 10 million streamed samples, xarm7", error, 1e-11, 1e-11, unit="")


@pytest.mark.parametrize(
    "method", [Huber(), Tukey(), IRLS(), ArGls()], ids=lambda m: type(m).__name__
)
def test_robust_fits_of_a_stream(method: Any, line: Line) -> None:
    """Samples that are made again in every pass: memory stays, time is linear."""
    seconds: dict[int, float] = {}
    for samples in (100_000, 1_000_000):
        arm = Subject("xarm7", samples)
        rng = np.random.default_rng(2)
        tau = arm.columns.torque(arm.motion, rng.normal(size=arm.base.rank))
        tau += 0.1 * rng.standard_t(3, size=tau.shape)
        start = time.process_time()
        factors = motion_factors(arm.columns, arm.motion, tau)
        problem = Problem(
            arm.columns.columns, arm.base, arm.robot.rows, factors, (),
            MotionBlocks(arm.columns, arm.motion, tau, tuple(range(arm.robot.nv))), samples,
        )  # fmt: skip
        scaled_fit(problem)
        wls = time.process_time() - start
        before, start = peak_memory(), time.process_time()
        estimate = method.solve(problem)
        seconds[samples] = time.process_time() - start
        assert estimate.converged
    few, many = seconds.values()
    growth, name = peak_memory() - before, f"{type(method).__name__}, xarm7"
    line(f"robust fit / wls with its factors, 1,000,000 samples, {name}", many / wls, 10)
    exponent = np.log10(many / few)
    line(f"exponent of time over samples, 100,000 to 1,000,000, {name}", exponent, 1.1, unit="")
    line(f"memory beyond that of wls, 1,000,000 samples, {name}", growth, 50, unit="MB")


def peak_memory() -> float:
    """MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def test_time_per_sample_is_flat(compare: Compare, line: Line) -> None:
    """A thousand to ten million samples, in parts of at most a million."""
    arm = Subject("xarm7", 1_000_000)

    def of(samples: int) -> Callable[[], Any]:
        m, part = arm.motion, min(samples, len(arm.motion))
        cut = Trajectory(m.t[:part], m.q[:part], m.v[:part], m.a[:part])
        times = max(samples // part, 1)
        repeats = max(100_000 // samples, 1)
        return lambda: [
            factors_of_motions(arm.columns, [(cut, arm.b[:part])] * times) for _ in range(repeats)
        ]

    counts = [10**k for k in range(3, 8 if select_kernel().library else 7)]
    seconds = compare({str(n): of(n) for n in counts}, 3)
    each = {n: seconds[str(n)] / max(n, 100_000) for n in counts}
    for n in counts[1:]:
        line(f"time per sample, {n:,} / 1,000 samples, xarm7", each[n] / each[1000], 1.2, 1.2)


def test_growth_with_joints(compare: Compare, line: Line) -> None:
    """Work grows with the pairs of a joint and a link that it moves."""
    names = ("ur5", "xarm7", "panda", "solo12", "icub")
    subjects = {name: named_robot(name) for name in names}
    functions, pairs = {}, {}
    for name, robot in subjects.items():
        columns = regression(robot, robot.inertial_columns)
        motion = states(robot, 2000)
        functions[name] = lambda c=columns, m=motion: [None for _ in c.blocks(m)]
        pairs[name] = sum(len(robot.tree.links[max(c, 0)].dofs) for c in robot.tree.carrier)
    seconds = compare(functions, 5)
    for name in names[1:]:
        ratio = seconds[name] / seconds["ur5"] / (pairs[name] / pairs["ur5"])
        line(f"time per pair of joint and body, {name} / ur5", ratio)
