"""Laws of criteria: what they are by definition, and their slopes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_bench.errors import UsageError
from sysid_bench.excitation.information import CRITERIA, Criterion, criterion_weights
from sysid_bench.types import Array


def rows_of(seed: int, r: int = 4, m: int = 9) -> Array:
    return np.asarray(
        np.random.default_rng(seed).normal(size=(m, r)) * np.array([1.0, 3.0, 0.2, 1.0])[:r]
    )


def criterion(weights: dict[str, float], seed: int, known: int) -> Criterion:
    rng = np.random.default_rng(seed + 1000)
    return Criterion(weights, rng.normal(size=(known, 4)), np.linalg.inv(rng.normal(size=(4, 4))))


def by_definition(name: str, W: Array, whiten: Array) -> float:
    information = W.T @ W
    inverse = np.linalg.inv(information)
    return float(
        {
            "cond": np.log(np.linalg.cond(W)),
            "cond-unit": np.log(np.linalg.cond(W / np.linalg.norm(W, axis=0))),
            "D": -np.log(np.linalg.det(information)) / W.shape[1],
            "A": np.log(np.trace(inverse)),
            "E": -np.log(np.linalg.eigvalsh(information)[0]),
            "predict": np.log(np.trace(np.linalg.inv(whiten @ whiten.T) @ inverse)),
        }[name]
    )


@pytest.mark.parametrize("name", CRITERIA)
@pytest.mark.parametrize("known", [0, 3])
@given(seed=st.integers(0, 999))
@settings(max_examples=15)
def test_a_criterion_is_its_definition(name: str, known: int, seed: int) -> None:
    asked, W = criterion({name: 1.0}, seed, known), rows_of(seed)
    together = np.concatenate([asked.known, W])
    np.testing.assert_allclose(
        asked.value(W), by_definition(name, together, asked.whiten), rtol=1e-6, atol=1e-8
    )


@pytest.mark.parametrize("weights", [*({name: 1.0} for name in CRITERIA), {"D": 1.0, "cond": 0.3}])
@pytest.mark.parametrize("known", [0, 3])
@given(seed=st.integers(0, 999))
@settings(max_examples=10, deadline=None)
def test_the_slope_is_the_difference(weights: dict[str, float], known: int, seed: int) -> None:
    asked, W = criterion(weights, seed, known), rows_of(seed)
    slope, step = asked.gradient(W), 1e-6
    for i, j in np.ndindex(*W.shape):
        up, down = W.copy(), W.copy()
        up[i, j] += step
        down[i, j] -= step
        difference = (asked.value(up) - asked.value(down)) / (2 * step)
        assert abs(slope[i, j] - difference) < 1e-4 * np.abs(slope).max() + 1e-7


@given(seed=st.integers(0, 999), name=st.sampled_from(["D", "A", "E", "predict"]))
@settings(max_examples=30)
def test_more_rows_never_excite_less(seed: int, name: str) -> None:
    asked, W = criterion({name: 1.0}, seed, 0), rows_of(seed)
    more = np.concatenate([W, rows_of(seed + 1)])
    assert asked.value(more) <= asked.value(W)


def test_rows_that_miss_a_parameter_are_infinitely_bad() -> None:
    W = rows_of(0)
    W[:, 2] = 0.0
    for name in CRITERIA:
        assert criterion({name: 1.0}, 0, 0).value(W) == np.inf
        assert criterion({name: 1.0}, 0, 0).value(W[:3]) == np.inf


@pytest.mark.parametrize("bad", ["C", {}, {"D": 0.0}, {"D": "much"}, {"D": True}, {"dee": 1.0}])
def test_other_objectives_are_refused_in_words(bad: object) -> None:
    with pytest.raises(UsageError):
        criterion_weights(bad)  # type: ignore[arg-type]
