"""Laws of motions: inside the limits, derivatives of themselves, drawn from their seed alone."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_bench.errors import UsageError
from sysid_bench.excitation.design_problem import (
    FLOATING_REACH,
    DesignProblem,
    dense_grid,
    design_problem,
    scale_to_limits,
)
from sysid_bench.excitation.random_motions import fourier_profile
from sysid_bench.models.robot import RobotModel
from sysid_bench.plugin_names import build, known
from sysid_bench.spatial import composed_rotation, inverse_quaternion
from sysid_bench.types import Array, Trajectory
from tests.experiments.experiment_world import OWN, SHIPPED, motion_of, robot_of

# `optimised` and `file` have laws of their own.
EXCITATIONS = tuple(n for n in known("excitation") if n not in ("file", "optimised"))
RATE = 20.0


def turns(robot: RobotModel) -> list[tuple[slice, slice]]:
    """(places in q, places in v) of every orientation."""
    places = []
    for joint in robot.joints:
        if joint.kind in ("free", "ball"):
            skip = 3 if joint.kind == "free" else 0
            q, v = joint.qadr + skip, joint.vadr + skip
            places.append((slice(q, q + 4), slice(v, v + 3)))
    return places


def lengths(robot: RobotModel) -> list[tuple[int, int]]:
    """(place in q, place in v) of everything else."""
    places = []
    for joint in robot.joints:
        if joint.kind in ("hinge", "slide"):
            places.append((joint.qadr, joint.vadr))
        elif joint.kind == "free":
            places += [(joint.qadr + i, joint.vadr + i) for i in range(3)]
    return places


def angle_of(quaternion: Array) -> Array:
    return np.asarray(
        2 * np.arctan2(np.linalg.norm(quaternion[:, 1:], axis=1), np.abs(quaternion[:, 0]))
    )


@pytest.mark.parametrize("use", EXCITATIONS)
@pytest.mark.parametrize("name", SHIPPED + OWN)
def test_motions_stay_inside_all_limits_between_the_samples_too(name: str, use: str) -> None:
    robot = robot_of(name)
    for seed in range(2):
        fine = motion_of(robot, use, 10 * RATE, seed)
        coarse = motion_of(robot, use, RATE, seed)
        # The same motion: what holds on the fine grid holds between the samples of the coarse one.
        shared = min(len(coarse), len(fine) // 10)
        np.testing.assert_allclose(coarse.q[:shared], fine.q[::10][:shared], atol=1e-9)
        own = robot.torque_dofs  # a joint that follows has no default limits, only stated ones
        assert (np.abs(fine.v) <= robot.limits.v)[:, own].all()
        assert (np.abs(fine.a) <= robot.limits.a)[:, own].all()
        for at, dof in lengths(robot):
            if np.isfinite(robot.limits.q_low[dof]):
                assert fine.q[:, at].min() >= robot.limits.q_low[dof]
                assert fine.q[:, at].max() <= robot.limits.q_high[dof]
            else:
                assert np.abs(fine.q[:, at] - robot.mj.qpos0[at]).max() <= FLOATING_REACH[0]
        for at4, _ in turns(robot):
            start = robot.mj.qpos0[at4]
            turned = composed_rotation(
                np.tile(inverse_quaternion(start), (len(fine), 1)), fine.q[:, at4]
            )
            assert angle_of(turned).max() <= np.sqrt(3) * FLOATING_REACH[1]


def rates_by_differences(robot: RobotModel, motion: Trajectory) -> Array:
    """v (N - 2, nv) by central differences of q, orientations by the angle between neighbours."""
    two_steps = motion.t[2:] - motion.t[:-2]
    v = np.empty((len(motion) - 2, robot.nv))
    for at, dof in lengths(robot):
        v[:, dof] = (motion.q[2:, at] - motion.q[:-2, at]) / two_steps
    for at4, dofs in turns(robot):
        half = composed_rotation(inverse_quaternion(motion.q[:-2, at4]), motion.q[2:, at4])
        half = half * np.sign(half[:, :1])
        # log of the turn between the neighbours, in the body's axes half way: exact to order two
        v[:, dofs] = 2 * half[:, 1:] / two_steps[:, None]
    return v


@pytest.mark.parametrize("use", EXCITATIONS)
@pytest.mark.parametrize("name", ["ur5", "solo12", "file:ball.xml", "file:free.xml"])
def test_v_and_a_are_the_derivatives_of_q(name: str, use: str) -> None:
    robot = robot_of(name)
    errors = []
    for rate in (200.0, 400.0):
        motion = motion_of(robot, use, rate, seed=3)
        dv = rates_by_differences(robot, motion) - motion.v[1:-1]
        da = (motion.v[2:] - motion.v[:-2]) * rate / 2 - motion.a[1:-1]
        # A point-to-point move changes its third derivative in steps: the 90 % quantile is smooth.
        errors.append([np.quantile(np.abs(d).max(axis=1), 0.9) for d in (dv, da)])
    (v1, a1), (v2, a2) = errors
    assert v2 < 2e-3 * robot.limits.v.max()
    assert a2 < 2e-2 * robot.limits.a.max()
    assert 3.0 < v1 / v2 < 5.0  # order two
    assert 3.0 < a1 / a2 < 5.0


@pytest.mark.parametrize("use", EXCITATIONS)
def test_a_motion_is_its_seed(use: str) -> None:
    robot = robot_of("file:free.xml")
    one, same, other = (motion_of(robot, use, 50.0, seed) for seed in (5, 5, 6))
    for field in ("t", "q", "v", "a"):
        np.testing.assert_array_equal(getattr(one, field), getattr(same, field))
    shared = min(len(one), len(other))
    for dof in range(robot.nv):
        assert np.abs(one.v[:shared, dof] - other.v[:shared, dof]).max() > 1e-3


def test_the_other_fourier_motion_shares_nothing_with_the_training_one() -> None:
    robot = robot_of("ur5")
    one, other = (motion_of(robot, use, 50.0, seed=5) for use in ("fourier", "fourier-other"))
    assert one.period != other.period
    assert np.abs(one.q[:200] - other.q[:200]).max() > 0.1


@pytest.mark.parametrize("name", ["ur5", "file:free.xml"])
def test_fourier_motions_repeat_after_their_period(name: str) -> None:
    spec = {"use": "fourier", "period": "4 s", "cycles": 3}
    motion = motion_of(robot_of(name), spec, 50.0)
    assert motion.period == 4.0
    assert len(motion) == 600
    for field in ("q", "v", "a"):
        values = getattr(motion, field)
        np.testing.assert_allclose(values[200:], values[:400], atol=1e-10)


@given(
    seed=st.integers(0, 99),
    harmonics=st.integers(1, 6),
    period=st.floats(0.5, 30.0),
    t=st.floats(0.0, 60.0),
)
@settings(max_examples=40)
def test_the_fourier_series_is_equation_8_of_seed_001(
    seed: int, harmonics: int, period: float, t: float
) -> None:
    """q_i = sum_l a_l / (w_f l) sin(w_f l t) - b_l / (w_f l) cos(w_f l t) + q_i0."""
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, harmonics, 3))
    scale, offset = rng.uniform(0.1, 1.0, size=(2, 3))
    x, dx, ddx = fourier_profile(np.array([t]), period, a, b, scale, offset)
    w = 2 * np.pi / period
    q, dq, ddq = offset.copy(), np.zeros(3), np.zeros(3)
    for n in range(1, harmonics + 1):
        al, bl = scale * a[n - 1], scale * b[n - 1]
        q += al / (w * n) * np.sin(w * n * t) - bl / (w * n) * np.cos(w * n * t)
        dq += al * np.cos(w * n * t) + bl * np.sin(w * n * t)
        ddq += w * n * (bl * np.cos(w * n * t) - al * np.sin(w * n * t))
    for ours, theirs in ((x, q), (dx, dq), (ddx, ddq)):
        np.testing.assert_allclose(ours[0], theirs, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("rest", ["0 s", "0.2 s"])
@pytest.mark.parametrize("rate", [20.0, 173.0, 1000.0])
def test_point_to_point_moves_start_and_end_at_rest(rest: str, rate: float) -> None:
    for seed in range(5):
        motion = motion_of(
            robot_of("ur5"), {"use": "ptp", "moves": 2, "rest": rest}, rate, seed=seed
        )
        for k in (0, -1):
            np.testing.assert_array_equal(motion.v[k], 0.0)
            np.testing.assert_array_equal(motion.a[k], 0.0)


def test_a_point_to_point_motion_rests_between_its_moves() -> None:
    motion = motion_of(robot_of("ur5"), {"use": "ptp", "moves": 3, "rest": "0.5 s"}, 100.0)
    still = np.array([not v.any() for v in motion.v])
    starts = np.flatnonzero(still[1:] & ~still[:-1])
    assert len(starts) == 3
    assert (np.diff(np.append(starts, len(motion)))[-1]) >= 50


BAD: tuple[dict[str, Any], ...] = (
    {"use": "fourier", "harmonics": 0},
    {"use": "fourier", "harmonics": 2.5},
    {"use": "fourier", "harmonics": "5"},
    {"use": "fourier", "cycles": 0},
    {"use": "fourier", "cycles": float("nan")},
    {"use": "fourier", "period": "0 s"},
    {"use": "fourier", "period": "-1 s"},
    {"use": "fourier", "period": "5 kg"},
    {"use": "fourier", "periode": "5 s"},
    {"use": "fourier", "period": "0.1 s", "cycles": 1},  # nine samples
    {"use": "multisine", "sines": 0},
    {"use": "multisine", "sines": True},
    {"use": "multisine", "lowest": "0 Hz"},
    {"use": "multisine", "lowest": "2 Hz", "highest": "1 Hz"},
    {"use": "multisine", "duration": "-3 s"},
    {"use": "ptp", "moves": 0},
    {"use": "ptp", "moves": 1.5},
    {"use": "ptp", "rest": "-0.1 s"},
)


@pytest.mark.parametrize("spec", BAD, ids=str)
def test_settings_that_make_no_motion_are_refused_in_words(spec: dict[str, Any]) -> None:
    brief = design_problem(robot_of("ur5"), 90.0)
    with pytest.raises(UsageError):
        build("excitation", spec).design(brief, np.random.default_rng(0))


@given(seed=st.integers(0, 2**32 - 1), nv=st.integers(1, 4))
@settings(max_examples=40)
def test_a_fitted_shape_touches_a_limit_and_passes_none(seed: int, nv: int) -> None:
    rng = np.random.default_rng(seed)
    low, margin = rng.normal(size=nv), rng.uniform(0.01, 5.0, size=nv)
    v, a = rng.uniform(0.1, 5.0, size=(2, nv))
    brief = DesignProblem((), low, low + margin, v, a, np.zeros(nv), 100.0)
    amplitude, w, phase = rng.uniform(0.2, 3.0, size=(3, nv))

    def shape(t: Array) -> tuple[Array, Array, Array]:
        angle = np.outer(t, w) + phase
        return (
            amplitude * np.sin(angle),
            amplitude * w * np.cos(angle),
            -amplitude * w**2 * np.sin(angle),
        )

    grid = dense_grid(20.0, float(w.max()))
    scale, offset = scale_to_limits(shape, grid, brief, rng)
    x, dx, ddx = shape(np.linspace(0.0, 20.0, 20_001))
    use = np.array(
        [
            np.ptp(scale * x, axis=0) / margin,
            np.abs(scale * dx).max(axis=0) / v,
            np.abs(scale * ddx).max(axis=0) / a,
        ]
    )
    assert (use.max(axis=0) <= 1.0).all()
    assert (use.max(axis=0) >= 0.97).all()
    assert (offset + scale * x >= low).all()
    assert (offset + scale * x <= low + margin).all()
