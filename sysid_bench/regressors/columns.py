"""Columns of the regressor Y: the links and joint terms they belong to, and their non-zero rows.

A column is a linear combination of the ten raw columns of one link, or a joint term of one row. For
a parameter of the link itself the combination is a unit vector; for one of a body welded to the
link it is a column of the body's parameter transport X (10, 10).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sysid_bench.models.tree import Tree
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class LinkColumns:
    """Columns of Y that belong to one link.

    `raw` are the m indices of its ten raw columns that are computed, `mix` (k, m) combines them to
    k columns (None: the identity), `indices` (k,) are the columns of Y.
    """

    link: int
    raw: tuple[int, ...]
    mix: Array | None
    indices: Array


@dataclass(frozen=True)
class TermColumn:
    """Column of one joint term: `index` in Y, its only non-zero `row`, and its `kind`.

    The term is a function of q[qadr] - reference, and of v and a at index `rate`.
    """

    index: int
    row: int
    kind: str
    qadr: int
    reference: float
    rate: int


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of Y (N, nv, p); `touched[i]` are those in which row i can be non-zero."""

    tree: Tree
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    links: tuple[LinkColumns, ...]
    terms: tuple[TermColumn, ...]

    @cached_property
    def row_columns(self) -> tuple[Array, ...]:
        """Indices (k,) of the columns in which each row can be non-zero, as `Block.row` orders
        them."""
        indices: list[list[int]] = [[] for _ in self.rows]
        # Link columns first, then terms: kernels write the values of a row in this order.
        for columns in self.links:
            for row in self.tree.links[columns.link].dofs:
                indices[row] += columns.indices.tolist()
        for term in self.terms:
            indices[term.row].append(term.index)
        return tuple(np.array(row, dtype=int) for row in indices)

    @cached_property
    def first(self) -> tuple[int, ...]:
        """Index of each row's first value in `Block.values`.

        One value per row is left free behind its columns: `Block.augmented` writes the right-hand
        side there, so that [Y | b] needs no copy.
        """
        sizes = [len(row) + 1 for row in self.row_columns]
        return tuple(int(end - size) for end, size in zip(np.cumsum(sizes), sizes, strict=True))


def dense_rows(
    rows: Iterable[Array], touched: Sequence[Array], shape: tuple[int, int, int]
) -> Array:
    """Return Y (n, rows, p) of this shape, whose row i has the values (k, n) of `rows[i]` in the
    columns `touched[i]` and zeros elsewhere."""
    Y = np.zeros(shape)
    for i, (values, indices) in enumerate(zip(rows, touched, strict=True)):
        Y[:, i, indices] = values.T
    return Y
