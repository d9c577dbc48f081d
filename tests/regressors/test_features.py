"""Laws of features: hysteresis that forgets nothing and knows no rate, columns on their own row."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_bench.plugin_names import build, known
from sysid_bench.regressors.joint_features import Play, Polynomial, SmoothFriction, features_of
from tests.closeness import assert_close
from tests.robots import named_robot, states

T = np.linspace(0, 10, 2000)


@given(st.integers(0, 1000), st.floats(0.002, 0.3))
def test_play_is_bounded_and_knows_no_rate(seed: int, width: float) -> None:
    rng = np.random.default_rng(seed)
    q = np.sin(T * rng.uniform(0.5, 3)) + 0.5 * np.sin(T * rng.uniform(3, 7))
    reach = (float(q.min()), float(q.max()))
    play = Play(width).values(q, np.gradient(q, T), reach)[:, 0]
    assert np.abs(play).max() <= 1 + 1e-9
    slowly = np.repeat(q, 3)
    again = Play(width).values(slowly, np.gradient(q, T).repeat(3), reach)[:, 0]
    np.testing.assert_allclose(again[2::3], play, atol=1e-9)


def test_narrow_play_is_coulomb_friction() -> None:
    q = np.sin(T)
    v = np.cos(T)
    play = Play(1e-6).values(q, v, (-1.0, 1.0))[1:, 0]
    # The play looks back: its sign is that of the last step.
    np.testing.assert_array_equal(np.round(play, 9), np.sign(np.diff(q)))


def test_polynomials_hold_beyond_their_reach() -> None:
    q = np.linspace(-2, 4, 50)
    x = Polynomial(3).values(q, q, (0.0, 2.0))
    assert np.abs(x).max() <= 1.0
    inside = (q > 0) & (q < 2)
    assert_close(x[inside, 1], (q[inside] - 1) ** 2)


def test_names_and_places() -> None:
    robot = named_robot("ur5")
    motion = states(robot, 30)
    features = [build("term", name) for name in known("term")]
    joints = robot.rows[:3]
    table = features_of(features, joints, [(j.qadr, j.vadr) for j in robot.joints[:3]], [motion])
    assert len(set(table.columns)) == len(table.columns) == 3 * 7
    chosen = [c for c in table.columns if c.startswith(f"{joints[1]}.")][::-1]
    values = table.of_joint(joints[1], motion, chosen)
    assert values.shape == (30, 7)
    for i, name in enumerate(chosen):
        np.testing.assert_array_equal(table.of_joint(joints[1], motion, [name])[:, 0], values[:, i])
    assert table.of_joint(joints[0], motion, chosen).shape == (30, 0)


@pytest.mark.parametrize("scale", [0.01, 0.1])
def test_smooth_friction_is_coulomb_far_from_rest(scale: float) -> None:
    v = np.linspace(-1, 1, 200)
    smooth = SmoothFriction(scale).values(v, v, (0, 1))[:, 0]
    far = np.abs(v) > 5 * scale
    np.testing.assert_allclose(smooth[far], np.sign(v)[far], atol=1e-3)
