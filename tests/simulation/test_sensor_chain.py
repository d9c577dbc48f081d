"""Sensor chain: each stage does what its settings say, in order; the loop sees encoders alone."""

from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.plugin_names import BUILTIN, build
from sysid_bench.simulation.sensor_errors import Delay, LostSamples
from sysid_bench.simulation.sensors import (
    SensorChain,
    TorqueSignal,
    sampled_with_delay,
)
from sysid_bench.types import Array, Oracle, Recording, Trajectory
from tests.closeness import assert_close
from tests.experiments.experiment_world import CLOSED_LOOP, ready, robot_of

RATE = 1000.0
N = 20_000


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def signal(count: int = N, rate: float = RATE) -> TorqueSignal:
    """Positions that sweep several revolutions, and a torque of 2 N m."""
    t = np.arange(count) / rate
    q = np.outer(t, np.linspace(0.1, 0.6, 6))
    tau = np.full((count, 6), 2.0)
    return TorqueSignal(t, q, tau, np.full(6, 2.0))


def reading(error: Any, of: TorqueSignal, seed: int = 0) -> Array:
    stage = error.prepare(robot_of("ur5"), rng(seed))
    return np.asarray(stage.torque_reading(of, rng(seed + 1)))


def composed(*sensors: Any) -> dict[str, Any]:
    return {"use": "composed", "sensors": list(sensors)}


# --- Transducers --------------------------------------------------------------------------------


@pytest.mark.parametrize("gain", [-0.1, 0.04])
def test_gain_and_offset_of_each_joint(gain: float) -> None:
    of, offset = signal(), np.linspace(-1, 1, 6).tolist()
    read = reading(
        build("sensor_error", {"use": "torque-gain", "gain": gain * 100, "offset": offset}), of
    )
    assert_close(read, (1 + gain) * of.tau + offset, 1e-14)


@pytest.mark.parametrize("rate", [200.0, 1000.0])
@pytest.mark.parametrize("constant", [0.05, 0.3])
def test_the_colour_of_torque_noise_is_a_time_whatever_the_rate(
    rate: float, constant: float
) -> None:
    noise = build(
        "sensor_error", {"use": "torque-noise", "time_constant": constant, "share": "1 %"}
    )
    of = signal(count=100_000, rate=rate)
    e = reading(noise, of) - of.tau
    # Of N samples, about N h / 2 T are independent.
    independent = 6 * 100_000 / rate / (2 * constant)
    assert e.std() == pytest.approx(0.02, rel=5 / np.sqrt(independent))
    lag = round(constant * rate)
    correlation = (e[lag:] * e[:-lag]).mean() / (e**2).mean()
    assert correlation == pytest.approx(np.exp(-1.0), abs=5 / np.sqrt(independent))


def test_drift_is_a_slope_and_a_random_walk_that_spreads_with_the_root_of_time() -> None:
    of = signal()
    slope = reading(build("sensor_error", {"use": "torque-drift", "slope": 0.1}), of)
    np.testing.assert_allclose(slope - of.tau, 0.1 * of.t[:, None] * np.ones(6), atol=1e-12)
    walk = build("sensor_error", {"use": "torque-drift", "slope": 0, "walk": 0.2})
    ends = np.array([(reading(walk, signal(1000), seed) - 2.0)[[250, -1]] for seed in range(100)])
    assert ends.std(axis=(0, 2)) == pytest.approx(0.2 * np.sqrt([0.25, 1.0]), rel=0.15)


def test_ripple_repeats_with_the_motor_and_keeps_the_mean() -> None:
    ripple = {"use": "current-ripple", "once": "2 %", "twice": 0, "four_times": "1 %", "ratio": 50}
    of = signal()
    wave = reading(build("sensor_error", ripple), of) / of.tau - 1.0
    assert 0.02 < np.abs(wave).max() <= 0.03
    # Joint 5 turns at 0.6 rad/s, its motor at 30 rad/s.
    spectrum = np.abs(np.fft.rfft(wave[:, 5] * np.hanning(N)))
    cycles = np.fft.rfftfreq(N, 1 / RATE) * 2 * np.pi / 30.0
    peaks = cycles[np.argsort(spectrum)[::-1][:6]]
    assert all(min(abs(peak - 1), abs(peak - 4)) < 0.02 for peak in peaks)
    assert abs(wave.mean()) < 1e-3


def test_eccentricity_repeats_with_each_turn_and_is_zero_where_encoders_are_set() -> None:
    stage = build("sensor_error", {"use": "eccentricity", "amplitude": "1 mrad"}).prepare(
        robot_of("ur5"), rng()
    )
    q = np.linspace(-3, 3, 101)[:, None] * np.ones(6)
    error = stage.encoder_error(q)
    np.testing.assert_allclose(stage.encoder_error(q + 2 * np.pi), error, atol=1e-15)
    assert not stage.encoder_error(np.zeros((1, 6))).any()
    assert 1e-3 < np.ptp(error, axis=0).max() <= 2e-3


# --- Sampling -----------------------------------------------------------------------------------


def oracle() -> Oracle:
    """Sinusoids of 1 Hz on the joints of a UR5."""
    t = np.arange(2000) / RATE
    phase = 2 * np.pi * t[:, None] + np.arange(6)
    w = 2 * np.pi
    motion = Trajectory(t, np.sin(phase), w * np.cos(phase), -(w**2) * np.sin(phase))
    return Oracle(motion, np.cos(phase))


