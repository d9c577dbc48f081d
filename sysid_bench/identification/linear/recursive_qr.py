"""Square-root updates of [R | z] with forgetting, for recursive estimators."""

import numpy as np

from sysid_bench.qr_factor import qr_factor
from sysid_bench.types import Array, Problem


def update(problem: Problem, sigma: Array, forgetting: float) -> Array:
    """R (r + 1, r + 1) of all samples, rows divided by `sigma` (rows,), sample k of N times
    forgetting^((N - 1 - k) / 2): exponential forgetting of the squares."""
    R = np.zeros((problem.base.rank + 1,) * 2)
    for Y, b in problem.blocks():
        # R holds square roots of weights: hence half of the exponent.
        R = rank_update(R * forgetting ** (0.5 * len(b)), Y, b, sigma, forgetting)
    return R


def rank_update(R: Array, Y: Array, b: Array, sigma: Array, forgetting: float = 1.0) -> Array:
    """R (r + 1, r + 1) updated by the rows (n, rows, r) and torques (n, rows) of one block."""
    root = forgetting ** (0.5 * np.arange(len(b) - 1, -1, -1))[:, None] / sigma
    rows = np.concatenate([Y * root[..., None], (b * root)[..., None]], axis=-1)
    return qr_factor([R, rows.reshape(-1, len(R))])
