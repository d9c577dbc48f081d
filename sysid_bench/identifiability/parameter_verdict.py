"""Identifiability of each parameter: alone, only in a linear combination, or not at all."""

from typing import Final, Literal

import numpy as np

from sysid_bench.types import Array, BaseMap

Verdict = Literal["identifiable", "combination", "none"]

ZERO: Final = 1e-9
"""Relative to the largest of its row: a smaller coefficient of K is a rounding error (measured:
1e-12)."""

APART: Final = 1e-6
"""A parameter whose unit vector is farther than this from the row space of K is identifiable in
combination only. Axes that are parallel up to truncated decimals cause distances of 1e-7."""


def coefficients(base: BaseMap) -> Array:
    """Return K (r, p) with its rounding errors set to zero."""
    size = np.abs(base.K)
    largest = size.max(axis=1, initial=0.0)[:, None]
    return np.where(size > ZERO * largest, base.K, 0.0)


def parameter_verdict(base: BaseMap) -> tuple[Verdict, ...]:
    """Return the verdict on each of the p parameters.

    "identifiable": its unit vector lies in the row space of K; "combination": it acts only together
    with others; "none": it has no effect on any torque.
    """
    V = np.linalg.qr(base.K.T)[0].T if base.row_space is None else base.row_space
    # V'V projects on the row space: of a unit vector it leaves `acts`, and takes away `apart`.
    acts = np.linalg.norm(V, axis=0)
    apart = np.linalg.norm(np.eye(len(base.parameters)) - V.T @ V, axis=0)
    found = np.select([apart < APART, acts > APART], ["identifiable", "combination"], "none")
    return tuple(found.tolist())
