"""Laws of the check of motions: consistent ones within the limits pass on every robot, whatever the
rate; one wrong sample is found anywhere, and so is a limit that is broken between samples."""

from dataclasses import replace

import numpy as np
import pytest

from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.limit_margins import limit_margins
from sysid_bench.excitation.motion_check import motion_problem
from sysid_bench.models.robot import RobotModel
from sysid_bench.plugin_names import BUILTIN, build
from sysid_bench.types import Trajectory
from tests.robots import NAMED, named_robot, random_robot

FAMILIES = sorted(set(BUILTIN["excitation"]) - {"file", "optimised", "wander", "static"})
TREES = range(6)


def robot_of(name: str) -> RobotModel:
    return random_robot(int(name)) if name.isdigit() else named_robot(name)


def designed(robot: RobotModel, use: str = "fourier", rate: float = 100.0) -> Trajectory:
    motion: Trajectory = build("excitation", use).design(
        design_problem(robot, rate), np.random.default_rng(1)
    )
    return motion


ROBOTS = (*NAMED, *map(str, TREES))
SOME = ("ur5", "dvrk_mtm", "0", "5")


@pytest.mark.parametrize("name", ROBOTS)
def test_built_in_motions_are_consistent_and_keep_all_limits(name: str) -> None:
    """Each robot meets a third of the families; neighbours in the list meet the others."""
    robot, turn = robot_of(name), ROBOTS.index(name)
    for index, use in enumerate(FAMILIES[turn % 3 :: 3]):
        rate = (20.0, 100.0, 250.0)[(index + turn // 3) % 3]
        motion = designed(robot, use, rate)
        assert motion_problem(motion, robot.joints, rate) is None, use
        margins = limit_margins(motion, robot)
        assert margins.broken == "", use
        left = [x for x in (margins.q, margins.v, margins.a) if x is not None]
        assert min(left) > 0.005, (use, margins)


@pytest.mark.parametrize("place", [0, 1, "middle", -2, -1])
@pytest.mark.parametrize("name", SOME)
def test_one_wrong_sample_is_found_wherever_it_is(name: str, place: int | str) -> None:
    robot = robot_of(name)
    motion = designed(robot)
    k = len(motion) // 2 if place == "middle" else int(place)
    for quantity in "va":
        wrong = getattr(motion, quantity).copy()
        wrong[k, -1] += 0.3 * np.abs(wrong[:, -1]).max()
        found = motion_problem(replace(motion, **{quantity: wrong}), robot.joints, 100.0)
        assert found is not None
        assert f"{robot.rows[-1]} differs from the differences" in found
    for joint in robot.joints:
        if joint.kind in ("hinge", "slide"):
            q = motion.q.copy()
            q[k, joint.qadr] += 0.01 * np.ptp(q[:, joint.qadr])
            assert motion_problem(replace(motion, q=q), robot.joints, 100.0) is not None


@pytest.mark.parametrize("name", SOME)
def test_a_scaled_rate_and_a_turned_quaternion_are_no_derivatives(name: str) -> None:
    robot = robot_of(name)
    motion = designed(robot)
    for share in (0.5, 0.97, 1.03, 4.0):
        assert motion_problem(replace(motion, v=share * motion.v), robot.joints, 100.0)
        assert motion_problem(replace(motion, a=share * motion.a), robot.joints, 100.0)
    assert motion_problem(replace(motion, q=1.001 * motion.q[::-1]), robot.joints, 100.0)
    assert motion_problem(motion, robot.joints, 101.0)  # sampled at another rate than asked for
    for joint in robot.joints:
        if joint.kind == "ball":  # the same rotations, but not of length one
            q = motion.q.copy()
            q[:, joint.qadr : joint.qadr + 4] *= 1.01
            assert "length" in str(motion_problem(replace(motion, q=q), robot.joints, 100.0))


def test_margins_are_the_shares_left_and_signs_of_quaternions_do_not_matter() -> None:
    robot = named_robot("ur5")
    motion = designed(robot)
    margins = limit_margins(motion, robot)
    assert margins.v == pytest.approx(1 - (np.abs(motion.v) / robot.limits.v).max(), abs=1e-3)
    assert margins.a == pytest.approx(1 - (np.abs(motion.a) / robot.limits.a).max(), abs=1e-3)
    quick = replace(motion, t=0.5 * motion.t, v=2 * motion.v, a=4 * motion.a)
    assert motion_problem(quick, robot.joints, 200.0) is None  # consistent, but too fast
    assert "exceeds its limit" in limit_margins(quick, robot).broken
    floating = named_robot("solo12")
    turned = designed(floating)
    q = turned.q.copy()
    q[::2, 3:7] *= -1.0
    assert motion_problem(replace(turned, q=q), floating.joints, 100.0) is None


@pytest.mark.parametrize("quantity", ["position", "velocity", "acceleration"])
def test_a_limit_broken_between_samples_is_seen(quantity: str) -> None:
    """A sine whose peaks lie half-way between samples, 0.2 % beyond the limit there."""
    robot = named_robot("ur5")
    rate, w = 100.0, 2 * np.pi * 2.5
    t = np.arange(400) / rate
    order = ("position", "velocity", "acceleration").index(quantity)
    low, high = robot.limits.q_low[0], robot.limits.q_high[0]
    reach = (0.5 * (high - low), robot.limits.v[0], robot.limits.a[0])[order] / w**order
    # Peaks of the quantity at half a sample after one.
    angle = w * (t - 0.5 / rate) + (0.0, -0.5 * np.pi, np.pi)[order]
    q, v, a = (np.zeros((len(t), n)) for n in (robot.mj.nq, robot.nv, robot.nv))
    size = 1.002 * reach
    q[:, 0] = 0.5 * (low + high) + size * np.cos(angle)
    v[:, 0], a[:, 0] = -size * w * np.sin(angle), -size * w**2 * np.cos(angle)
    motion = Trajectory(t, q, v, a)
    assert motion_problem(motion, robot.joints, rate) is None
    wide = replace(robot.limits, v=robot.limits.v * 1e3, a=robot.limits.a * 1e3)
    wide = replace(wide, q_low=wide.q_low - 9.0, q_high=wide.q_high + 9.0)
    kept = {"position": ("q_low", "q_high"), "velocity": ("v",), "acceleration": ("a",)}[quantity]
    limits = replace(wide, **{key: getattr(robot.limits, key) for key in kept})
    samples = (q - 0.5 * (low + high), v, a)[order][:, 0]
    assert np.abs(samples).max() < reach * w**order  # every sample keeps the limit
    margins = limit_margins(motion, replace(robot, limits=limits))
    assert quantity in margins.broken
    found = (margins.q, margins.v, margins.a)[order]
    assert found == pytest.approx(-0.002, abs=5e-4)
