"""Intervals from the spread between motions, against dense least squares and by simulation."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sysid_bench.evaluation.covariance import (
    ENOUGH_MOTIONS,
    MotionFit,
    motion_fit,
    residual_score,
    standard_errors,
)
from sysid_bench.evaluation.interval_figures import torque_coverage
from sysid_bench.evaluation.intervals import StandardError, held, interval_score, share_interval
from sysid_bench.experiments.processed_rows import pooled
from sysid_bench.identification.estimators.linear import WLS
from sysid_bench.types import Array, Estimate, Problem
from tests.closeness import assert_close
from tests.identification.test_least_squares import problem_of

TRUTH = np.array([1.0, -2.0, 0.5, 3.0])
SAMPLES, REPEATS = 60, 50


def motion(rng: np.random.Generator, misfit: float, samples: int = SAMPLES) -> Problem:
    """Two rows of four parameters along one random motion, with white noise of 0.1 and a torque
    that the model does not contain, which is another one in each motion."""
    phase = rng.uniform(0, 2 * np.pi, size=4)
    t = 2 * np.pi * np.arange(samples)[:, None] / SAMPLES
    base = np.sin(t * np.arange(1, 5) + phase)
    W = np.stack([base, base[:, [1, 0, 3, 2]]], axis=1)
    unknown = misfit * np.sin(2 * t + rng.uniform(0, 2 * np.pi))
    return problem_of(W, W @ TRUTH + unknown + 0.1 * rng.normal(size=(samples, 2)))


def several(count: int, seed: int = 0, misfit: float = 0.0) -> Problem:
    rng = np.random.default_rng(seed)
    return pooled([motion(rng, misfit, SAMPLES + 10 * i) for i in range(count)])


def fits_of(problem: Problem) -> MotionFit:
    fits = motion_fit(problem, fitted(problem)[0])
    assert isinstance(fits, MotionFit)
    return fits


def fitted(problem: Problem) -> tuple[Estimate, Array, Array]:
    """The weighted estimate, its beta (r,) and its sigma (rows,)."""
    estimate = WLS().solve(problem)
    assert estimate.beta is not None
    assert estimate.sigma is not None
    return estimate, estimate.beta, estimate.sigma


def dense_fit(problems: tuple[Problem, ...], sigma: Array) -> Array:
    W = np.concatenate(
        [(Y / sigma[:, None]).reshape(-1, 4) for p in problems for Y, _ in p.blocks()]
    )
    b = np.concatenate([(b / sigma).ravel() for p in problems for _, b in p.blocks()])
    return np.asarray(np.linalg.lstsq(W, b)[0])


def test_pooling_is_stacking() -> None:
    problem = several(6)
    assert problem.samples == sum(one.samples for one in problem.motions) == len(problem.W) // 2
    _, beta, sigma = fitted(problem)
    assert_close(beta, dense_fit(problem.motions, sigma), 1e-10)
    single = problem.motions[0]
    assert pooled([single]) is single


def test_fits_without_a_motion_are_those_of_the_other_samples() -> None:
    problem = several(6, misfit=0.5)
    _, beta, sigma = fitted(problem)
    fits = fits_of(problem)
    for i, left_out in enumerate(problem.motions):
        others = tuple(one for one in problem.motions if one is not left_out)
        expected = dense_fit(others, sigma)
        assert_close(fits.betas[i], expected, 1e-9)
        rows = (left_out.b - left_out.W @ expected).reshape(-1, 2)
        assert_close(fits.errors[i], np.sqrt((rows**2).mean(axis=0)), 1e-9)
    moved = fits.betas - beta
    assert_close(fits.standard_error.covariance, 5 / 6 * moved.T @ moved)
    assert fits.standard_error.freedom == 5


def test_the_order_of_motions_does_not_matter() -> None:
    problem = several(6, misfit=0.5)
    turned = pooled(problem.motions[::-1])
    found = [fits_of(p).standard_error.std for p in (problem, turned)]
    assert_close(found[0], found[1], 1e-9)


@cache
def covered(misfit: float) -> dict[str, float]:
    """The share of intervals that hold the truth, by kind."""
    hits: dict[str, list[float]] = {}
    for seed in range(REPEATS):
        problem = several(ENOUGH_MOTIONS, seed, misfit)
        estimate, beta, _ = fitted(problem)
        for kind, error in standard_errors(problem, estimate).items():
            hits.setdefault(kind, []).append(float(held(error, beta, TRUTH).mean()))
    return {kind: float(np.mean(values)) for kind, values in hits.items()}


def test_five_motions_cover_noise_and_what_differs_between_motions() -> None:
    noise, misfit = covered(0.0), covered(1.0)
    assert min(noise.values()) > 0.88
    assert misfit["motions"] > 0.9
    assert misfit["textbook"] < 0.85
    assert misfit["residuals"] < misfit["motions"] - 0.02


def test_torque_of_other_motions_lies_in_its_prediction_interval() -> None:
    shares = []
    for seed in range(30):
        problem = several(ENOUGH_MOTIONS, seed, 1.0)
        fits = fits_of(problem)
        other = {"other": motion(np.random.default_rng(1000 + seed), 1.0)}
        shares.append(torque_coverage(fits, other))
    assert np.mean(shares) > 0.95
    assert torque_coverage(replace(fits, errors=0 * fits.errors), other).max() == 0.0


@pytest.mark.parametrize("count", [1, 2, 4])
def test_few_motions_give_a_reason_and_no_interval(count: int) -> None:
    problem = several(count)
    estimate, _, _ = fitted(problem)
    reason = motion_fit(problem, estimate)
    assert isinstance(reason, str)
    assert reason.startswith(f"{count} training motion")
    assert "motions" not in standard_errors(problem, estimate)


def test_a_motion_that_cannot_be_left_out_is_named() -> None:
    rng = np.random.default_rng(0)
    poor = [problem_of(one.W.reshape(-1, 2, 4) * [1, 1, 1, 0], one.b.reshape(-1, 2))
            for one in (motion(rng, 0.0) for _ in range(5))]  # fmt: skip
    problem = pooled([*poor[:2], motion(rng, 0.0), *poor[2:]])
    estimate, _, _ = fitted(problem)
    assert motion_fit(problem, estimate) == "motion 3 alone excites some parameter"
    assert "motions" not in standard_errors(problem, estimate)


def test_periods_of_several_motions_do_not_see_their_misfit() -> None:
    found = []
    for misfit in (0.0, 2.0):
        rng = np.random.default_rng(3)
        parts = [replace(motion(rng, misfit, 4 * SAMPLES), period=SAMPLES) for _ in range(5)]
        problem = pooled(parts)
        assert problem.period == SAMPLES
        _, beta, _ = fitted(problem)
        scores = residual_score(problem, beta, np.ones(2))
        made = scores.period_covariance(SAMPLES, [(one.samples, one.period) for one in parts])
        assert made.freedom == 5 * 3
        found.append(made.std)
    np.testing.assert_allclose(found[0], found[1], rtol=0.2)


def test_the_score_of_an_interval_is_its_width_and_forty_times_the_distance() -> None:
    error = StandardError(np.diag([1.0, 4.0]))
    low, high = error.interval(np.zeros(2))
    np.testing.assert_allclose(interval_score(error, np.zeros(2), np.zeros(2)), high - low)
    far = interval_score(error, np.zeros(2), np.array([5.0, -5.0]))
    np.testing.assert_allclose(far, high - low + 40 * (5.0 - high))


@pytest.mark.parametrize(("hits", "count"), [(0, 20), (20, 20), (57, 60)])
def test_intervals_of_shares_have_the_probability_that_they_state(hits: int, count: int) -> None:
    from scipy.special import bdtr, bdtrc

    low, high = share_interval(hits, count)
    assert low <= hits / count <= high
    if hits > 0:
        assert bdtrc(hits - 1, count, low) == pytest.approx(0.025)
    if hits < count:
        assert bdtr(hits, count, high) == pytest.approx(0.025)
