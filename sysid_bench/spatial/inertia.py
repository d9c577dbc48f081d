"""Inertial parameters of a rigid body: phi (10,) about the origin of a frame, in its axes.

phi = [m, hx, hy, hz, Ixx, Ixy, Ixz, Iyy, Iyz, Izz] with h = m c and I about the origin. The
pseudo-inertia J = [[tr(I)/2 1 - I, h], [h', m]] (Wensing, Kim, Slotine 2018, eq. 12) is linear in
phi, and a body is physically possible iff J is positive semidefinite.
"""

import numpy as np

from sysid_bench.types import Array

NAMES = ("m", "hx", "hy", "hz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def inertia_values(matrix: Array) -> Array:
    """Return Ixx Ixy Ixz Iyy Iyz Izz (..., 6) of a symmetric matrix (..., 3, 3)."""
    return np.stack([matrix[..., i, j] for i, j in _PAIRS], axis=-1)


def inertia_matrix(six: Array) -> Array:
    """Return the symmetric matrix (..., 3, 3) of Ixx Ixy Ixz Iyy Iyz Izz (..., 6)."""
    matrix = np.zeros((*six.shape[:-1], 3, 3), dtype=six.dtype)
    for k, (i, j) in enumerate(_PAIRS):
        matrix[..., i, j] = matrix[..., j, i] = six[..., k]
    return matrix


def phi_of(mass: float, com: Array, inertia: Array) -> Array:
    """Return phi (10,) of a mass (kg), centre of mass c (3,) (m) and inertia (3, 3) about it (kg
    m^2).

    Steiner: I = I_c + m (c'c 1 - c c') about the origin.
    """
    com = np.asarray(com, dtype=float)
    about_origin = inertia + mass * (com @ com * np.eye(3) - np.outer(com, com))
    return np.concatenate([[mass], mass * com, inertia_values(about_origin)])


def body_mass_inertia(phi: Array) -> tuple[float, Array, Array]:
    """Return mass (kg), centre of mass (3,) and inertia (3, 3) about it; the com of a massless body
    is zero."""
    mass, h = float(phi[0]), phi[1:4]
    com = h / mass if mass != 0.0 else np.zeros(3)
    return mass, com, inertia_matrix(phi[4:]) - mass * (com @ com * np.eye(3) - np.outer(com, com))


def gyration(phi: Array) -> float:
    """Return the radius of gyration (m) of phi (10,), sqrt(tr(I) / (2 m)) about the centre of mass;
    0 without a mass."""
    mass, _, inertia = body_mass_inertia(phi)
    return float(np.sqrt(max(np.trace(inertia), 0.0) / (2 * mass))) if mass > 0 else 0.0


def pseudo_inertia(phi: Array) -> Array:
    """Return J (..., 4, 4) of phi (..., 10)."""
    J = np.empty((*phi.shape[:-1], 4, 4), dtype=phi.dtype)
    half = 0.5 * (phi[..., 4] + phi[..., 7] + phi[..., 9])
    for k, (i, j) in enumerate(_PAIRS):
        value = phi[..., 4 + k]
        J[..., i, j] = J[..., j, i] = half - value if i == j else -value
    J[..., :3, 3] = J[..., 3, :3] = phi[..., 1:4]
    J[..., 3, 3] = phi[..., 0]
    return J


def phi_of_pseudo_inertia(J: Array) -> Array:
    """Return phi (..., 10) of J (..., 4, 4)."""
    second = J[..., :3, :3]
    trace = np.trace(second, axis1=-2, axis2=-1)[..., None, None]
    inertia = trace * np.eye(3) - second
    return np.concatenate(
        [J[..., 3, 3][..., None], J[..., :3, 3], inertia_values(inertia)], axis=-1
    )


def inertia_transform(R_ab: Array, p_ab: Array) -> Array:
    """Return X (10, 10) with phi_a = X phi_b, for frame b at p_ab (3,) with axes R_ab (3, 3) in a.

    The pseudo-inertia transforms as J_a = H J_b H' with the homogeneous matrix H.
    """
    H = np.eye(4)
    H[:3, :3], H[:3, 3] = R_ab, p_ab
    return phi_of_pseudo_inertia(H @ pseudo_inertia(np.eye(10)) @ H.T).T


def pseudo_inertia_distance(phi: Array, other: Array) -> float | None:
    """Return the distance sqrt(sum_i ln(l_i)^2) of two bodies phi (10,), l_i the eigenvalues of
    J^-1 J'; None where a pseudo-inertia is not positive definite.

    Geodesic distance of the affine-invariant metric (Lee and Park 2018): a change of frame or of
    units H maps J to H J H', which leaves it as it is.
    """
    # The trace as the scale: a body that is flat up to rounding has no distance.
    for J in (pseudo_inertia(phi), pseudo_inertia(other)):
        if not np.linalg.eigvalsh(J)[0] > 1e-12 * np.trace(J):
            return None
    # The eigenvalues of J^-1 J' are those of the symmetric L^-1 J' L^-T with J = L L'.
    L = np.linalg.cholesky(pseudo_inertia(phi))
    half = np.linalg.solve(L, pseudo_inertia(other))
    values = np.linalg.eigvalsh(np.linalg.solve(L, half.T))
    return float(np.linalg.norm(np.log(values)))


def feasible_margins(phi: Array) -> Array:
    """Return the smallest eigenvalue (...) of the pseudo-inertia of phi (..., 10); a body is
    physically possible iff it is >= 0."""
    return np.linalg.eigvalsh(pseudo_inertia(phi))[..., 0]
