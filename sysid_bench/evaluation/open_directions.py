"""Directions of the base parameters that the data leave open: noise decides what they are."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.identification.linear.least_squares import direction_deviations
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
    """Return the directions whose standard deviation exceeds the whole answer, those without
    excitation among them (`direction_deviations`)."""
    deviations, Vt = direction_deviations(problem)
    is_open = deviations >= 1.0
    shares = (Vt[is_open] ** 2).sum(axis=0)
    order = np.argsort(-shares, kind="stable")[: min(NAMED, int(is_open.sum()))]
    names = tuple(problem.base.names[i] for i in order)
    return OpenDirections(int(is_open.sum()), problem.base.rank, names)
