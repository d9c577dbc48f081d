"""Base parameters as papers print them: "link2.Ixx - link2.Iyy + 0.04 link3.m"."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from sysid_bench.identifiability.verdicts import coefficients
from sysid_bench.types import Array, BaseMap

DIGITS: Final = 4
"""Significant digits of a printed coefficient."""

MOST_NAMES: Final = 4
"""Parameters that name a direction, at most."""


def combinations(base: BaseMap, digits: int = DIGITS) -> tuple[str, ...]:
    """The base parameters (r,) as printed sums, each led by its pivot.

    Pivots are those of `base`: greedy from left to right unless it was rebased (rebase.py).
    """
    return tuple(expression(terms, digits) for terms in base_expressions(base))


def base_expressions(base: BaseMap) -> tuple[dict[str, float], ...]:
    """The coefficient of every parameter in each base parameter, its pivot (1.0) first."""
    rows = []
    for pivot, row in zip(base.pivots, coefficients(base), strict=True):
        others = [int(j) for j in np.flatnonzero(row) if j != pivot]
        rows.append({base.parameters[j]: float(row[j]) for j in (int(pivot), *others)})
    return tuple(rows)


def expression(terms: Mapping[str, float], digits: int = DIGITS) -> str:
    """A sum in words; a coefficient of one is not written."""
    words = []
    for name, value in terms.items():
        size = f"{abs(value):.{digits}g}"
        words += ["-" if value < 0 else "+", *([] if size == "1" else [size]), name]
    return " ".join(words).removeprefix("+ ")


def near_degenerate(R: Array, base: BaseMap) -> tuple[tuple[float, dict[str, float]], ...]:
    """Directions that the rank leaves out though they stand above rounding: for each its singular
    value relative to the largest, and the parameters that it changes most.

    `R` (m, p) is a factor of the regressor that `base` was made of. Its right singular vectors
    hold nothing that no motion tells at all, so that what they name is told, if hardly.
    """
    if base.near_degenerate == 0:
        return ()
    _, values, Vt = np.linalg.svd(R, full_matrices=False)
    kept = slice(base.rank, base.rank + base.near_degenerate)
    return tuple(
        (float(value / values[0]), _largest(direction, base.parameters))
        for value, direction in zip(values[kept], Vt[kept], strict=True)
    )


def _largest(direction: Array, parameters: tuple[str, ...]) -> dict[str, float]:
    """The parameters with the largest shares of a unit direction, the first one positive."""
    order = np.argsort(-np.abs(direction), kind="stable")[:MOST_NAMES]
    order = order[np.abs(direction[order]) > 0.2 * abs(direction[order[0]])]
    sign = np.sign(direction[order[0]])
    return {parameters[j]: float(sign * direction[j]) for j in order}
