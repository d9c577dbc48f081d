"""Lost samples of recordings without time stamps: counted in motion, and never where none is."""

import numpy as np
import pytest

from sysid_bench.signals.log_checks import check_samples
from sysid_bench.types import Array


def motion(seed: int, t: Array, noise: float = 1e-6) -> Array:
    """Positions (N, 4) in rad: five harmonics of 0.1 Hz each."""
    rng = np.random.default_rng(seed)
    w = 2 * np.pi * 0.1 * np.arange(1, 6)
    A, B = rng.normal(size=(2, 5, 4)) / np.arange(1, 6)[:, None]
    q = np.sin(np.outer(t, w)) @ A + np.cos(np.outer(t, w)) @ B
    return np.asarray(q + noise * rng.normal(size=q.shape))


def lost(q: Array) -> int:
    return sum(finding.count for finding in check_samples(q))


@pytest.mark.parametrize("rate", [50.0, 200.0, 1000.0])
@pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-5, 1e-4])
@pytest.mark.parametrize("digits", [3, 4, 12])
def test_nothing_is_lost_in_a_whole_recording(rate: float, noise: float, digits: int) -> None:
    t = np.arange(0, 30, 1 / rate)
    for seed in range(3):
        assert lost(np.round(motion(seed, t, noise), digits)) == 0


@pytest.mark.parametrize("rate", [50.0, 100.0, 250.0])
def test_lost_samples_are_counted_in_slow_and_fast_motion(rate: float) -> None:
    t = np.arange(0, 30, 1 / rate)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        at = rng.choice(np.arange(40, len(t) - 40, 20), 25, replace=False)
        gap = len(t) // 3 + np.arange(int(0.2 * rate))  # within which the speed hardly changes
        kept = np.setdiff1d(np.arange(len(t)), [*at, *gap])
        missing = len(t) - len(kept)
        assert 0.9 * missing <= lost(motion(seed, t)[kept]) <= 1.15 * missing


@pytest.mark.parametrize("rate", [50.0, 200.0])
def test_held_samples_and_a_clock_that_jitters_are_not_lost(rate: float) -> None:
    t = np.arange(0, 30, 1 / rate)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        q = motion(seed, t)
        at = rng.choice(np.arange(40, len(t) - 40, 8), len(t) // 25, replace=False)
        q[at] = q[at - 1]
        assert lost(q) == 0
        assert lost(motion(seed, t + 0.25 / rate * rng.uniform(-1, 1, len(t)))) == 0
