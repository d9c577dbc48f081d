"""The rule by which `make ratios` calls a ratio worse."""

import time

import numpy as np
import pytest

from tests.benchmarks import history, ratios


def draws(truth: float, seed: int, count: int = 30, noise: float = 0.05) -> np.ndarray:
    """Paired ratios of a loaded machine: every tenth pair is interrupted."""
    rng = np.random.default_rng(seed)
    values = truth * np.exp(noise * rng.normal(size=count))
    return values * np.where(rng.random(count) < 0.1, rng.uniform(0.3, 3.0, count), 1.0)


def share(verdict: str, truth: float) -> float:
    found = [ratios.ratio_of(draws(truth, seed)).verdict(1.0) for seed in range(400)]
    return found.count(verdict) / len(found)


def test_what_has_not_changed_is_not_worse_and_what_costs_a_quarter_more_is() -> None:
    assert share("worse", 1.0) == 0.0
    assert share("worse", 1.05) < 0.01
    assert share("worse", 1.25) > 0.99
    assert share("ok", 1.0) > 0.95


def test_noise_is_stated_and_not_taken_for_a_change() -> None:
    found = ratios.ratio_of(draws(1.15, 0, count=5, noise=0.5))
    assert found.verdict(1.0) == "noisy"
    assert found.verdict(None) == ""


@pytest.mark.parametrize("work", [1, 3])
def test_pairs_measure_the_ratio_of_work(work: int) -> None:
    x = np.random.default_rng(0).normal(size=(120, 120))
    found = ratios.measured(
        lambda: [x @ x for _ in range(20 * work)], lambda: [x @ x for _ in range(20)],
        time.thread_time,
    )  # fmt: skip
    assert found.value == pytest.approx(work, rel=0.25)


def test_the_committed_ratios_are_those_that_are_measured() -> None:
    names = (ratios.FILE.with_name("..") / "benchmarks" / "ratios.py").resolve().read_text()
    for values in history.stored(ratios.FILE).values():
        for name in values:
            assert f'"{name}"' in names or "samples at once" in name, name
