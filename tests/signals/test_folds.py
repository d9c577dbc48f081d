"""Parts of a motion: a repeated one is cut along its period, so that nothing left out is seen."""

import numpy as np
import pytest

from sysid_bench.signals.spectrum import repetition_period, time_fold
from sysid_bench.types import Array, Trajectory


def motion(seed: int, N: int = 3000, period: int | None = 700) -> Array:
    rng = np.random.default_rng(seed)
    k = np.arange(N)
    q = np.zeros((N, 3))
    for j in range(3):
        for harmonic in range(1, 5):
            speed = 2 * np.pi * harmonic / period if period else rng.uniform(0.003, 0.03)
            q[:, j] += rng.normal() * np.sin(speed * k + rng.uniform(0, 6))
    return q + 1e-3 * rng.normal(size=q.shape)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("period", [400, 700, 1296])
def test_a_period_is_found(seed: int, period: int) -> None:
    found = repetition_period(motion(seed, period=period))
    assert found is not None
    assert found % period in (0, 1, period - 1)


@pytest.mark.parametrize("seed", range(5))
def test_a_motion_that_does_not_repeat_has_none(seed: int) -> None:
    q = motion(seed, period=None)
    assert repetition_period(q) is None
    labels, words = time_fold(Trajectory(np.arange(3000.0), q, q, q), 5)
    assert words == "5 stretches of time"
    assert (np.diff(labels) >= 0).all()


@pytest.mark.parametrize("seed", range(3))
def test_what_is_left_out_is_not_seen_at_another_time(seed: int) -> None:
    q = motion(seed)
    labels, words = time_fold(Trajectory(np.arange(3000.0), q, q, q), 5)
    assert "period" in words
    assert set(labels.tolist()) == set(range(5))
    middle = np.flatnonzero(labels == 2)[50:-50:40]
    others = q[labels != 2]
    again = [np.abs(others - q[k]).max(axis=1).min() for k in middle]
    assert np.median(again) > 0.02  # of positions of order one
    assert repetition_period(np.zeros((100, 2))) is None
