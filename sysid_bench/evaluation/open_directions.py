"""Directions of the base parameters that the data leave open: noise decides what they are."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.identification.linear.least_squares import EXCITED, stacked_factor
from sysid_bench.types import Problem

NAMED: Final = 3
"""Base parameters that are named, those with the largest share in open directions."""


@dataclass(frozen=True)
class OpenDirections:
    """`count` of `rank` directions are open; `names`: base parameters with the largest share."""

    count: int
    rank: int
    names: tuple[str, ...] = ()


def open_directions(problem: Problem) -> OpenDirections:
    """Return the directions whose standard deviation exceeds the whole answer.

    With columns of unit length the torque b of N samples is U S V' x + e. White residuals of the
    least-squares fit leave v_i' x a deviation of |e| / (sqrt(N) s_i); the torque along the best
    excited direction is that of |x| = |b| / s_1. A direction whose deviation is larger is open, and
    so is one without excitation. Residuals of real data are correlated, which makes this lenient.
    """
    r = problem.base.rank
    stacked = stacked_factor(problem)
    R, b = stacked[:r, :r], stacked[:, r]
    norms = np.linalg.norm(R, axis=0)
    if not norms.any():
        return OpenDirections(r, r, tuple(problem.base.names[:NAMED]))
    _, s, Vt = np.linalg.svd(R / np.where(norms > 0, norms, 1.0))
    # |e| / (sqrt(N) |b|) of the fit: the last entry of Q'b is the norm of the residual.
    torque, count = np.linalg.norm(b), max(problem.samples * len(problem.rows), 1)
    noise = float(abs(b[-1]) / torque / np.sqrt(count)) if torque > 0 else 0.0
    is_open = s <= max(EXCITED, noise) * s[0]
    shares = (Vt[is_open] ** 2).sum(axis=0)
    order = np.argsort(-shares, kind="stable")[: min(NAMED, int(is_open.sum()))]
    return OpenDirections(int(is_open.sum()), r, tuple(problem.base.names[i] for i in order))
