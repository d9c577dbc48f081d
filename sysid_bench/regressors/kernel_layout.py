"""Flat arrays of a kinematic tree and its regressor columns, as kernel.c reads them."""

import ctypes
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np

from sysid_bench.models.tree import BALL, FREE, SLIDE, Tree
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


ABOUT, ALONG, ABOUT_X, WORLD_X = 0, 1, 2, 5
"""Motion of a degree of freedom: rotation about the joint's axis, translation along it, rotation
about the joint's own x (then y, z), translation along the world's x (then y, z)."""

TERM_CODES: Final = {"fv": 0, "fc": 1, "offset": 2, "Ia": 3, "k": 4}


def _structure(name: str, fields: str) -> type[ctypes.Structure]:
    """C struct of the given fields; a name with a star is a pointer, any other an int64."""
    kinds = {True: ctypes.c_void_p, False: ctypes.c_int64}
    members = [(word.lstrip("*"), kinds[word.startswith("*")]) for word in fields.split()]
    return type(name, (ctypes.Structure,), {"_fields_": members})


# Names and order of the fields are those of the structs in kernel.c.
CTree: Final = _structure(
    "CTree", "joints nq nv *kind *before *qadr *vadr *R0 *p0 *axis *anchor *q0 *gravity"
)
CPlan: Final = _structure(
    "CPlan",
    "carriers terms values *frame *slot *outputs *mixed *first *from *part *dest *mixes "
    "*term_kind *term_dest *term_vadr *term_qadr *term_reference",
)
CRuns: Final = _structure("CRuns", "rows width *first *value *column *length")


@dataclass(frozen=True, eq=False)
class KernelLayout:
    """Input of one call of the kernel: C structs of the tree and the columns, and the output rows.

    `arrays` keeps alive what the structs point to. `size` is the number of values per sample. Row i
    of the output is degree of freedom `rows[i]`; its `count[i]` values begin at `starts[i]`, and
    one value is left free behind them.
    """

    tree: Any
    plan: Any
    arrays: tuple[Array, ...]
    size: int
    rows: Array
    starts: Array
    count: Array
    runs: Any  # struct CRuns: how values and zeros make up dense rows


def columns_layout(wanted: Columns, rows: Sequence[int]) -> KernelLayout:
    """Return the layout that computes the given rows (indices in v) of the columns `wanted`."""
    chosen = np.array(rows, dtype=np.int64)
    count = np.array([len(wanted.row_columns[i]) for i in rows], dtype=np.int64)
    ends = np.cumsum(count + 1)
    start = {int(i): int(end - n - 1) for i, end, n in zip(chosen, ends, count, strict=True)}
    plan = _Plan(wanted.tree, start)
    for columns in wanted.links:
        plan.add(columns)
    plan.add_terms(wanted.terms)
    size = int(ends[-1]) if len(ends) else 0
    starts = ends - count - 1
    touched = [wanted.row_columns[i] for i in rows]
    return _layout(plan, size, (chosen, starts, count), _runs(touched, starts, len(wanted.columns)))


def torque_layout(tree: Tree, links: Sequence[int]) -> KernelLayout:
    """Return the layout that computes the rigid-body torque (nv,) of the given links."""
    plan = _Plan(tree, {})
    for link in links:
        plan.add_pairs(link, {int(dof): int(dof) for dof in tree.links[link].dofs})
    none = np.zeros(0, np.int64)
    return _layout(plan, tree.nv, (none, none, none), [])


class _Plan:
    """Columns of a layout under construction; `next` is the next free value of each row."""

    def __init__(self, tree: Tree, start: dict[int, int]) -> None:
        self.tree, self.next = tree, start
        self.last = np.cumsum([len(link.joints) for link in tree.links]) - 1
        # (joint, motion code) of every degree of freedom.
        self.motions: dict[int, tuple[int, int]] = {}
        about, world = range(ABOUT_X, ABOUT_X + 3), range(WORLD_X, WORLD_X + 3)
        for j, joint in enumerate(tree.joints):
            parts = [ALONG if joint.kind == SLIDE else ABOUT]
            if joint.kind in (FREE, BALL):
                parts = [*world, *about] if joint.kind == FREE else [*about]
            self.motions |= {dof: (j, part) for dof, part in zip(joint.dofs, parts, strict=True)}
        self.frame: list[int] = []
        self.slot: list[Array] = []
        self.outputs: list[int] = []
        self.mixed: list[int] = []
        self.first = [0]
        self.pairs: list[tuple[int, int, int]] = []  # from, part, dest
        self.mixes: list[float] = []
        self.terms: list[tuple[int, int, int, int, float]] = []

    def add(self, columns: LinkColumns) -> None:
        """Add the columns of one link, for those of its rows that are wanted."""
        dofs = self.tree.links[columns.link].dofs
        count = len(columns.indices)
        slot = np.full(10, -1)
        if columns.mix is None:
            slot[list(columns.raw)] = np.arange(count)
            self.mixed.append(-1)
        else:
            wide = np.zeros((count, 10))
            wide[:, columns.raw] = columns.mix
            self.mixed.append(len(self.mixes))
            self.mixes += wide.ravel().tolist()
        self.slot.append(slot)
        self.outputs.append(count)
        wanted = [dof for dof in dofs.tolist() if dof in self.next]
        self.add_pairs(columns.link, {dof: self.take(dof, count) for dof in wanted})

    def add_terms(self, terms: Sequence[TermColumn]) -> None:
        """Add the joint terms of the rows that are wanted."""
        for term in terms:
            if term.row in self.next:
                dest = self.take(term.row, 1)
                code = TERM_CODES[term.kind]
                self.terms.append((code, dest, term.rate, term.qadr, term.reference))

    def take(self, row: int, count: int) -> int:
        """Reserve the next `count` values of a row; return the first."""
        self.next[row] += count
        return self.next[row] - count

    def add_pairs(self, link: int, dest: dict[int, int]) -> None:
        """Add pairs of the link and a degree of freedom that moves it, with their values."""
        self.frame.append(int(self.last[link]))
        self.pairs += [(*self.motions[dof], value) for dof, value in dest.items()]
        self.first.append(len(self.pairs))


