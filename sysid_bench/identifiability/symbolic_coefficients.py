"""Symbolic coefficients of base parameters: 0.04 becomes "a2^2".

A coefficient of a base parameter is an expression in the lengths of the mechanism. It is determined
from its values at several generic sets of lengths, since with the robot's own lengths different
expressions may have equal values by chance.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from sysid_bench.types import Array

FACTORS: Final = (1.0, 2.0, 4.0, 0.5, 3.0, 0.25, 8.0)
"""Numerical factors of a monomial that are tried."""

MONOMIALS: Final[dict[str, Callable[..., Array]]] = {
    "{}": lambda a: a,
    "{}^2": lambda a: a**2,
    "1/{}": lambda a: 1 / a,
    "{} {}": lambda a, b: a * b,
    "{}/{}": lambda a, b: a / b,
    "{} {}/{}": lambda a, b, c: a * b / c,
    "{}^2/{}": lambda a, b: a**2 / b,
}
"""Monomials as texts and formulas of lengths, simple ones first."""

TOLERANCE: Final = 1e-7
"""Relative; the error of K at generic lengths is about 1e-10."""


def random_values(symbols: Mapping[str, float], count: int = 3) -> list[dict[str, float]]:
    """Return `count` random sets of lengths, each within 15 % of the given one, in which no two
    expressions agree by chance."""
    rng = np.random.default_rng(20170924)
    return [
        {name: value * float(rng.uniform(0.85, 1.15)) for name, value in symbols.items()}
        for _ in range(count)
    ]


def symbolic_coefficients(
    values: Sequence[float], lengths: Sequence[Mapping[str, float]]
) -> str | None:
    """Return the simplest expression with these values at these sets of lengths; None if there is
    none.

    Candidates are monomials of degree -2 to 2 in up to three lengths, with a numerical factor, then
    sums and differences of two of them.
    """
    target = np.array(values)
    scale = float(np.abs(target).max())
    if scale == 0.0:
        return None
    table = _monomials(lengths)
    for terms, x in itertools.chain(_scaled(table), _sums(table)):
        if np.abs(x - target).max() <= TOLERANCE * scale:
            return _sum_text(terms)
    return None


Terms = tuple[tuple[float, str], ...]
"""Sign and text of the monomials of a sum."""


def _monomials(lengths: Sequence[Mapping[str, float]]) -> dict[str, Array]:
    """Values (sets,) of all monomials by their text, simple ones first."""
    x = {name: np.array([one[name] for one in lengths]) for name in lengths[0]}
    one = np.ones(len(lengths))
    texts = {tuple(one): "1"}
    for template, formula in MONOMIALS.items():
        for names in itertools.permutations(x, template.count("{}")):
            # "a b" comes first, and "b a" has the same values.
            values = formula(*(x[name] for name in names))
            texts.setdefault(tuple(values), template.format(*names))
    return {text: np.array(values) for values, text in texts.items()}


def _scaled(table: Mapping[str, Array]) -> Iterator[tuple[Terms, Array]]:
    """Monomials with a numerical factor of either sign, the simplest factors first."""
    for factor, (text, x) in itertools.product(FACTORS, table.items()):
        for sign in (1.0, -1.0):
            yield ((sign, _times(factor, text)),), sign * factor * x


def _sums(table: Mapping[str, Array]) -> Iterator[tuple[Terms, Array]]:
    """Sums and differences of two monomials."""
    for (one, x), (other, y) in itertools.combinations(table.items(), 2):
        for s, t in itertools.product((1.0, -1.0), repeat=2):
            yield ((s, one), (t, other)), s * x + t * y


def _times(factor: float, text: str) -> str:
    if factor == 1.0:
        return text
    return f"{factor:g}" if text == "1" else f"{factor:g} {text}"


def _sum_text(terms: Terms) -> str:
    """Sum as text, a positive term first if there is one."""
    (sign, first), *others = sorted(terms, reverse=True)
    rest = "".join(f" {'+' if sign > 0 else '-'} {text}" for sign, text in others)
    return f"{'-' if sign < 0 else ''}{first}{rest}"
