"""Base parameters as printed sums ("link2.Ixx - link2.Iyy + 0.04 link3.m"), numbers or symbols.

Also which parameters are identifiable alone, only in a linear combination, or not at all."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final, Literal

import numpy as np

from sysid_bench.types import Array, BaseMap

Verdict = Literal["identifiable", "combination", "none"]

ZERO: Final = 1e-9
"""Relative to the largest of its row: a smaller coefficient of K is a rounding error (measured:
1e-12)."""

ROUNDED: Final = 4e-6
"""Relative to the largest of its row: smaller coefficients come from angles that a file rounds, as
1.5708, whose cosine is -3.7e-6, and are left out of expressions."""

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


DIGITS: Final = 4
"""Significant digits of a printed coefficient."""

MOST_NAMES: Final = 4
"""Maximal number of parameters listed for a near-degenerate direction."""


def base_expressions(base: BaseMap) -> tuple[dict[str, float], ...]:
    """Return the coefficients {parameter: value} of each of the r base parameters, beginning with
    its pivot, whose coefficient is 1; without those of rounded angles."""
    K = coefficients(base)
    size = np.abs(K)
    K = np.where(size > ROUNDED * size.max(axis=1, initial=0.0)[:, None], K, 0.0)
    return tuple(
        {base.parameters[j]: float(row[j]) for j in dict.fromkeys([pivot, *np.flatnonzero(row)])}
        for pivot, row in zip(base.pivots, K, strict=True)
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
    found = []
    for value, direction in zip(values[kept], Vt[kept], strict=True):
        largest = np.argsort(-np.abs(direction), kind="stable")[:MOST_NAMES]
        largest = largest[np.abs(direction[largest]) > 0.2 * abs(direction[largest[0]])]
        # A singular vector has no sign of its own: the first component is made positive.
        sign = np.sign(direction[largest[0]])
        terms = {base.parameters[j]: float(sign * direction[j]) for j in largest}
        found.append((float(value / values[0]), terms))
    return tuple(found)


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
    for terms, x in _candidates(_monomials(lengths)):
        if np.abs(x - target).max() <= TOLERANCE * scale:
            # Sum as text, a positive term first if there is one.
            (sign, first), *others = sorted(terms, reverse=True)
            rest = "".join(f" {'+' if sign > 0 else '-'} {text}" for sign, text in others)
            return f"{'-' if sign < 0 else ''}{first}{rest}"
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


def _candidates(table: Mapping[str, Array]) -> Iterator[tuple[Terms, Array]]:
    """Monomials with a numerical factor of either sign, the simplest factors first; then sums and
    differences of two."""
    for factor, (text, x) in itertools.product(FACTORS, table.items()):
        written = f"{factor:g}" if text == "1" else f"{factor:g} {text}"
        for sign in (1.0, -1.0):
            yield ((sign, text if factor == 1.0 else written),), sign * factor * x
    for (one, x), (other, y) in itertools.combinations(table.items(), 2):
        for s, t in itertools.product((1.0, -1.0), repeat=2):
            yield ((s, one), (t, other)), s * x + t * y
