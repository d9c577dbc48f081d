"""Continuation in the limits: a motion is designed within wide limits, which then tighten in steps.

A search within a narrow box stalls near its start. From the best motion without the box, and with
the box shrunk about its middle step by step, each search starts close to its answer.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.excitation.design_cost import DesignCost
from sysid_bench.excitation.limit_use import Limit
from sysid_bench.excitation.search import LOOSE, TIGHTEST, Search
from sysid_bench.types import Array

STEPS: Final = (2.0, 1.5, 1.2)
"""Factors of the limits, the widest first; a search without them precedes."""

_SHARES: Final = (0.27, 0.2, 0.5)
"""Shares of the iterations of each search without the limits, at each step, and within them."""

WIDENED: Final = ("box",)
"""Kinds of limits that a continuation widens: a fixed share of them is a motion about a centre."""


@dataclass(frozen=True)
class Continuation:
    """Least criterion without the widened limits, and True after an interrupt by the user."""

    without: float
    interrupted: bool


def has_continuation(limits: Collection[Limit]) -> bool:
    """Return True if some of the limits are of a kind that a continuation widens."""
    return any(limit.kind in WIDENED for limit in limits)


def run_continuation(evaluation: DesignCost, C: Array, iterations: int) -> Continuation:
    """Search from C (m, k) without the limits of the kinds `WIDENED`, then with these ever tighter.

    The motions found within all limits join those that `evaluation` has kept.
    """
    without, interrupted = np.inf, False
    for factor, share in zip((np.inf, *STEPS, 1.0), _shares(), strict=True):
        stage = _stage(evaluation, factor)
        search, count = Search(stage), max(round(share * iterations), 1)
        end = search.solve_bounded(C, count, _sharpness(factor))
        C = stage.kept[-1][1] if stage.kept else end
        evaluation.evaluations += stage.evaluations
        without = stage.best if factor == np.inf else without
        interrupted = search.interrupted
        if interrupted:
            break
    if factor == 1.0:
        evaluation.kept = sorted([*evaluation.kept, *stage.kept], key=lambda kept: -kept[0])
    return Continuation(float(without), interrupted)


def _sharpness(factor: float) -> tuple[float, ...]:
    """Exponents of the searches with limits `factor` times as wide."""
    if factor == np.inf:
        return LOOSE, TIGHTEST[0]
    return TIGHTEST if factor == 1.0 else TIGHTEST[:1]


def _shares() -> list[float]:
    return [_SHARES[0]] + [_SHARES[1]] * len(STEPS) + [_SHARES[2]]


def _stage(evaluation: DesignCost, factor: float) -> DesignCost:
    """An evaluation of its own, with the limits of the kinds `WIDENED` `factor` times as wide."""
    return replace(
        evaluation,
        limits=tuple(scale_limits(evaluation.limits, WIDENED, factor)),
        progress=lambda count, value: None,
        evaluations=0,
        kept=[],
        nearest=(np.inf, ""),
    )


def scale_limits(
    limits: Collection[Limit], kinds: Collection[str], factor: float
) -> Iterator[Limit]:
    """Yield limits with those of these kinds `factor` times as wide; left out where it is
    infinite."""
    for limit in limits:
        if limit.kind not in kinds:
            yield limit
        elif np.isfinite(factor):
            yield _scaled(limit, factor)


def _scaled(limit: Limit, factor: float) -> Limit:
    return replace(
        limit,
        use=lambda motion: limit.use(motion) / factor,
        slopes=lambda motion, G: limit.slopes(motion, G / factor),
    )
