"""Bounds of the errors that near-degenerate directions leave in estimates from exact data.

The rank rule drops directions with singular values between 1e-12 and 1e-5 of the largest. Their
torque d is in the data and in no base parameter. Least squares then errs by W^+ d in beta, and the
prediction on held-out data by W_h W^+ d - d_h. Both are bounded by the size of d.

Two assumptions: the estimator is ordinary least squares on exact data (any other weighting has
another pseudo-inverse), and |d| along the motion is at most MOTION = 3 times its share at random
states, a measured factor. Tests of exact data compare with these bounds instead of rounding errors.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import solve_triangular

from sysid_bench.evaluation.torque_errors import RowErrors
from sysid_bench.identifiability.base_map import left_out_torque
from sysid_bench.identification.linear.least_squares import spread, stacked_factor
from sysid_bench.types import Array, Problem

MOTION: Final = 3.0
"""Largest dropped share of the torque along a motion over that at random states: in a motion, rates
and accelerations stand in another ratio to gravity (0.6 to 0.8 on the SO-ARM100)."""


@dataclass(frozen=True)
class DroppedBound:
    """Upper bounds of `beta_error` and `torque_error` of least squares on exact data; zero where no
    direction is near-degenerate."""

    beta_error: float = 0.0
    torque_error: float = 0.0


def dropped_bound(problem: Problem, held_out: Mapping[str, Problem], theta: Array) -> DroppedBound:
    """Return the bounds for the true parameters theta (p,): with |d| <= MOTION * dropped_torque *
    |tau|, |W^+ d| <= |d| / sigma_min(W) and |W_h W^+ d - d_h| <= |W_h R^-1| |d| + |d_h|, by row."""
    base = problem.base
    share = MOTION * left_out_torque(base, theta)
    if share == 0.0:
        return DroppedBound()
    r = base.rank
    R = stacked_factor(problem)[:r, :r]
    size = share * _size([problem])  # |d|
    beta = base.K @ theta
    tests = list(held_out.values())
    # |W^+| = 1 / sigma_min(W), and W has the singular values of R.
    return DroppedBound(
        beta_error=size / float(np.linalg.svd(R, compute_uv=False)[-1] * np.linalg.norm(beta)),
        torque_error=_torque_error(tests, R, size, share, beta) if tests else 0.0,
    )


def _size(problems: list[Problem]) -> float:
    """Norm of the torque of all rows and samples."""
    rms = RowErrors(problems, np.zeros(problems[0].base.rank)).rms
    return float(np.sqrt((rms**2).sum() * sum(problem.samples for problem in problems)))


def _torque_error(tests: list[Problem], R: Array, size: float, share: float, beta: Array) -> float:
    """RMS over the judged rows of (|W_i R^-1| size + share of all torque) / |tau_i|."""
    judged, r = RowErrors(tests, beta), len(R)
    errors = []
    for i in np.flatnonzero(judged.loaded_rows):
        W = np.concatenate([spread(problem.factors[i], r)[:, :r] for problem in tests])
        gain = float(np.linalg.norm(solve_triangular(R, W.T, trans="T"), 2))
        torque = judged.rms[i] * np.sqrt(sum(problem.samples for problem in tests))
        errors.append((gain * size + share * _size(tests)) / torque)
    return float(np.sqrt(np.mean(np.square(errors)))) if errors else 0.0
