"""What each single parameter is worth: told apart, told in a sum, or not told at all."""

from typing import Final, Literal, get_args

import numpy as np

from sysid_bench.types import Array, BaseMap

Verdict = Literal["identifiable", "combination", "none"]
VERDICTS: Final = get_args(Verdict)

ZERO: Final = 1e-9
"""Below it, relative to the largest of its row, a coefficient of K is rounding error (measured:
1e-12)."""

APART: Final = 1e-6
"""A parameter whose unit vector is farther than this from the row space is told in a sum only.
Axes that are parallel but for truncated decimals leave 1e-7, a tenth of a millionth of another
parameter, on what would be told alone."""


def coefficients(base: BaseMap) -> Array:
    """K (r, p) with its rounding errors made zero."""
    size = np.abs(base.K)
    largest = size.max(axis=1, initial=0.0)[:, None]
    return np.where(size > ZERO * largest, base.K, 0.0)


def verdicts(base: BaseMap) -> tuple[Verdict, ...]:
    """Per parameter (p,): "identifiable" where its unit vector lies in the row space of K,
    "combination" where it acts only together with others, "none" where it never acts."""
    V = np.linalg.qr(base.K.T)[0].T if base.row_space is None else base.row_space
    acts = np.linalg.norm(V, axis=0)
    apart = np.linalg.norm(np.eye(len(base.parameters)) - V.T @ V, axis=0)
    return tuple(
        "identifiable" if apart[j] < APART else "combination" if acts[j] > APART else "none"
        for j in range(len(base.parameters))
    )
