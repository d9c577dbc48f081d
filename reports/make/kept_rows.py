"""Rows that are computed again on any processor: with the designed motions that a search has found,
and within the spread that last bits of the data alone make.

A search of a motion, and a solver that stops at a tolerance, depend on how a processor rounds; the
answers of copies of the data with other last bits scatter as those of processors do.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Final
from unittest.mock import patch

import numpy as np

from sysid_bench.experiments.cell_data import repeat_cells
from sysid_bench.experiments.simulated import commanded
from sysid_bench.types import Array, Row

RELATIVE, ABSOLUTE = 1e-6, 1e-11
"""Tolerance of the numbers of a row: machines round differently, and sums of errors of 1e-16."""
COPIES: Final = 20
"""Copies of the data with other last bits, as `sysid-bench cells --last-bits 20` makes them."""


@contextmanager
def designs(kept: Sequence[Any] | None = None) -> Iterator[dict[str, Array]]:
    """Coefficients of the motions that are designed meanwhile, in order; `kept` ones are used in
    the place of a search. Neither reads nor writes the cache of designs where there are `kept`."""
    found: dict[str, Array] = {}
    with patch.object(commanded, "_DESIGNS", found):
        if kept is None:
            yield found
            return
        left = iter(kept)
        with patch.object(commanded, "_read_design", lambda key: np.array(next(left))):
            yield found


def numbers(row: Mapping[str, Any], within: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of a row and of the tables in it, with dotted names."""
    for key, value in row.items():
        if isinstance(value, Mapping):
            yield from numbers(value, f"{within}{key}.")
        else:
            yield f"{within}{key}", value


def differing(
    before: Mapping[str, Any], after: Mapping[str, Any], spread: Mapping[str, float] | None = None
) -> list[str]:
    """Names of the numbers and words of `before` that differ beyond the tolerance and beyond their
    `spread`."""
    found = dict(numbers(after))
    return [
        f"{name}: {value} then, {found.get(name)} now"
        for name, value in numbers(before)
        if not _same(value, found.get(name), (spread or {}).get(name, 0.0))
    ]


def _same(before: Any, after: Any, spread: float) -> bool:
    if isinstance(before, float) and isinstance(after, (int, float)):
        return math.isclose(before, after, rel_tol=RELATIVE, abs_tol=max(ABSOLUTE, spread))
    return bool(before == after)


def spread_of(row: Row, job: Mapping[str, Any]) -> dict[str, float]:
    """Range of each number of a row over copies of its data with other last bits, the data
    themselves included; of numbers alone whose range exceeds the tolerance."""
    (answers,) = repeat_cells({"job": job, "repeats": COPIES}).values()
    copies = [dict(numbers(answer)) for answer in answers]
    spread = dict[str, float]()
    for name, value in numbers(row):
        values = [copy[name] for copy in copies if isinstance(copy.get(name), float)]
        if values and not all(_same(value, one, 0.0) for one in values):
            spread[name] = max(values) - min(values)
    return spread
