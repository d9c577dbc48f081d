"""Batch least squares with a prior: the reference of the recursive estimators."""

import numpy as np

from sysid_bench.types import Array


def batch_estimate(
    W: Array, f: Array, sigma: Array, prior: Array, std: Array, free: Array | None = None
) -> Array:
    """Return beta (r,) of the recursion without forgetting, as one least-squares solution."""
    keep = slice(None) if free is None else np.asarray(free, dtype=bool)
    G, g = (W / sigma[:, None])[keep], (f / sigma)[keep]
    root = np.diag(1.0 / std) if std.ndim == 1 else np.linalg.inv(np.linalg.cholesky(std))
    stack = np.vstack([G.reshape(-1, G.shape[-1]), root])
    values = np.concatenate([g.ravel(), root @ prior])
    return np.asarray(np.linalg.lstsq(stack, values, rcond=None)[0])