@pytest.mark.parametrize("steps", [1, 4])
def test_a_delay_of_whole_steps_shifts_the_samples(steps: int) -> None:
    exact, late = oracle(), np.full((2000, 6), steps / RATE)
    read = sampled_with_delay(robot_of("ur5"), exact, 1, late, late)
    for found, there in ((read.tau, exact.tau), (read.motion.q, exact.motion.q)):
        np.testing.assert_allclose(found[steps:], there[:-steps], atol=1e-12)
    np.testing.assert_array_equal(read.motion.t, exact.motion.t)


@pytest.mark.parametrize("late", [0.0003, 0.0137])
def test_a_fractional_delay_is_read_between_the_steps(late: float) -> None:
    exact = oracle()
    ages = np.full((400, 6), late)
    read = sampled_with_delay(robot_of("ur5"), exact, 5, ages, np.zeros((400, 6)))
    t = exact.motion.t[::5][10:, None] - late
    phase = 2 * np.pi * t + np.arange(6)
    # Cubic between steps h of 1 ms: h^4 / 384 times the fourth derivative.
    np.testing.assert_allclose(read.motion.q[10:], np.sin(phase), atol=1e-11)
    np.testing.assert_allclose(read.motion.v[10:], 2 * np.pi * np.cos(phase), atol=1e-10)
    np.testing.assert_array_equal(read.tau, exact.tau[::5])


def test_lags_add_up_and_jitter_is_common_to_the_joints_of_a_sample() -> None:
    robot = robot_of("ur5")
    errors = [
        Delay(q=0.001, tau=[0.002] * 6),
        Delay(q=0.0, tau=0.003),
        build("sensor_error", "jitter"),
    ]
    chain = SensorChain(tuple(error.prepare(robot, rng(k)) for k, error in enumerate(errors)))
    q, tau = chain.sampling_delay(np.arange(5000) / 200.0, 6, rng)
    np.testing.assert_allclose(tau - q, 0.004, atol=1e-15)
    assert not np.ptp(q, axis=1).any()
    assert q.mean() == pytest.approx(0.001, abs=2e-5)
    assert q[:, 0].std() == pytest.approx(2e-4, rel=0.05)


# --- Loss ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.01, 0.2])
@pytest.mark.parametrize("burst", [1.0, 4.0])
def test_the_share_and_the_gaps_of_lost_samples(share: float, burst: float) -> None:
    stage = LostSamples(share, burst, "deleted").prepare(robot_of("ur5"), rng())
    assert stage is not None
    lost = stage.stored(100_000, rng(1)) < 0
    gaps = int((np.diff(lost.astype(int)) == 1).sum())
    spread = 5 * np.sqrt(2 * burst / (100_000 * share))
    assert lost.mean() == pytest.approx(share, rel=spread)
    # A gap right after another one joins it: gaps of one sample are longer on average.
    assert burst * (1 - spread) < lost.sum() / gaps < burst / (1 - share) * (1 + spread)


@pytest.mark.parametrize("rows", ["deleted", "held"])
def test_lost_rows_are_bridged_or_hold_the_last_sample(rows: str) -> None:
    t = np.arange(1000) / 100.0
    curve = np.sin(t)[:, None] * np.ones(6)
    recording = Recording(t, curve, 2 * curve, 100.0, ("a",) * 6)
    stage = LostSamples(0.1, 1.0, rows).prepare(robot_of("ur5"), rng())
    read = SensorChain((stage,)).stored(recording, lambda k: rng(k))
    changed = np.flatnonzero((read.q != curve).any(axis=1))
    assert 50 < len(changed) < 200
    k = next(k for k in changed if not {k - 1, k + 1} & set(changed))
    expected = curve[k - 1] if rows == "held" else 0.5 * (curve[k - 1] + curve[k + 1])
    np.testing.assert_allclose(read.q[k], expected, atol=1e-12)
    np.testing.assert_allclose(read.tau, 2 * read.q, atol=1e-12)


# --- Order, and what the loop sees --------------------------------------------------------------


def test_readings_lie_on_the_grid_of_the_encoder_however_late_they_are() -> None:
    sensors = composed("eccentricity", {"use": "delay", "q": "0.3 ms"}, "jitter")
    quantum = 1e-4
    raw = ready(plant=sensors, simulation=CLOSED_LOOP, noise={"quantum": quantum}).experiment.raw
    ticks = raw.q / quantum
    np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-6)


def test_the_loop_sees_errors_of_encoders_and_not_those_of_the_log() -> None:
    def torque(*sensors: Any) -> Array:
        prepared = ready(plant=composed(*sensors), simulation=CLOSED_LOOP, held_out=())
        return np.asarray(prepared.experiment.raw.tau)

    exact = torque()
    log_only = ({"use": "delay", "q": "5 ms", "tau": 0}, {"use": "jitter", "std": 0})
    np.testing.assert_array_equal(torque(*log_only), exact)
    assert np.abs(torque({"use": "eccentricity", "amplitude": "1 mrad"}) - exact).max() > 1e-3


def test_impossible_settings_are_refused() -> None:
    for settings in (
        {"use": "delay", "tau": -0.1},
        {"use": "jitter", "std": -1e-4},
        {"use": "torque-noise", "time_constant": 0},
        {"use": "torque-drift", "walk": -1},
        {"use": "lost-samples", "share": "80 %"},
        {"use": "lost-samples", "burst": 0.5},
    ):
        with pytest.raises(UsageError, match=str(settings["use"])):
            build("sensor_error", settings)
    with pytest.raises(UsageError, match="Did you mean 'deleted'"):
        build("sensor_error", {"use": "lost-samples", "rows": "delete"})
    assert len(BUILTIN["sensor_error"]) == 8
