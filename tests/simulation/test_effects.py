"""Stribeck friction: like Coulomb at low speed, gone at high, and visible in what OLS predicts."""

from dataclasses import replace

import numpy as np
import pytest

from sysid_bench.simulation.effects.presliding import Stribeck
from sysid_bench.simulation.motor_load import gravity_rms
from sysid_bench.simulation.plant import Matched, plant_of
from tests.experiments.dropped_bound import dropped_bound
from tests.experiments.experiment_world import (
    CLOSED_LOOP,
    SHIPPED,
    executed,
    ready_once,
    robot_of,
    spec,
)


@pytest.mark.parametrize("name", ["ur5", "panda", "file:arm.xml", "solo12"])
def test_stribeck_is_coulomb_like_at_low_speed_and_gone_at_high(name: str) -> None:
    robot = robot_of(name)
    effect = Stribeck(vs=0.1, v0=1e-5)
    law = effect.prepare(robot)
    assert law is not None
    q = np.array(robot.mj.qpos0)
    moving = robot.scalar_dofs
    slow = law(np.array(0.0), q, np.full(robot.nv, 1e-3))
    assert (slow[moving] > 0).all()
    still = np.setdiff1d(np.arange(robot.nv), moving)
    assert not slow[still].any()
    for v in (2e-4, 1e-3):  # far above v0, far below vs: a constant with the sign of v
        for sign in (-1.0, 1.0):
            here = law(np.array(0.0), q, np.full(robot.nv, sign * v))
            np.testing.assert_allclose(here, sign * slow, rtol=1e-3)
    fast = law(np.array(0.0), q, np.full(robot.nv, 1.0))
    assert (np.abs(fast[moving]) <= 1e-40 * slow[moving]).all()
    assert not law(np.array(0.0), q, np.zeros(robot.nv)).any()


def test_its_size_is_a_share_of_the_gravity_torque_but_no_joint_is_left_out() -> None:
    robot = robot_of("ur5")
    gravity = gravity_rms(robot, robot.mj)
    law = Stribeck(share=0.1, vs=1e6, v0=1e-9).prepare(robot)
    assert law is not None
    size = law(np.array(0.0), np.zeros(6), np.ones(6))
    floor = np.maximum(gravity, 1e-3 * gravity.max())
    np.testing.assert_allclose(size, 0.1 * floor, rtol=1e-9)
    assert gravity[0] < 1e-3 * gravity.max()  # the vertical axis carries no gravity


def test_single_samples_and_whole_motions_see_the_same_law() -> None:
    robot = robot_of("file:arm.xml")
    law = Stribeck().prepare(robot)
    assert law is not None
    rng = np.random.default_rng(0)
    q, v = rng.normal(size=(2, 20, 3))
    whole = law(np.arange(20.0), q, v)
    single = [law(np.array(float(k)), q[k], v[k]) for k in range(20)]
    np.testing.assert_array_equal(whole, single)


def test_the_matched_plant_has_no_law() -> None:
    assert plant_of(robot_of("ur5"), [Matched()]).laws == ()


@pytest.mark.parametrize("name", SHIPPED)
def test_an_unmodelled_effect_moves_the_held_out_torque_error_away_from_zero(name: str) -> None:
    made, exact = spec(robot=name), ready_once(name)
    bound = dropped_bound(exact.problem, exact.held_out, exact.source.truth.theta)
    for row in executed(made, "ols", "wls"):
        assert row["status"] == "ok", row["reason"]
        assert row["torque_error"] < 1e-9 + bound.torque_error
    for row in executed(replace(made, plant={"use": "stribeck"}), "ols", "wls"):
        assert row["status"] == "ok", row["reason"]
        # Beside the weight of a floating robot its legs are small joints, which are listed apart.
        error = max(j["relative"] for j in row["joints"]) if row["free_base"] else None
        assert (error or row["torque_error"]) > 1e-4


def test_in_closed_loop_the_effect_is_felt_as_well() -> None:
    made = spec(robot="smooth/robot.toml", simulation=CLOSED_LOOP)
    (clean,) = executed(made, "ols")
    (dirty,) = executed(replace(made, plant={"use": "stribeck", "share": "30 %"}), "ols")
    assert clean["torque_error"] < 1e-8
    assert dirty["torque_error"] > 1e-4
