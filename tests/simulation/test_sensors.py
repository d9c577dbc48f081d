"""Sensors: rounding, white noise of the stated size, and drawing once for all levels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_bench.errors import UsageError
from sysid_bench.simulation.sensors import Noise, position_error, with_position_error
from sysid_bench.types import Array
from tests.experiments.experiment_world import CLOSED_LOOP, SMOOTH, ready, robot_of

NOISE = {"q": 1e-4, "tau_relative": 0.01}


@given(
    quantum=st.floats(1e-6, 0.1),
    std=st.just(0.0) | st.floats(1e-12, 1e-2),
    seed=st.integers(0, 999),
)
@settings(max_examples=40)
def test_a_rounded_reading_is_on_the_grid_and_near(quantum: float, std: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(50, 3))
    draws = rng.normal(size=(50, 3))
    exact = position_error(Noise(q=std), draws, q)
    read = q + position_error(Noise(q=std, quantum=quantum), draws, q)
    steps = read / quantum
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert np.abs(read - q - exact).max() <= 0.5 * quantum * (1 + 1e-9) + 1e-15


@pytest.mark.parametrize("simulation", [{"use": "inverse"}, CLOSED_LOOP], ids=["inverse", "loop"])
def test_recorded_positions_lie_on_the_encoder_grid(simulation: dict[str, str]) -> None:
    quantum = 1e-3
    made = ready(robot=SMOOTH, simulation=simulation, noise={"q": 1e-4, "quantum": quantum})
    steps = made.experiment.raw.q / quantum
    np.testing.assert_allclose(steps, np.round(steps), rtol=0, atol=1e-6)


def test_orientations_are_not_rounded() -> None:
    """An encoder counts; an orientation sensor's small error is not rounded away."""
    noise = {"q": 1e-4, "quantum": 1e-2}
    made = ready(robot="file:ball.xml", noise=noise)
    exact = ready(robot="file:ball.xml", noise={})
    ball = slice(1, 5)
    assert np.abs(made.experiment.raw.q - exact.experiment.raw.q)[:, ball].max() > 1e-5
    slide = made.experiment.raw.q[:, 5] / 1e-2
    np.testing.assert_allclose(slide, np.round(slide), rtol=0, atol=1e-6)


def test_torque_noise_is_white_and_of_the_stated_share() -> None:
    exact = ready(robot="ur5").experiment.raw
    noisy = ready(robot="ur5", noise={"tau_relative": 0.02}).experiment.raw
    rms = np.sqrt((exact.tau**2).mean(axis=0))
    white = (noisy.tau - exact.tau) / (0.02 * rms)
    count = white.size  # 1200
    assert abs(white.std() - 1.0) < 5 / np.sqrt(2 * count)
    assert abs(white.mean()) < 5 / np.sqrt(count)
    neighbours = (white[1:] * white[:-1]).mean()
    assert abs(neighbours) < 5 / np.sqrt(count)
    assert np.abs(np.corrcoef(white.T) - np.eye(6)).max() < 5 / np.sqrt(len(white))


def test_absolute_torque_noise_is_the_same_on_every_joint() -> None:
    exact = ready(robot="ur5").experiment.raw
    noisy = ready(robot="ur5", noise={"tau": 0.3}).experiment.raw
    spread = (noisy.tau - exact.tau).std(axis=0)
    assert np.abs(spread / 0.3 - 1).max() < 5 / np.sqrt(2 * len(exact))


def test_relative_noise_in_closed_loop_is_of_what_is_recorded() -> None:
    exact = ready(robot=SMOOTH, simulation=CLOSED_LOOP).experiment.raw
    noisy = ready(robot=SMOOTH, simulation=CLOSED_LOOP, noise={"tau_relative": 0.02})
    white = noisy.experiment.raw.tau - exact.tau
    rms = np.sqrt((exact.tau**2).mean(axis=0))
    assert np.abs(white.std(axis=0) / (0.02 * rms) - 1).max() < 5 / np.sqrt(2 * len(exact))


