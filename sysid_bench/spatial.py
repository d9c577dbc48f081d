"""Rigid-body algebra: rotations, inertia and the ten parameters of a body."""

import numpy as np

from sysid_bench.types import Array


def skew(x: Array) -> Array:
    """Return [x]_x (..., 3, 3) with [x]_x y = x × y."""
    out = np.zeros((*x.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., k, j] = x[..., i]
        out[..., j, k] = -x[..., i]
    return out


def matrix_of_quaternion(quaternion: Array) -> Array:
    """Return R (..., 3, 3) of a quaternion (..., 4), which is normalised first."""
    w, x, y, z = np.moveaxis(quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True), -1, 0)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, axis=-1).reshape(*quaternion.shape[:-1], 3, 3)


def quaternion_of_matrix(R: Array) -> Array:
    """Return a unit quaternion (4,) of one rotation matrix (3, 3), w >= 0 (Shepperd 1978)."""
    # Divides by the largest component: a fixed one may be near zero.
    squares = np.array([np.trace(R), *np.diag(R)])
    largest = int(np.argmax(squares))
    q = np.empty(4)
    if largest == 0:
        q[0] = 1 + squares[0]
        q[1:] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q[0] = R[k, j] - R[j, k]
        q[1 + i] = 1 + R[i, i] - R[j, j] - R[k, k]
        q[1 + j], q[1 + k] = R[j, i] + R[i, j], R[k, i] + R[i, k]
    # w >= 0, so that one rotation has one quaternion.
    unit: Array = q / np.linalg.norm(q) * (1.0 if q[0] >= 0 else -1.0)
    return unit


def composed_rotation(left: Array, right: Array) -> Array:
    """Return the quaternion product (..., 4): the rotation `right`, then `left`."""
    a, b, c, d = np.moveaxis(left, -1, 0)
    w, x, y, z = np.moveaxis(right, -1, 0)
    parts = [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
    return np.stack(parts, axis=-1)


def urdf_quaternion(rpy: Array) -> Array:
    """Quaternion (4,) of roll, pitch, yaw about fixed axes, as in URDF."""
    total = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in enumerate(rpy):
        # About a fixed axis: each later turn multiplies from the left.
        turn = np.zeros(4)
        turn[0], turn[1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
        total = composed_rotation(turn, total)
    return total


def inverse_quaternion(quaternion: Array) -> Array:
    """Return the inverse rotation (..., 4) of a unit quaternion."""
    inverse: Array = quaternion * np.array([1.0, -1.0, -1.0, -1.0])
    return inverse


def quaternion_of_rotation(rotation_vector: Array) -> Array:
    """Return exp of a rotation vector (..., 3) as a unit quaternion (..., 4)."""
    angle = np.linalg.norm(rotation_vector, axis=-1, keepdims=True)
    # np.sinc is sin(pi x)/(pi x): smooth at zero, where a plain quotient is 0/0.
    half = 0.5 * np.sinc(angle / (2 * np.pi)) * rotation_vector
    return np.concatenate([np.cos(angle / 2), half], axis=-1)


def rotation_of_quaternion(quaternion: Array) -> Array:
    """Return the rotation vector (..., 3), at most pi long, of a unit quaternion (..., 4): its
    logarithm."""
    # q and -q are the same rotation; w >= 0 is the shorter way.
    turn = np.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    sine = np.linalg.norm(turn[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, turn[..., :1])
    vector: Array = turn[..., 1:] * np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 2.0)
    return vector


def body_rates(r: Array, dr: Array, ddr: Array) -> tuple[Array, Array]:
    """Return angular velocity and acceleration in the body frame (..., 3) of R = exp([r]_x).

    w = J dr with the right Jacobian J = 1 - c1 [r]_x + c2 [r]_x^2 of SO(3) (Chirikjian 2012,
    eq. 10.86), c1 = (1 - cos|r|)/|r|^2, c2 = (|r| - sin|r|)/|r|^3; its time derivative by the
    chain rule. Valid for |r| < 2 pi.
    """
    c1, c2, d1, d2 = _jacobian_series(np.linalg.norm(r, axis=-1, keepdims=True))
    rdot = np.sum(r * dr, axis=-1, keepdims=True)  # d(|r|^2)/dt / 2
    r_dr, r_ddr = np.cross(r, dr), np.cross(r, ddr)
    r_r_dr = np.cross(r, r_dr)
    w = dr - c1 * r_dr + c2 * r_r_dr
    change = -d1 * rdot * r_dr + d2 * rdot * r_r_dr
    change = change + c2 * np.cross(dr, r_dr)  # other terms of the product rule: dr × dr = 0
    return w, ddr - c1 * r_ddr + c2 * np.cross(r, r_ddr) + change


def _jacobian_series(angle: Array) -> tuple[Array, Array, Array, Array]:
    """c1, c2 and twice their derivatives by |r|^2, so that dc/dt = d * (r . dr)."""
    # Taylor series below 0.05 rad, where the closed forms lose digits by cancellation.
    small = angle < 0.05
    x = np.where(small, 1.0, angle)
    s, c, x2 = np.sin(x), np.cos(x), x * x
    t = np.where(small, angle, 0.0) ** 2
    c1 = np.where(small, 0.5 - t / 24 + t**2 / 720 - t**3 / 40320, (1 - c) / x2)
    c2 = np.where(small, 1 / 6 - t / 120 + t**2 / 5040 - t**3 / 362880, (x - s) / x**3)
    d1 = np.where(
        small, -1 / 12 + t / 180 - t**2 / 6720 + t**3 / 453600, (x * s - 2 * (1 - c)) / x2**2
    )
    d2 = np.where(
        small, -1 / 60 + t / 1260 - t**2 / 60480 + t**3 / 4989600, (3 * s - x * c - 2 * x) / x**5
    )
    return c1, c2, d1, d2


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
