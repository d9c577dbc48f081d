"""In-situ calibration with known wrenches, contact detection, recursive estimation."""

import numpy as np
import pytest

from sysid_bench.errors import EstimationError, UsageError
from sysid_bench.identification.estimators.recursive import RecursiveEstimator
from sysid_bench.identification.wrench_sensor import fit_calibration, free_samples
from tests.identification.batch_solution import batch_estimate

SIZE = np.repeat([1.0, 10.0], 3)


def _sensor(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    G = np.eye(6) + 0.02 * rng.normal(size=(6, 6)) * SIZE[:, None] / SIZE
    return G, SIZE * rng.normal(size=6)


@pytest.mark.parametrize("seed", range(5))
def test_rich_wrenches_determine_the_whole_matrix(seed: int) -> None:
    rng = np.random.default_rng(seed)
    G, offset = _sensor(rng)
    known = SIZE * rng.normal(size=(2000, 6))
    reading = known @ G.T + offset + 0.001 * SIZE * rng.normal(size=known.shape)
    found = fit_calibration(reading, known)
    assert np.abs((found.G - G) / SIZE[:, None] * SIZE).max() < 2e-4
    fresh = SIZE * rng.normal(size=(100, 6))
    error = (found.apply(fresh @ G.T + offset) - fresh) / SIZE
    assert np.abs(error).max() < 2e-3


@pytest.mark.parametrize("seed", range(5))
def test_unexcited_entries_of_the_matrix_stay_ideal(seed: int) -> None:
    """Wrenches in three directions alone: there the sensor is right, elsewhere not made worse."""
    rng = np.random.default_rng(seed)
    G, offset = _sensor(rng)
    basis = np.linalg.qr(rng.normal(size=(6, 3)))[0]
    known = SIZE * (rng.normal(size=(3000, 3)) @ basis.T)
    reading = known @ G.T + offset + 0.001 * SIZE * rng.normal(size=known.shape)
    found = fit_calibration(reading, known)
    inside = (found.apply(reading) - known) / SIZE
    assert np.sqrt((inside**2).mean()) < 2e-3
    other = SIZE * rng.normal(size=(500, 6))
    before = (other @ G.T - other) / SIZE
    after = (found.apply(other @ G.T + offset) - other) / SIZE
    assert np.sqrt((after**2).mean()) < np.sqrt((before**2).mean())


def test_zero_or_too_few_wrenches_are_refused() -> None:
    with pytest.raises(EstimationError, match="with a load that weighs"):
        fit_calibration(np.ones((100, 6)), np.zeros((100, 6)))
    with pytest.raises(EstimationError, match="10 samples"):
        fit_calibration(np.ones((10, 6)), np.ones((10, 6)))


@pytest.mark.parametrize("seed", range(5))
def test_the_recursion_equals_the_batch_solution(seed: int) -> None:
    rng = np.random.default_rng(seed)
    W, sigma = rng.normal(size=(200, 3, 7)), rng.uniform(0.1, 10.0, 3)
    f = W @ rng.normal(size=7) + sigma * rng.normal(size=(200, 3))
    free = rng.random(200) < 0.8
    root = rng.normal(size=(7, 7))
    P = root @ root.T + np.eye(7)
    prior = rng.normal(size=7)
    track = RecursiveEstimator().run(W, f, sigma, prior, P, free)
    np.testing.assert_allclose(
        track.estimate, batch_estimate(W, f, sigma, prior, P, free), atol=1e-10
    )
    assert track.indices[-1] == 199
    np.testing.assert_array_equal(track.used, free)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("share", [0.0, 0.1, 0.4])
def test_contacts_are_detected_and_free_samples_kept(seed: int, share: float) -> None:
    """Whatever their shape and place, and rows of any size; without one hardly anything does."""
    rng = np.random.default_rng(seed)
    W, sigma = rng.normal(size=(6000, 6, 12)), np.repeat([0.01, 0.2], 3)
    f = W @ rng.normal(size=12) + sigma * rng.normal(size=(6000, 6))
    start, length = rng.integers(0, 3000), int(6000 * share)
    touched = np.zeros(6000, dtype=bool)
    touched[start : start + length] = True
    f[touched] += 20 * sigma * np.sin(0.1 * np.arange(length))[:, None]
    free = free_samples(W, f)
    assert free[~touched].mean() > 0.95
    assert (~free[touched]).all()


def test_too_few_or_unexciting_samples_are_refused() -> None:
    with pytest.raises(EstimationError, match="too few"):
        free_samples(np.ones((20, 6, 3)), np.ones((20, 6)))
    with pytest.raises(EstimationError, match="declare the contact intervals"):
        free_samples(np.ones((2000, 6, 3)), np.random.default_rng(0).normal(size=(2000, 6)))


@pytest.mark.parametrize("wrong", [{"forgetting": 0.0}, {"forgetting": 1.1}, {"walk": -1.0}])
def test_invalid_filter_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        RecursiveEstimator(**wrong).run(  # type: ignore[arg-type]
            np.ones((5, 1, 1)), np.ones((5, 1)), np.ones(1), np.zeros(1), np.ones(1)
        )