def test_encoder_noise_changes_no_true_motion_without_a_controller() -> None:
    exact, noisy = (ready(robot=SMOOTH, noise=n).experiment.raw for n in ({}, NOISE))
    assert exact.v is not None
    assert noisy.v is not None
    np.testing.assert_array_equal(exact.v, noisy.v)
    assert np.abs(noisy.q - exact.q).std() == pytest.approx(1e-4, rel=0.5)


def test_encoder_noise_changes_the_true_motion_in_closed_loop() -> None:
    exact, noisy = (
        ready(robot=SMOOTH, noise=n, simulation=CLOSED_LOOP).experiment.raw for n in ({}, NOISE)
    )
    assert exact.v is not None
    assert noisy.v is not None
    assert np.abs(exact.v - noisy.v).max() > 1e-5


def test_recordings_are_every_so_manieth_control_step() -> None:
    slow, fast = (
        ready(robot=SMOOTH, simulation=CLOSED_LOOP, rate=rate).experiment.raw
        for rate in (50.0, 250.0)
    )
    for field in ("t", "q", "v", "a", "tau"):
        np.testing.assert_array_equal(getattr(slow, field), getattr(fast, field)[::5])
    assert slow.rate == pytest.approx(50.0, rel=1e-9)
    np.testing.assert_allclose(np.diff(slow.t), 0.02, rtol=1e-9)


def norm(q: Array) -> Array:
    return np.asarray(np.linalg.norm(q, axis=1))


@given(seed=st.integers(0, 999), size=st.floats(0.0, 0.5))
@settings(max_examples=25)
def test_displaced_orientations_stay_orientations(seed: int, size: float) -> None:
    robot = robot_of("file:free.xml")
    rng = np.random.default_rng(seed)
    q = np.tile(robot.mj.qpos0, (4, 1))
    error = size * rng.normal(size=(4, robot.nv))
    moved = with_position_error(robot, q, error)
    np.testing.assert_allclose(norm(moved[:, 3:7]), 1.0, atol=1e-12)
    np.testing.assert_allclose(moved[:, :3] - q[:, :3], error[:, :3], atol=1e-15)
    angle = 2 * np.arccos(np.clip(np.abs((moved[:, 3:7] * q[:, 3:7]).sum(axis=1)), 0, 1))
    turned = norm(error[:, 3:6])
    expected = np.minimum(turned, 2 * np.pi - turned)
    np.testing.assert_allclose(angle, expected, atol=1e-6)


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.98])
def test_torque_noise_has_the_memory_that_was_asked_for(correlation: float) -> None:
    white = np.random.default_rng(0).normal(size=(400, 3000))  # 3000 series of 400 samples
    noise = Noise(tau=1.0, tau_correlation=correlation).torque_noise(white)
    error = 5 / np.sqrt(white.shape[1])
    assert np.abs(noise.std(axis=1) - 1.0).max() < error  # from the first sample on
    for lag in (1, 10, 100):
        alike = (noise[lag:] * noise[:-lag]).mean(axis=1)
        assert np.abs(alike - correlation**lag).max() < 2 * error
    np.testing.assert_allclose(noise[0], white[0], atol=1e-14)


@pytest.mark.parametrize("correlation", [1.0, 1.5, -0.1])
def test_noise_that_never_changes_is_refused(correlation: float) -> None:
    with pytest.raises(UsageError, match="tau_correlation"):
        Noise(tau=1.0, tau_correlation=correlation)


def test_memory_changes_the_order_of_noise_and_not_its_size() -> None:
    exact, white, slow = (
        ready(robot="ur5", noise=noise, rate=200.0).experiment.raw.tau
        for noise in ({}, {"tau": 0.1}, {"tau": 0.1, "tau_correlation": 0.5})
    )
    white, slow = white - exact, slow - exact
    np.testing.assert_allclose(slow[0], white[0], atol=1e-12)
    assert slow.std() == pytest.approx(white.std(), rel=0.1)
    step = np.sqrt(1 - 0.5**2)
    np.testing.assert_allclose(slow[1:], 0.5 * slow[:-1] + step * white[1:], atol=1e-12)
