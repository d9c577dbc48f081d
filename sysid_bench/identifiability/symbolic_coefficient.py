"""Symbolic coefficients of base parameters: 0.04 becomes "a2^2".

A coefficient of a base parameter is an expression in the lengths of the mechanism. It is determined
from its values at several generic sets of lengths, since with the robot's own lengths different
expressions may have equal values by chance.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from sysid_bench.types import Array

FACTORS: Final = (1.0, 2.0, 4.0, 0.5, 3.0, 0.25, 8.0)
"""Numerical factors of a monomial that are tried."""

TOLERANCE: Final = 1e-7
"""Relative; the error of K at generic lengths is about 1e-10."""


def lengths_of(symbols: Mapping[str, float], count: int = 3) -> list[dict[str, float]]:
    """Return `count` random sets of lengths, each within 15 % of the given one, in which no two
    expressions agree by chance."""
    rng = np.random.default_rng(20170924)
    return [
        {name: value * float(rng.uniform(0.85, 1.15)) for name, value in symbols.items()}
        for _ in range(count)
    ]


def symbolic_coefficient(
    values: Sequence[float], lengths: Sequence[Mapping[str, float]]
) -> str | None:
    """Return the simplest expression with these values at these sets of lengths; None if there is
    none.

    Candidates are monomials of degree -2 to 2 in up to three lengths, with a numerical factor, then
    sums and differences of two of them.
    """
    target = np.array(values)
    table = _monomials(lengths)
    scale = np.abs(target).max()
    if scale == 0.0:
        return None
    for factor in FACTORS:
        for text, monomial in table:
            for sign in (1.0, -1.0):
                if np.abs(sign * factor * monomial - target).max() <= TOLERANCE * scale:
                    return _signed(sign, _times(factor, text))
    for (one, first), (other, second) in itertools.combinations(table, 2):
        for sign, next_sign in itertools.product((1.0, -1.0), repeat=2):
            if np.abs(sign * first + next_sign * second - target).max() <= TOLERANCE * scale:
                (s, plus), (t, minus) = sorted(((sign, one), (next_sign, other)), reverse=True)
                return _signed(s, plus) + (" + " if t > 0 else " - ") + minus
    return None


def _monomials(lengths: Sequence[Mapping[str, float]]) -> list[tuple[str, Array]]:
    """(text, values (sets,)) of all monomials, simple ones first."""
    x = {name: np.array([one[name] for one in lengths]) for name in lengths[0]}
    names = list(x)
    table = [("1", np.ones(len(lengths)))]
    table += [(a, x[a]) for a in names]
    table += [(f"{a}^2", x[a] ** 2) for a in names]
    table += [(f"1/{a}", 1 / x[a]) for a in names]
    table += [(f"{a} {b}", x[a] * x[b]) for a, b in itertools.combinations(names, 2)]
    table += [(f"{a}/{b}", x[a] / x[b]) for a, b in itertools.permutations(names, 2)]
    table += [
        (f"{a} {b}/{c}", x[a] * x[b] / x[c])
        for a, b in itertools.combinations(names, 2)
        for c in names
        if c not in (a, b)
    ]
    table += [(f"{a}^2/{b}", x[a] ** 2 / x[b]) for a, b in itertools.permutations(names, 2)]
    return table


def _times(factor: float, text: str) -> str:
    if factor == 1.0:
        return text
    return f"{factor:g}" if text == "1" else f"{factor:g} {text}"


def _signed(sign: float, text: str) -> str:
    return f"-{text}" if sign < 0 else text
