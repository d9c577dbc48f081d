"""From raw signals to a motion: derivatives of their order, edges cut, complaints in words."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.filter import filter_of
from sysid_bench.signals.processing import processing_of
from sysid_bench.types import Recording, Trajectory
from tests.experiments.experiment_world import motion_of, robot_of

FROM_Q = {"derivatives": "from q"}
ROBOTS = ("ur5", "file:arm.xml", "file:ball.xml", "file:free.xml", "solo12")


def recording_of(robot: RobotModel, motion: Trajectory, rates: bool = False) -> Recording:
    rate = 1.0 / (motion.t[1] - motion.t[0])
    v, a = (motion.v, motion.a) if rates else (None, None)
    return Recording(motion.t, motion.q, np.sin(motion.v), rate, robot.rows, v=v, a=a)


def slow(robot: RobotModel, rate: float) -> Trajectory:
    return motion_of(robot, {"use": "fourier", "harmonics": 2, "period": "4 s"}, rate, seed=2)


@pytest.mark.parametrize("accuracy", [2, 4])
@pytest.mark.parametrize("name", ROBOTS)
def test_derivatives_from_q_approach_the_exact_ones_with_their_order(
    name: str, accuracy: int
) -> None:
    robot = robot_of(name)
    processing = replace(processing_of(FROM_Q), accuracy=accuracy)
    errors = []
    for rate in (50.0, 100.0):
        motion = slow(robot, rate)
        made = processing.apply(recording_of(robot, motion), robot.joints)
        assert made.v is not None
        assert made.a is not None
        kept = slice(accuracy, -accuracy)
        np.testing.assert_array_equal(made.t, motion.t[kept])
        np.testing.assert_allclose(made.q, motion.q[kept], atol=1e-12)
        errors.append(
            [np.abs(made.v - motion.v[kept]).max(), np.abs(made.a - motion.a[kept]).max()]
        )
    (v1, a1), (v2, a2) = errors
    assert v2 < 8e-3
    assert a2 < 8e-2
    assert 0.85 < v1 / v2 / 2**accuracy < 1.15
    assert 0.85 < a1 / a2 / 2**accuracy < 1.15


@given(seed=st.integers(0, 999))
@settings(max_examples=20)
def test_the_sign_of_a_quaternion_means_nothing(seed: int) -> None:
    robot = robot_of("file:free.xml")
    motion = slow(robot, 100.0)
    plain = recording_of(robot, motion)
    q = motion.q.copy()
    rng = np.random.default_rng(seed)
    for start in (3, 7):
        q[:, start : start + 4] *= rng.choice([-1.0, 1.0], size=(len(q), 1))
    spec = {"filter": "butter 2 10 Hz zero-phase", "derivatives": "from q"}
    one, other = (processing_of(spec).apply(r, robot.joints) for r in (plain, replace(plain, q=q)))
    assert one.v is not None
    assert other.v is not None
    np.testing.assert_allclose(one.v, other.v, atol=1e-9)
    for start in (3, 7):
        norm = np.linalg.norm(one.q[:, start : start + 4], axis=1)
        np.testing.assert_allclose(norm, 1.0, atol=1e-12)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_filter_in_band_keeps_the_motion(name: str) -> None:
    robot = robot_of(name)
    motion = slow(robot, 200.0)  # up to 0.5 Hz
    spec = {"filter": "butter 4 20 Hz zero-phase", "derivatives": "from q"}
    made = processing_of(spec).apply(recording_of(robot, motion), robot.joints)
    assert made.v is not None
    kept = slice(12, -12)  # one period of the cut-off and two samples of the differences
    np.testing.assert_array_equal(made.t, motion.t[kept])
    np.testing.assert_allclose(made.q, motion.q[kept], atol=2e-3)
    assert np.abs(made.v - motion.v[kept]).max() < 0.03 * np.abs(motion.v).max()


def test_all_signals_pass_the_same_filter() -> None:
    """None is late against another: torque made of v stays that of the filtered v."""
    robot = robot_of("file:arm.xml")
    recording = recording_of(robot, slow(robot, 200.0), rates=True)
    assert recording.v is not None
    spec = {"filter": "average 9", "derivatives": "exact"}
    made = processing_of(spec).apply(replace(recording, tau=recording.v), robot.joints)
    assert made.v is not None
    np.testing.assert_allclose(made.tau, made.v, atol=1e-12)
    assert len(made) == len(recording) - 8
    for signal in (made.q, made.v, made.a, made.tau):
        assert signal is not None
        assert len(signal) == len(made.t)


def test_no_filter_and_exact_derivatives_change_nothing() -> None:
    robot = robot_of("file:ball.xml")
    recording = recording_of(robot, slow(robot, 100.0), rates=True)
    made = processing_of({}).apply(recording, robot.joints)
    for field in ("t", "v", "a", "tau"):
        np.testing.assert_array_equal(getattr(made, field), getattr(recording, field))
    np.testing.assert_allclose(made.q, recording.q, atol=1e-15)


def test_the_raw_recording_is_left_as_it_was() -> None:
    robot = robot_of("file:free.xml")
    recording = recording_of(robot, slow(robot, 100.0), rates=True)
    before = [np.array(x) for x in (recording.q, recording.v, recording.a, recording.tau)]
    processing_of({"filter": "average 5"}).apply(recording, robot.joints)
    after = [np.array(x) for x in (recording.q, recording.v, recording.a, recording.tau)]
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(old, new)


@given(count=st.integers(0, 120), window=st.integers(0, 40), from_q=st.booleans())
@settings(max_examples=60)
def test_short_recordings_are_processed_or_refused(count: int, window: int, from_q: bool) -> None:
    robot = robot_of("file:arm.xml")
    recording = recording_of(robot, slow(robot, 100.0), rates=True)
    parts: dict[str, Any] = {
        name: getattr(recording, name)[:count] for name in ("t", "q", "tau", "v", "a")
    }
    short = replace(recording, **parts)
    derivatives = "from q" if from_q else "exact"
    spec = {"filter": f"average {2 * window + 1}", "derivatives": derivatives}
    edge = window + (2 if from_q else 0)
    if count <= 2 * edge + 10:
        with pytest.raises(UsageError, match="too few"):
            processing_of(spec).apply(short, robot.joints)
    else:
        assert len(processing_of(spec).apply(short, robot.joints)) == count - 2 * edge


BAD: tuple[dict[str, Any], ...] = (
    {"filtre": "none"},
    {"filter": "butterfly"},
    {"filter": 3},
    {"derivatives": "from Q"},
    {"derivatives": None},
)


@pytest.mark.parametrize("spec", BAD, ids=str)
def test_unknown_words_are_refused(spec: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        processing_of(spec)


@pytest.mark.parametrize("derivatives", ["exact", "from v"])
def test_derivatives_need_a_recording_that_has_them(derivatives: str) -> None:
    robot = robot_of("file:arm.xml")
    recording = recording_of(robot, slow(robot, 100.0))
    with pytest.raises(UsageError, match="from q"):
        processing_of({"derivatives": derivatives}).apply(recording, robot.joints)
    with pytest.raises(ValueError, match="filter it first"):
        _ = recording.motion


def test_a_cut_off_above_half_the_rate_is_refused() -> None:
    robot = robot_of("file:arm.xml")
    recording = recording_of(robot, slow(robot, 100.0), rates=True)
    with pytest.raises(UsageError, match="rate"):
        processing_of({"filter": "butter 4 60 Hz"}).apply(recording, robot.joints)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_series_of_a_motion_that_repeats_has_its_exact_derivatives(name: str) -> None:
    robot = robot_of(name)
    motion = slow(robot, 50.0)
    recording = replace(recording_of(robot, motion), period=motion.period)
    spec = {"filter": "fourier 8.1 Hz", "derivatives": "from q", "torque": "raw"}
    made = processing_of(spec).apply(recording, robot.joints)
    assert made.v is not None
    assert made.a is not None
    np.testing.assert_array_equal(made.t, motion.t)
    # Quaternions of a free base have harmonics above any cut-off; hinges have their own alone.
    turns = any(joint.kind in ("free", "ball") for joint in robot.joints)
    scale = 1e-3 if turns else 1e-9
    np.testing.assert_allclose(made.q, motion.q, atol=scale)
    np.testing.assert_allclose(made.v, motion.v, atol=scale * 10)
    np.testing.assert_allclose(made.a, motion.a, atol=scale * 100)
    np.testing.assert_array_equal(made.tau, recording.tau)


def test_a_series_keeps_what_is_slower_than_its_cutoff_and_nothing_else() -> None:
    t = np.arange(400) / 100.0
    waves = [np.sin(2 * np.pi * f * t) for f in (0.25, 2.0, 2.25, 30.0)]
    filter = filter_of("fourier 2.1 Hz")
    kept = filter.smooth(np.stack([sum(waves)], axis=1), 100.0)[:, 0]
    np.testing.assert_allclose(kept, waves[0] + waves[1], atol=1e-12)


@pytest.mark.parametrize("period", [None, 3.0, 0.333])
def test_a_series_needs_whole_periods(period: float | None) -> None:
    robot = robot_of("ur5")
    recording = replace(recording_of(robot, slow(robot, 50.0)), period=period)
    with pytest.raises(UsageError, match="needs whole periods; 400 samples"):
        processing_of({"filter": "fourier 2 Hz"}).apply(recording, robot.joints)
