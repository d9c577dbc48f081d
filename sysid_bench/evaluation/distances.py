"""How far apart two answers are, in ways that do not depend on frames or units."""

import numpy as np
from scipy.linalg import subspace_angles

from sysid_bench.spatial.inertia import pseudo_inertia
from sysid_bench.types import Array


def geodesic_distance(phi: Array, phi0: Array) -> Array:
    """The affine-invariant distance (...) of the pseudo-inertias of phi (..., 10) and phi0:
    |log(J0^-1/2 J J0^-1/2)| (Lee and Park 2018); infinite where one of them cannot exist."""
    values = _relative_eigenvalues(phi, phi0)
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = (np.log(values) ** 2).sum(axis=-1)
    return np.sqrt(np.where((values > 0).all(axis=-1), squares, np.inf))


def entropic_distance(phi: Array, phi0: Array) -> Array:
    """The log-det divergence (...) tr(J0^-1 J) - log det(J0^-1 J) - 4 of phi (..., 10) from phi0
    (Lee, Wensing, Park 2020); infinite where one of them cannot exist. Not symmetric."""
    values = _relative_eigenvalues(phi, phi0)
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = (values - np.log(values) - 1).sum(axis=-1)
    return np.where((values > 0).all(axis=-1), terms, np.inf)


def subspace_distance(A: Array, B: Array) -> float:
    """The largest principal angle (rad) between the columns of A (n, a) and B (n, b)."""
    return float(subspace_angles(A, B).max(initial=0.0))


def _relative_eigenvalues(phi: Array, phi0: Array) -> Array:
    """Eigenvalues (..., 4) of J0^-1 J; minus one where J0 is not positive definite."""
    J, J0 = np.broadcast_arrays(pseudo_inertia(phi), pseudo_inertia(phi0))
    solid = np.linalg.eigvalsh(J0)[..., 0] > 0
    roots = np.linalg.cholesky(np.where(solid[..., None, None], J0, np.eye(4)))
    half = np.linalg.solve(roots, J)
    values = np.linalg.eigvalsh(np.linalg.solve(roots, half.swapaxes(-1, -2)))
    return np.where(solid[..., None], values, -1.0)
