"""Rotations: quaternions compose as their matrices do, and rates are exact derivatives."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from sysid_bench.spatial import (
    body_rates,
    composed_rotation,
    inverse_quaternion,
    matrix_of_quaternion,
    quaternion_of_matrix,
    quaternion_of_rotation,
    skew,
)
from sysid_bench.types import Array
from tests.closeness import assert_close
from tests.robots import random_rotation

SEEDS = st.integers(0, 2**32 - 1)
ANGLES = (0.0, 1e-12, 1e-6, 1e-3, 0.049999, 0.050001, 0.3, 1.0, 2.0, 2.999, 3.1, np.pi, 4.0, 5.5)


@st.composite
def quaternions(draw: st.DrawFn) -> Array:
    """Unit quaternions, the half turns and the identity among them."""
    parts = draw(st.lists(st.sampled_from([0.0, 1.0, -1.0, 1e-9, 0.5]), min_size=4, max_size=4))
    q = np.array(parts) + draw(st.sampled_from([0.0, 1.0])) * _normal(draw(SEEDS))
    length = np.linalg.norm(q)
    return q / length if length > 1e-6 else np.array([1.0, 0.0, 0.0, 0.0])


def _normal(seed: int) -> Array:
    return np.random.default_rng(seed).normal(size=4)


@given(q=quaternions())
def test_a_quaternion_gives_a_rotation(q: Array) -> None:
    R = matrix_of_quaternion(q)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(R) == pytest.approx(1.0)


@given(q=quaternions(), r=quaternions())
def test_products_compose(q: Array, r: Array) -> None:
    together = matrix_of_quaternion(composed_rotation(q, r))
    np.testing.assert_allclose(
        together, matrix_of_quaternion(q) @ matrix_of_quaternion(r), atol=1e-14
    )


@given(q=quaternions())
def test_the_conjugate_is_the_inverse(q: Array) -> None:
    np.testing.assert_allclose(
        composed_rotation(q, inverse_quaternion(q)), [1, 0, 0, 0], atol=1e-15
    )
    np.testing.assert_allclose(
        matrix_of_quaternion(inverse_quaternion(q)), matrix_of_quaternion(q).T, atol=1e-14
    )


@given(q=quaternions(), scale=st.floats(1e-3, 1e3))
def test_length_and_sign_do_not_matter(q: Array, scale: float) -> None:
    R = matrix_of_quaternion(q)
    np.testing.assert_allclose(matrix_of_quaternion(-scale * q), R, atol=1e-14)


@given(q=quaternions())
def test_matrix_and_back(q: Array) -> None:
    back = quaternion_of_matrix(matrix_of_quaternion(q))
    assert back[0] >= 0
    assert np.linalg.norm(back) == pytest.approx(1.0, abs=1e-15)
    np.testing.assert_allclose(matrix_of_quaternion(back), matrix_of_quaternion(q), atol=1e-13)


@given(seed=SEEDS)
def test_any_rotation_matrix_is_met_again(seed: int) -> None:
    R = random_rotation(np.random.default_rng(seed))
    np.testing.assert_allclose(matrix_of_quaternion(quaternion_of_matrix(R)), R, atol=1e-14)


@given(seed=SEEDS, angle=st.sampled_from(ANGLES))
def test_a_rotation_vector_is_the_matrix_exponential(seed: int, angle: float) -> None:
    r = _of_length(angle, seed)
    R = matrix_of_quaternion(quaternion_of_rotation(r))
    np.testing.assert_allclose(R, expm(skew(r)), atol=1e-13)


@given(seed=SEEDS)
def test_skew_is_the_cross_product(seed: int) -> None:
    x, y = np.random.default_rng(seed).normal(size=(2, 5, 3))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", skew(x), y), np.cross(x, y), atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_body_rates_are_those_of_the_matrix_exponential(angle: float) -> None:
    for seed in range(5):
        r = _of_length(angle, seed)
        dr, ddr = np.random.default_rng(100 + seed).normal(size=(2, 3))
        w, alpha = body_rates(r, dr, ddr)
        exact_w, exact_alpha = _rates_of_the_exponential(r, dr, ddr)
        np.testing.assert_allclose(w, exact_w, atol=1e-11)
        np.testing.assert_allclose(alpha, exact_alpha, atol=1e-10)


@pytest.mark.parametrize("angle", ANGLES)
def test_body_rates_are_difference_quotients(angle: float) -> None:
    r0 = _of_length(angle, 1)
    dr, ddr = np.random.default_rng(101).normal(size=(2, 3))  # not along r0
    h = 1e-4
    t = h * np.arange(-2, 3)[:, None]
    R = matrix_of_quaternion(quaternion_of_rotation(r0 + dr * t + 0.5 * ddr * t**2))
    dR = (R[0] - 8 * R[1] + 8 * R[3] - R[4]) / (12 * h)
    ddR = (-R[0] + 16 * R[1] - 30 * R[2] + 16 * R[3] - R[4]) / (12 * h**2)
    w, alpha = body_rates(r0, dr, ddr)
    np.testing.assert_allclose(skew(w), R[2].T @ dR, atol=1e-9)
    np.testing.assert_allclose(skew(alpha), R[2].T @ ddR + dR.T @ dR, atol=1e-6)


def test_body_rates_take_whole_motions() -> None:
    r, dr, ddr = np.random.default_rng(0).normal(size=(3, 7, 3)) * [[[0.02]], [[1.0]], [[1.0]]]
    r[3:] *= 50  # small and large angles in one call
    w, alpha = body_rates(r, dr, ddr)
    for k in range(7):
        one = body_rates(r[k], dr[k], ddr[k])
        assert_close(w[k], one[0], 1e-14)
        assert_close(alpha[k], one[1], 1e-13)


def _of_length(angle: float, seed: int) -> Array:
    direction = np.random.default_rng(seed).normal(size=3)
    return angle * direction / np.linalg.norm(direction)


def _rates_of_the_exponential(r: Array, dr: Array, ddr: Array) -> tuple[Array, Array]:
    """exp of [[A, A', A''/2], [0, A, A'], [0, 0, A]] holds R, R' and R''/2 in its first row."""
    A, dA, ddA = skew(r), skew(dr), skew(ddr)
    zero = np.zeros((3, 3))
    E = expm(np.block([[A, dA, ddA / 2], [zero, A, dA], [zero, zero, A]]))
    R, dR, ddR = E[:3, :3], E[:3, 3:6], 2 * E[:3, 6:]
    return _axis(R.T @ dR), _axis(R.T @ ddR + dR.T @ dR)


def _axis(K: Array) -> Array:
    return np.array([K[2, 1], K[0, 2], K[1, 0]])
