"""Noise level of a smooth signal."""

import numpy as np
import pytest

from sysid_bench.identification.simulation_based.measured_motion import white_noise


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("sigma", [1e-7, 1e-4, 1e-2])
def test_white_noise_is_separated_from_the_motion(sigma: float, seed: int) -> None:
    t = np.arange(2000) / 200.0
    waves = np.stack([np.sin(2 * t), np.cos(5 * t) + 0.3 * t], axis=1)
    noise = sigma * np.random.default_rng(seed).normal(size=waves.shape)
    np.testing.assert_allclose(white_noise(waves + noise), sigma, rtol=0.15)
    assert (white_noise(waves) < 1e-8).all()
