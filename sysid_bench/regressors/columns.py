"""Which columns of Y come from which links and joint terms, and what rows they can be non-zero in.

A column is a weighting of the ten raw columns of one link (its own parameter: a unit vector; a
welded body's: a column of its transport X), or a joint term of one row.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sysid_bench.models.tree import Tree
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class LinkColumns:
    """Columns carried by one link: `raw` of its ten are computed, `mix` (k, m) combines them
    (None: taken as they are), `places` are their columns in Y."""

    link: int
    raw: tuple[int, ...]
    mix: Array | None
    places: Array


@dataclass(frozen=True)
class TermColumn:
    """One joint term: its column in Y, its row, what it is, the joint's place in q, the reference
    that is taken from q, and the place in v of the rate that it depends on."""

    place: int
    row: int
    kind: str
    qadr: int
    reference: float
    rate: int


@dataclass(frozen=True, eq=False)
class Columns:
    """The columns of Y (N, nv, p). `touched[i]`: those that row i can be non-zero in."""

    tree: Tree
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    links: tuple[LinkColumns, ...]
    terms: tuple[TermColumn, ...]

    @cached_property
    def touched(self) -> tuple[Array, ...]:
        """For each row the places (k,) in Y, in the order of `Block.row`."""
        places: list[list[int]] = [[] for _ in self.rows]
        for columns in self.links:
            for row in self.tree.links[columns.link].dofs:
                places[row] += columns.places.tolist()
        for term in self.terms:
            places[term.row].append(term.place)
        return tuple(np.array(place, dtype=int) for place in places)

    @cached_property
    def starts(self) -> tuple[int, ...]:
        """Where each row's columns start among the values of a block; one value is free after
        them, for the right-hand side that a fold puts there."""
        sizes = [len(places) + 1 for places in self.touched]
        return tuple(int(end - size) for end, size in zip(np.cumsum(sizes), sizes, strict=True))
