"""What each single parameter is worth: told apart, told in a sum, or not told at all."""

from typing import Final, Literal, get_args

import numpy as np

from sysid_bench.types import Array, BaseMap

Verdict = Literal["identifiable", "combination", "none"]
VERDICTS: Final = get_args(Verdict)

ZERO: Final = 1e-9
"""Below it, relative to the largest of its row, a coefficient of K is rounding error (measured:
1e-12). Axes that are parallel but for truncated decimals leave 1e-6, which is told as it is."""


def coefficients(base: BaseMap) -> Array:
    """K (r, p) with its rounding errors made zero."""
    size = np.abs(base.K)
    largest = size.max(axis=1, initial=0.0)[:, None]
    return np.where(size > ZERO * largest, base.K, 0.0)


def verdicts(base: BaseMap) -> tuple[Verdict, ...]:
    """Per parameter (p,): "identifiable" where its unit vector lies in the row space of K,
    "combination" where it acts only together with others, "none" where it never acts.

    K is the identity on its pivots, so a unit vector lies in the row space iff it is itself a row.
    """
    seen = coefficients(base) != 0.0
    alone = {int(base.pivots[i]) for i in np.flatnonzero(seen.sum(axis=1) == 1)}
    acts = seen.any(axis=0)
    return tuple(
        "identifiable" if j in alone else "combination" if acts[j] else "none"
        for j in range(len(base.parameters))
    )
