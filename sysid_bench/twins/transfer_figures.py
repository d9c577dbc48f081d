"""What a simulated comparison of methods predicts of the recorded one, pair by pair of methods."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from sysid_bench.types import Array

CLAIMED: Final = float(np.log(1.10))
"""Difference of logarithms of errors from which on a pair of methods is said to differ."""

EQUAL: Final = float(np.log(1.05))
"""Difference up to which a pair is equal."""

DRAWS: Final = 2000
"""Draws of the bootstrap over robots."""

FEWEST: Final = 5
"""Robots with pairs below which there is no interval."""

Errors = Mapping[str, float]
"""Torque error of each method on one test motion."""


@dataclass(frozen=True)
class PairCounts:
    """Pairs of methods of one robot: `claimed` differ in simulation, `false` of them are reversed
    or equal in reality; `real` differ in reality by more than their own spread over tests, `found`
    of them differ in simulation, too, and in the same direction. `misfit`: mean difference of
    ln(e / e_wls); `level`: error of wls in simulation over that in reality."""

    claimed: int
    false: int
    real: int
    found: int
    misfit: float
    level: float


@dataclass(frozen=True)
class Share:
    """A share of `pairs` of all robots with its 95 % interval from a bootstrap; None where there is
    none."""

    value: float | None
    low: float | None
    high: float | None
    pairs: int


def pair_counts(simulated: Sequence[Errors], real: Sequence[Errors], reference: str) -> PairCounts:
    """Return the counts of one robot, from the errors of each test in simulation and reality.

    Logarithms of errors are averaged over the tests; methods that failed in one are left out.
    """
    methods = sorted(set.intersection(*(set(one) for one in (*simulated, *real))))
    claims = [_claim(simulated, real, a, b) for a, b in combinations(methods, 2)]
    claimed = [(s, r) for s, r, _ in claims if abs(s) > CLAIMED]
    found = [(s, r) for s, r, spread in claims if abs(r) > max(CLAIMED, spread)]
    ratios = [
        abs(_difference(simulated, m, reference) - _difference(real, m, reference))
        for m in methods
        if m != reference
    ]
    return PairCounts(
        claimed=len(claimed),
        false=sum(s * r < 0 or abs(r) < EQUAL for s, r in claimed),
        real=len(found),
        found=sum(s * r > 0 and abs(s) > EQUAL for s, r in found),
        misfit=float(np.mean(ratios)) if ratios else np.nan,
        level=float(np.exp(_mean_log(simulated, reference) - _mean_log(real, reference))),
    )


def share_over_robots(
    counts: Sequence[PairCounts], part: Callable[[PairCounts], tuple[int, int]], seed: int = 0
) -> Share:
    """Return a share of pairs, `part` of one robot being (part, whole), with whole robots
    resampled."""
    table = np.array([part(one) for one in counts], dtype=float).reshape(-1, 2)
    total = table.sum(axis=0)
    value = float(total[0] / total[1]) if len(table) and total[1] > 0 else None
    # Robots without any such pair say nothing of the scatter between robots.
    if int((table[:, 1] > 0).sum()) < FEWEST or value is None:
        return Share(value, None, None, int(total[1]))
    low, high = np.percentile(list(_resampled(table, seed)), [2.5, 97.5])
    return Share(value, float(low), float(high), int(total[1]))


def _resampled(table: Array, seed: int) -> Iterator[float]:
    rng = np.random.default_rng(seed)
    for chosen in rng.integers(len(table), size=(DRAWS, len(table))):
        part, whole = table[chosen].sum(axis=0)
        if whole > 0:
            yield float(part / whole)


def _claim(
    simulated: Sequence[Errors], real: Sequence[Errors], a: str, b: str
) -> tuple[float, float, float]:
    """Difference of the logarithms of two methods in simulation and in reality, and half of its
    range over the tests of reality."""
    each = [np.log(one[a] / one[b]) for one in real]
    return _difference(simulated, a, b), _difference(real, a, b), float(np.ptp(each)) / 2


def _difference(tests: Sequence[Errors], a: str, b: str) -> float:
    return _mean_log(tests, a) - _mean_log(tests, b)


def _mean_log(tests: Sequence[Errors], method: str) -> float:
    return float(np.mean([np.log(one[method]) for one in tests]))
