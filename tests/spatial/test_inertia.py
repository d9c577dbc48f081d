"""The ten numbers: three ways to write them are one, and moving a frame moves the masses."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_bench.spatial import (
    body_mass_inertia,
    feasible_margins,
    inertia_matrix,
    inertia_transform,
    inertia_values,
    phi_of,
    phi_of_pseudo_inertia,
    pseudo_inertia,
    pseudo_inertia_distance,
)
from tests.closeness import assert_close
from tests.robots import cloud_phi, random_phi, random_rotation

SEEDS = st.integers(0, 2**32 - 1)


@given(seed=SEEDS)
def test_body_mass_inertia_there_and_back(seed: int) -> None:
    phi = random_phi(np.random.default_rng(seed))
    np.testing.assert_allclose(phi_of(*body_mass_inertia(phi)), phi, rtol=1e-12, atol=1e-12)


@given(seed=SEEDS)
def test_pseudo_inertia_there_and_back(seed: int) -> None:
    numbers = np.random.default_rng(seed).normal(size=(3, 2, 10))  # any ten, possible or not
    back = phi_of_pseudo_inertia(pseudo_inertia(numbers))
    np.testing.assert_allclose(back, numbers, rtol=1e-13, atol=1e-13)


@given(seed=SEEDS)
def test_six_numbers_there_and_back(seed: int) -> None:
    six = np.random.default_rng(seed).normal(size=(4, 6))
    matrix = inertia_matrix(six)
    np.testing.assert_array_equal(inertia_values(matrix), six)
    np.testing.assert_array_equal(matrix, np.swapaxes(matrix, -1, -2))


@given(seed=SEEDS)
def test_the_pseudo_inertia_is_the_second_moment_of_the_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    masses, points = rng.uniform(0.1, 2, 8), rng.normal(size=(8, 3))
    homogeneous = np.column_stack([points, np.ones(8)])
    J = np.einsum("k,ki,kj->ij", masses, homogeneous, homogeneous)
    np.testing.assert_allclose(pseudo_inertia(cloud_phi(masses, points)), J, rtol=1e-12, atol=1e-12)


@given(seed=SEEDS)
def test_transport_moves_the_masses(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R_ab, p_ab = random_rotation(rng), rng.normal(size=3)
    masses, points_b = rng.uniform(0.1, 2, 8), rng.normal(size=(8, 3))
    phi_a = cloud_phi(masses, points_b @ R_ab.T + p_ab)
    moved = inertia_transform(R_ab, p_ab) @ cloud_phi(masses, points_b)
    np.testing.assert_allclose(moved, phi_a, rtol=1e-11, atol=1e-11)


@given(seed=SEEDS)
def test_transport_is_a_representation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R_ab, R_bc = random_rotation(rng), random_rotation(rng)
    p_ab, p_bc = rng.normal(size=(2, 3))
    X_ac = inertia_transform(R_ab @ R_bc, p_ab + R_ab @ p_bc)
    np.testing.assert_allclose(
        X_ac, inertia_transform(R_ab, p_ab) @ inertia_transform(R_bc, p_bc), atol=1e-12
    )
    back = inertia_transform(R_ab.T, -R_ab.T @ p_ab)
    np.testing.assert_allclose(back @ inertia_transform(R_ab, p_ab), np.eye(10), atol=1e-12)


@given(seed=SEEDS)
def test_a_body_exists_in_every_frame_or_in_none(seed: int) -> None:
    rng = np.random.default_rng(seed)
    X = inertia_transform(random_rotation(rng), rng.normal(size=3))
    possible = random_phi(rng)
    impossible = possible - 2 * feasible_margins(possible) * phi_of_pseudo_inertia(np.eye(4))
    assert feasible_margins(possible) > 0
    assert feasible_margins(X @ possible) > 0
    assert feasible_margins(impossible) < 0
    assert feasible_margins(X @ impossible) < 0


def test_leading_axes_are_free() -> None:
    phi = random_phi(np.random.default_rng(0), 4, 3)
    one_by_one = [[feasible_margins(body) for body in row] for row in phi]
    assert_close(feasible_margins(phi), one_by_one, 1e-12)


def test_a_massless_body_has_its_centre_at_the_origin() -> None:
    mass, com, inertia = body_mass_inertia(np.zeros(10))
    assert mass == 0.0
    assert not com.any()
    assert not inertia.any()


@pytest.mark.parametrize("axis", range(3))
def test_a_thin_rod_has_the_moments_of_the_textbooks(axis: int) -> None:
    """m l²/12 about the centre, m l²/3 about an end."""
    mass, length = 3.0, 0.7
    across = np.ones(3)
    across[axis] = 0.0
    end = np.zeros(3)
    end[axis] = length / 2
    phi = phi_of(mass, end, np.diag(mass * length**2 / 12 * across))
    assert_close(inertia_matrix(phi[4:]), np.diag(mass * length**2 / 3 * across))


@given(seed=SEEDS)
def test_the_distance_of_bodies_is_that_of_a_metric_in_every_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b, c = (random_phi(rng) for _ in range(3))
    X = inertia_transform(random_rotation(rng), rng.normal(size=3))
    ab, bc, ac, moved = (
        pseudo_inertia_distance(*pair) for pair in ((a, b), (b, c), (a, c), (X @ a, X @ b))
    )
    assert ab is not None
    assert bc is not None
    assert ac is not None
    assert moved == pytest.approx(ab, rel=1e-6)
    assert pseudo_inertia_distance(b, a) == pytest.approx(ab, rel=1e-9)
    assert pseudo_inertia_distance(a, a) == pytest.approx(0.0, abs=1e-6)
    assert ac <= ab + bc + 1e-9
    # All four eigenvalues are the ratio where a body is the same with k times the density.
    assert pseudo_inertia_distance(a, 3.0 * a) == pytest.approx(2.0 * np.log(3.0))


def test_bodies_that_cannot_exist_have_no_distance() -> None:
    rng = np.random.default_rng(0)
    body = random_phi(rng)
    point = phi_of(1.0, np.array([0.1, 0.0, 0.2]), np.zeros((3, 3)))
    for impossible in (-body, point, np.zeros(10)):
        assert pseudo_inertia_distance(body, impossible) is None
        assert pseudo_inertia_distance(impossible, body) is None
