"""Plain loops, NumPy and SciPy give the answers of the iterative estimators."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from itertools import chain, repeat
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import toeplitz

from sysid_bench.identification.estimators.linear import WLS
from sysid_bench.identification.estimators.robust import (
    IRLS,
    ArGls,
    Huber,
    Tukey,
    huber_loss,
    tukey_loss,
)
from sysid_bench.identification.linear import reweighted_rows
from sysid_bench.identification.linear.reweighted_rows import m_estimate, streamed_rows
from sysid_bench.types import Array, Problem
from tests.experiments.experiment_world import dense, ready
from tests.identification.test_least_squares import beta_of, problem_of

SAME = 1e-8
PLACES = [("scara", "none", "robot"), ("random:7", "none", "robot"), ("z1", "sphere-1kg", "link")]


@cache
def noisy(place: tuple[str, str, str]) -> Problem:
    robot, payload, task = place
    made = ready(robot=robot, payload=payload, task=task, noise={"tau_relative": 0.02})
    return made.problem


def weighted(W: Array, b: Array, weights: Array) -> Array:
    """Least squares of dense rows (N, rows, r) with weights (N, rows)."""
    root = np.sqrt(weights)
    rows = (W * root[..., None]).reshape(-1, W.shape[2])
    return np.asarray(np.linalg.lstsq(rows, (b * root).ravel())[0])


def agree(W: Array, one: Array, other: Array, share: float = SAME) -> None:
    """Assert that two estimates predict the same torques."""
    assert np.linalg.norm(W @ (one - other)) <= share * np.linalg.norm(W @ other)


def huber_weight(u: Array) -> Array:
    return np.where(np.abs(u) <= 1.345, 1.0, 1.345 / np.maximum(np.abs(u), 1e-300))


def tukey_weight(u: Array) -> Array:
    return np.where(np.abs(u) <= 4.685, (1 - (u / 4.685) ** 2) ** 2, 0.0)


@pytest.mark.parametrize("place", PLACES, ids=str)
@pytest.mark.parametrize("name", ["huber", "tukey"])
def test_m_estimates_are_the_fixed_point_of_reweighted_least_squares(
    name: str, place: tuple[str, str, str]
) -> None:
    problem = noisy(place)
    W, b = dense(problem)
    rows, start = streamed_rows(problem)
    fit, scales = m_estimate(rows, huber_loss(Huber.cut), start, 200)
    weight, beta = huber_weight, start
    if name == "tukey":
        beta, weight = fit.beta, tukey_weight
        fit, _ = m_estimate(rows, tukey_loss(Tukey.cut), fit.beta, 200, scales)
    for _ in range(80):
        beta = weighted(W, b, weight((b - W @ beta) / scales) / scales**2)
    assert fit.converged
    agree(W, fit.beta, beta)


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_irls_is_the_fixed_point_of_least_squares_with_the_residuals_covariance(
    place: tuple[str, str, str],
) -> None:
    problem = noisy(place)
    W, b = dense(problem)
    felt = np.array([len(factor.columns) > 0 for factor in problem.factors])
    W, b = W[:, felt], b[:, felt]
    freedom = len(b) - np.array([np.linalg.matrix_rank(W[:, j]) for j in range(W.shape[1])])
    beta = beta_of(WLS().solve(problem))
    for _ in range(60):
        rest = b - W @ beta
        root = np.linalg.cholesky(
            np.linalg.inv(rest.T @ rest / np.sqrt(np.outer(freedom, freedom)))
        )
        white = (root.T @ W).reshape(-1, W.shape[2])
        beta = np.linalg.lstsq(white, (b @ root).ravel())[0]
    agree(W, beta_of(IRLS(cut=40.0).solve(problem)), beta)


@pytest.mark.parametrize("order", [0, 1, 4])
def test_ar_gls_is_the_fixed_point_of_whitened_least_squares(order: int) -> None:
    rng = np.random.default_rng(order)
    t = np.arange(500) / 100
    W = np.stack([np.sin(t), np.cos(2 * t), np.sin(5 * t), np.ones_like(t)], axis=-1)
    W = np.stack([W, W[:, ::-1]], axis=1) + 0.3 * rng.normal(size=(500, 2, 4))
    noise = np.zeros((500, 2))
    for k in range(1, 500):
        noise[k] = 0.7 * noise[k - 1] + rng.normal(size=2) * [0.1, 0.4]
    b = W @ [1.0, -2.0, 0.5, 3.0] + noise
    estimate = ArGls(order=order).solve(problem_of(W, b))
    assert estimate.converged
    agree(W, beta_of(estimate), ar_by_loop(W, b, order))


def ar_by_loop(W: Array, b: Array, order: int) -> Array:
    """Yule-Walker and least squares in turn, by convolutions of single columns."""
    N, rows, r = W.shape
    beta = np.linalg.lstsq(W.reshape(-1, r), b.ravel())[0]
    for _ in range(100):
        parts, sides = [], []
        for j in range(rows):
            e = b[:, j] - W[:, j] @ beta
            lags = np.correlate(e, e, "full")[N - 1 : N + order]
            taps = np.append(1.0, np.linalg.solve(toeplitz(lags[:-1]), -lags[1:]) if order else [])
            white = np.convolve(e, taps, "valid")
            sigma = np.sqrt((white @ white) / (N - 2 * order - r))
            parts += [np.stack([np.convolve(c, taps, "valid") for c in W[:, j].T], 1) / sigma]
            sides += [np.convolve(b[:, j], taps, "valid") / sigma]
        beta = np.linalg.lstsq(np.concatenate(parts), np.concatenate(sides))[0]
    return np.asarray(beta)


@pytest.mark.parametrize("method", [Huber(), Tukey(), IRLS(), ArGls()], ids=str)
def test_a_limit_of_iterations_gives_the_last_iterate(method: Any) -> None:
    """The estimate of one iteration says that it has not converged, and lies near the other."""
    problem = noisy(PLACES[0])
    W, _ = dense(problem)
    full, cut = method.solve(problem), type(method)(iterations=1).solve(problem)
    assert full.converged
    assert full.iterations is not None
    assert full.iterations > 1
    assert cut.status == "ok"
    assert cut.converged is False
    assert cut.iterations == 1
    assert "limit of 1" in cut.stop
    agree(W, beta_of(cut), beta_of(full), 0.02)


SIZE = (7500, 6, 60)
"""45,000 rows and 60 parameters."""


@pytest.mark.long
@pytest.mark.parametrize("make", [Huber, Tukey, IRLS, ArGls])
def test_many_rows_take_a_few_factorisations_of_time(make: Callable[[], Any]) -> None:
    rng = np.random.default_rng(0)
    W = rng.normal(size=SIZE)
    problem = problem_of(W, W @ rng.normal(size=60) + 0.1 * rng.standard_t(4, size=SIZE[:2]))
    start = time.process_time()
    np.linalg.qr(W.reshape(-1, SIZE[2]), mode="r")
    one = time.process_time()
    estimate = make().solve(problem)
    assert time.process_time() - one < 20 * (one - start)  # measured: 2 to 3
    assert estimate.converged


def in_parts(problem: Problem, sizes: list[int]) -> Problem:
    """The same samples in blocks of other sizes, the last one repeated."""
    W, b = dense(problem)

    def blocks() -> Iterator[tuple[Array, Array]]:
        start = 0
        for size in chain(sizes, repeat(sizes[-1])):
            if start >= len(b):
                return
            yield W[start : start + size], b[start : start + size]
            start += size

    return replace(problem, blocks=blocks)


@pytest.mark.parametrize("method", [Huber(), Tukey(), IRLS(), ArGls()], ids=str)
@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.parametrize("sizes", [[100_000], [97], [1, 2, 1, 50], [3]], ids=str)
def test_the_blocks_of_the_samples_change_nothing(
    method: Any, kept: bool, sizes: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor whether they are kept between passes, also where blocks are shorter than a filter."""
    problem = noisy(PLACES[0])
    W, _ = dense(problem)
    monkeypatch.setattr(reweighted_rows, "KEPT", 40e6 if kept else 0)
    one, other = method.solve(problem), method.solve(in_parts(problem, sizes))
    agree(W, beta_of(other), beta_of(one))
    assert other.iterations == one.iterations
    for mine, theirs in ((other.covariance, one.covariance), (other.stats, one.stats)):
        assert mine == pytest.approx(theirs, rel=1e-6)


@given(
    columns=st.lists(
        st.lists(st.floats(0, 1e300) | st.sampled_from([0.0, 1.0, 5e-324]), min_size=1),
        min_size=1,
        max_size=3,
    ),
    data=st.data(),
)
def test_medians_of_blocks_are_those_of_sorted_columns(
    columns: list[list[float]], data: st.DataObject
) -> None:
    shortest = min(map(len, columns))
    x = np.array([column[:shortest] for column in columns]).T
    used = [data.draw(st.integers(0, shortest + 3)) for _ in columns]
    size = data.draw(st.integers(1, shortest))
    expected = [
        np.median(np.sort(column)[-max(n, 1) :]) for column, n in zip(x.T, used, strict=True)
    ]
    blocks = [x[k : k + size] for k in range(0, shortest, size)]
    assert reweighted_rows.streamed_medians(lambda: blocks, used).tolist() == expected