def _runs(touched: list[Array], starts: Array, width: int) -> list[list[tuple[int, int, int]]]:
    """(value or -1 for zeros, column, length) of every row's runs of neighbouring columns."""
    rows = []
    for columns, start in zip(touched, starts, strict=True):
        source = np.full(width, -1)
        source[columns] = start + np.arange(len(columns))
        before, after = source[:-1], source[1:]
        # A run goes on within zeros, or within values that are neighbours in memory as well.
        continues = np.where(after < 0, before < 0, (after == before + 1) & (before >= 0))
        first = np.flatnonzero(np.concatenate([[width > 0], ~continues]))
        length = np.diff([*first, width])
        rows.append(list(zip(source[first].tolist(), first.tolist(), length.tolist(), strict=True)))
    return rows


def _layout(
    plan: _Plan, size: int, rows: tuple[Array, Array, Array], runs: list[list[tuple[int, int, int]]]
) -> KernelLayout:
    """Layout of a finished plan; `rows` are the indices in v, first values and counts of rows."""
    tree, of_tree = _tree(plan.tree)
    pairs = np.array(plan.pairs, dtype=np.int64).reshape(-1, 3).T
    terms = list(zip(*plan.terms, strict=True)) or [()] * 5
    of_plan = [
        *_integers(plan.frame, plan.slot, plan.outputs, plan.mixed, plan.first, *pairs),
        *_floats(plan.mixes),
        *_integers(*terms[:4]),
        *_floats(terms[4]),
    ]
    struct = _filled(CPlan, of_plan, len(plan.frame), len(plan.terms), size)
    # Runs of all rows, one row after the other.
    width = sum(length for _, _, length in runs[0]) if runs else 0
    flat = np.array([run for row in runs for run in row], dtype=np.int64).reshape(-1, 3).T
    of_runs = _integers(np.cumsum([0, *map(len, runs)]), *flat)
    dofs, starts, count = _integers(*rows)
    return KernelLayout(
        tree=tree,
        plan=struct,
        arrays=(*of_tree, *of_plan, *of_runs),
        size=size,
        rows=dofs,
        starts=starts,
        count=count,
        runs=_filled(CRuns, of_runs, len(runs), width),
    )


def _tree(tree: Tree) -> tuple[Any, list[Array]]:
    """Struct of the joints in tree order, and its arrays."""
    # Frame of each joint: the joint before it (-1: the world) and its pose in that one's frame.
    before: list[int] = []
    R0: list[Array] = []
    p0: list[Array] = []
    last = [-1] * (len(tree.links) + 1)  # last joint of each link; of the world at index -1
    for i, link in enumerate(tree.links):
        # The first joint starts at the link's pose in its parent, a later one where that one ends.
        more = len(link.joints) - 1
        before += [last[link.parent], *range(len(before), len(before) + more)]
        R0 += [link.R0, *[np.eye(3)] * more]
        p0 += [link.p0, *[np.zeros(3)] * more]
        last[i] = len(before) - 1
    kind, qadr, vadr, axis, anchor, q0 = (
        [getattr(joint, name) for joint in tree.joints]
        for name in ("kind", "qadr", "vadr", "axis", "anchor", "q0")
    )
    integers, floats = (kind, before, qadr, vadr), (R0, p0, axis, anchor, q0, tree.gravity)
    arrays = [*_integers(*integers), *_floats(*floats)]
    return _filled(CTree, arrays, len(tree.joints), tree.nq, tree.nv), arrays


def _filled(struct: Any, arrays: Sequence[Array], *numbers: int) -> Any:
    """C struct of numbers and, after them, pointers to arrays."""
    return struct(*numbers, *(x.ctypes.data for x in arrays))


def _integers(*values: Any) -> list[Array]:
    return [np.ascontiguousarray(x, dtype=np.int64) for x in values]


def _floats(*values: Any) -> list[Array]:
    return [np.ascontiguousarray(x, dtype=float) for x in values]
