"""Fits of many samples in few passes are the fixed points of reweighted least squares."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from sysid_bench.identifiability.base_map import structural_base
from sysid_bench.identification.estimators.robust import IRLS, ArGls, Huber, Tukey
from sysid_bench.identification.linear import refined_fit, reweighted_rows
from sysid_bench.identification.linear.reweighted_rows import streamed_rows
from sysid_bench.regressors import block_qr
from sysid_bench.regressors.block_qr import MotionBlocks, motion_factors
from sysid_bench.regressors.regression import regression
from sysid_bench.types import Array, Problem, SparseBlocks
from tests.experiments.experiment_world import ready
from tests.identification.test_least_squares import beta_of, problem_of
from tests.robots import named_robot, states

SAMPLES = 8_000
METHODS: dict[str, tuple[Any, float]] = {
    # With the RMS distance that is left, in standard deviations.
    "huber": (Huber(), refined_fit.NEAR),
    "tukey": (Tukey(), refined_fit.NEAR),
    "ar": (ArGls(order=2), refined_fit.NEAR),
    # The set that it rejects decides: single samples at its edge have an influence of
    # sqrt(chi-square / N), here 0.05.
    "irls": (IRLS(), 0.25),
}


def noisy(name: str, seed: int, outliers: float = 0.0, samples: int = SAMPLES) -> Problem:
    """Heavy-tailed noise, coloured in time, of another size on each joint."""
    robot, rng = named_robot(name), np.random.default_rng(seed)
    base = structural_base(robot, robot.inertial_columns)
    columns, motion = regression(robot, base.names), states(robot, samples, seed)
    tau = columns.torque(motion, rng.normal(size=base.rank))
    noise = rng.standard_t(3, size=tau.shape) + np.where(rng.random(tau.shape) < outliers, 9.0, 0.0)
    noise[1:] += 0.5 * noise[:-1]
    tau += np.linspace(0.02, 0.3, robot.nv) * noise
    blocks = MotionBlocks(columns, motion, tau, tuple(range(robot.nv)))
    factors = motion_factors(columns, motion, tau)
    return Problem(base.names, base, robot.rows, factors, (), blocks, samples)


def keep_few(problem: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep a part of at most a sixth of the samples."""
    size = 8 * problem.samples * len(problem.rows) * problem.base.rank
    monkeypatch.setattr(reweighted_rows, "KEPT", size / 3)


@pytest.mark.parametrize(
    ("name", "seed", "outliers"),
    [
        ("scara", 1, 0.1),
        ("scara", 2, 0.0),
        ("ur5", 2, 0.02),
        *(pytest.param("xarm7", k, 0.02 * k, marks=pytest.mark.long) for k in range(5)),
        pytest.param("panda", 6, 0.0, marks=pytest.mark.long),
        pytest.param("z1", 7, 0.05, marks=pytest.mark.long),
    ],
)
@pytest.mark.parametrize("method", METHODS)
def test_few_passes_have_the_fixed_point_of_many(
    method: str, name: str, seed: int, outliers: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimator, left = METHODS[method]
    problem = noisy(name, seed, outliers)
    monkeypatch.setattr(reweighted_rows, "KEPT", 1e12)
    # Scales of the last iteration, not those of the tenth.
    monkeypatch.setattr(reweighted_rows, "HOLD_AFTER", 50)
    one = estimator.solve(problem)
    used: list[Any] = []
    find = refined_fit.part_of
    keep_few(problem, monkeypatch)

    def part_of(*given: Any) -> Any:
        used.append(find(*given))
        return used[-1]

    monkeypatch.setattr(refined_fit, "part_of", part_of)
    other = estimator.solve(problem)
    assert one.converged
    assert other.converged
    assert used[0] is not None
    assert used[0].problem.samples < 0.3 * SAMPLES
    away = deviations(beta_of(other) - beta_of(one), one.covariance)
    assert away < 2 * left
    # Of a part of the samples, where it is not a sandwich of sums over all.
    stds = [np.sqrt(np.diag(np.asarray(e.covariance))) for e in (one, other)]
    np.testing.assert_allclose(stds[1], stds[0], rtol=0.15)


def deviations(away: Array, covariance: Array | None) -> float:
    """RMS of a difference (r,) in standard deviations of a covariance (r, r)."""
    assert covariance is not None
    return float(np.sqrt(away @ np.linalg.solve(covariance, away) / len(away)))


def test_a_part_that_lacks_what_a_burst_excites_is_not_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = noisy("scara", 0)
    keep_few(problem, monkeypatch)
    assert refined_fit.part_of(streamed_rows(problem)[0]) is not None
    Y, b = (np.concatenate(x) for x in zip(*problem.blocks(), strict=True))
    Y[:, :, 0] *= 1e-3
    Y[5, :, 0] *= 1e6
    assert refined_fit.part_of(streamed_rows(problem_of(Y, b))[0]) is None


PLACES: list[dict[str, Any]] = [
    {"robot": "ur5"},
    {"robot": "dvrk_psm"},  # coupled joints
    {"robot": "tx40", "terms": ("viscous", "coulomb", "offset")},
    {"robot": "z1", "payload": "sphere-1kg", "task": "terminal"},  # a row of all
    {"robot": "solo12", "task": "wrench", "sensor": "FL_UPPER_LEG"},
]


@pytest.mark.parametrize("place", PLACES, ids=str)
@pytest.mark.parametrize("overlap", [0, 3])
def test_blocks_without_zeros_have_the_same_products(
    place: dict[str, Any], overlap: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = ready(**place, noise={"tau_relative": 0.02}).problem
    assert isinstance(problem.blocks, SparseBlocks)
    monkeypatch.setattr(reweighted_rows, "KEPT", 0.0)
    monkeypatch.setattr(block_qr, "SHORT", 37)
    rows, beta = streamed_rows(problem)
    W, b = (np.concatenate(x) for x in zip(*problem.blocks(), strict=True))
    v = np.random.default_rng(0).normal(size=b.shape)
    total, residuals, dense = np.zeros_like(beta), [], []
    for block in rows.products(overlap):
        skip = 0 if block.start == 0 else overlap
        e = block.residual(beta)
        residuals.append(e[skip:])
        dense.append(block.dense(np.arange(skip, len(e))))
        weights = v[block.start : block.start + len(e)].copy()
        weights[:skip] = 0.0
        total += block.transposed(weights)
    size = np.abs(b).max()
    np.testing.assert_allclose(np.concatenate(dense), W, atol=1e-12 * np.abs(W).max())
    np.testing.assert_allclose(np.concatenate(residuals), b - W @ beta, atol=1e-10 * size)
    expected = v.ravel() @ W.reshape(-1, len(beta))
    np.testing.assert_allclose(total, expected, atol=1e-10 * np.abs(expected).max())


MEMORY = """
import resource, sys
import numpy as np
from tests.identification.test_refined_fits import METHODS, noisy

problem = noisy("scara", 0, samples=int(sys.argv[1]))
METHODS[sys.argv[2]][0].solve(noisy("scara", 0, samples=200_000))  # imports, and what is kept
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
assert METHODS[sys.argv[2]][0].solve(problem).converged
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)
"""


@pytest.mark.long
@pytest.mark.parametrize("method", METHODS)
def test_memory_does_not_grow_with_the_samples(method: str) -> None:
    """Beyond a fit of 200,000, a million samples take a flag each, and no rows (288 MB)."""
    command = [sys.executable, "-c", MEMORY, "1000000", method]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert float(done.stdout) < 10.0
