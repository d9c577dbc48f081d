"""Base parameters as printed sums, for example "link2.Ixx - link2.Iyy + 0.04 link3.m"."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from sysid_bench.identifiability.parameter_verdict import coefficients
from sysid_bench.types import Array, BaseMap

DIGITS: Final = 4
"""Significant digits of a printed coefficient."""

MOST_NAMES: Final = 4
"""Maximal number of parameters listed for a near-degenerate direction."""


def base_expressions(base: BaseMap) -> tuple[dict[str, float], ...]:
    """Return the coefficients {parameter: value} of each of the r base parameters, beginning with
    its pivot, whose coefficient is 1."""
    return tuple(
        {base.parameters[j]: float(row[j]) for j in dict.fromkeys([pivot, *np.flatnonzero(row)])}
        for pivot, row in zip(base.pivots, coefficients(base), strict=True)
    )


def expression(terms: Mapping[str, float], digits: int = DIGITS) -> str:
    """Return a linear combination as text, with `digits` significant digits; a coefficient of one
    is not written."""
    parts = []
    for name, value in terms.items():
        size = f"{abs(value):.{digits}g} ".removeprefix("1 ")
        parts.append(f"{'-' if value < 0 else '+'} {size}{name}")
    return " ".join(parts).removeprefix("+ ")


def left_out_expressions(R: Array, base: BaseMap) -> tuple[tuple[float, dict[str, float]], ...]:
    """Return the near-degenerate directions: singular values below the rank tolerance but above
    rounding error.

    For each, its singular value relative to the largest, and {parameter: component} of the largest
    components of its right singular vector. `R` (m, p) is the R factor of the regressor that `base`
    was computed from. The parameters listed are weakly identifiable.
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
    """Largest components of a unit vector, with the sign that makes the first one positive."""
    order = np.argsort(-np.abs(direction), kind="stable")[:MOST_NAMES]
    order = order[np.abs(direction[order]) > 0.2 * abs(direction[order[0]])]
    sign = np.sign(direction[order[0]])
    return {parameters[j]: float(sign * direction[j]) for j in order}
