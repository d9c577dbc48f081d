"""Distances between estimates that do not depend on the choice of frames or units."""

import numpy as np
from scipy.linalg import subspace_angles

from sysid_bench.spatial.inertia import pseudo_inertia
from sysid_bench.types import Array


def geodesic_distance(phi: Array, phi0: Array) -> Array:
    """Return the affine-invariant Riemannian distance (...) between inertial parameters phi and
    phi0, (..., 10) each.

    |log(J0^-1/2 J J0^-1/2)| of their pseudo-inertias (Lee and Park 2018); infinite if one of them
    is not positive definite.
    """
    values = _relative_eigenvalues(phi, phi0)
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = (np.log(values) ** 2).sum(axis=-1)
    return np.asarray(np.sqrt(np.where((values > 0).all(axis=-1), squares, np.inf)))


def entropic_distance(phi: Array, phi0: Array) -> Array:
    """Return the log-det divergence (...) of inertial parameters phi from phi0, (..., 10) each.

    tr(J0^-1 J) - log det(J0^-1 J) - 4 of their pseudo-inertias (Lee, Wensing and Park 2020); not
    symmetric; infinite if one of them is not positive definite.
    """
    values = _relative_eigenvalues(phi, phi0)
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = (values - np.log(values) - 1).sum(axis=-1)
    return np.where((values > 0).all(axis=-1), terms, np.inf)


def subspace_distance(A: Array, B: Array) -> float:
    """Return the largest principal angle (rad) between the column spaces of A (n, a) and B (n, b);
    pi / 2 if a and b differ.

    With A = K1^T and B = K2^T it is zero iff two base maps identify the same combinations.
    """
    if A.shape[1] != B.shape[1]:
        return float(np.pi / 2)
    return float(subspace_angles(A, B).max(initial=0.0)) if A.shape[1] else 0.0


def _relative_eigenvalues(phi: Array, phi0: Array) -> Array:
    """Eigenvalues (..., 4) of J0^-1 J; minus one where J0 is not positive definite."""
    J, J0 = np.broadcast_arrays(pseudo_inertia(phi), pseudo_inertia(phi0))
    definite = np.linalg.eigvalsh(J0)[..., 0] > 0
    roots = np.linalg.cholesky(np.where(definite[..., None, None], J0, np.eye(4)))
    half = np.linalg.solve(roots, J)
    values = np.linalg.eigvalsh(np.linalg.solve(roots, half.swapaxes(-1, -2)))
    return np.where(definite[..., None], values, -1.0)
