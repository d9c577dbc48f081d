"""Y of tau = Y theta for chosen parameters, block by block and row by row: never stacked.

A column is a weighting of the ten raw columns of one link (its own parameter: a unit vector; a
welded body's: a column of its transport X), or a joint term of one row.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.errors import unknown_name
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.tree import Tree
from sysid_bench.regressors.kernel import blocks, raw_columns, sweep
from sysid_bench.types import Array, Regressor, Trajectory

TermFunction = Callable[[Array, Array, Array], Array]

SMOOTH_RATE: Final = 0.05
"""rad/s, m/s: half width of the smooth sign that stands for Coulomb friction while a motion is
searched for; sign(v) itself has no slope to follow."""

TERM: Final[dict[str, TermFunction]] = {
    "fv": lambda q, v, a: v,
    "fc": lambda q, v, a: np.sign(v),
    "fc smooth": lambda q, v, a: np.tanh(v / SMOOTH_RATE),
    "offset": lambda q, v, a: np.ones_like(v),
    "Ia": lambda q, v, a: a,
    "k": lambda q, v, a: q,  # the spring's deflection, q less its reference
}
"""Columns of a joint's own terms along (q, v, a) of that joint."""


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
    """One joint term: its column in Y, its row, what it is, the joint's place in q, and the
    reference that is taken from q."""

    place: int
    row: int
    kind: str
    qadr: int
    reference: float


@dataclass(frozen=True, eq=False)
class Regression:
    """Y (N, nv, p) along any motion. `touched[i]`: the columns that row i can be non-zero in."""

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

    def blocks(self, motion: Trajectory) -> Iterator["Block"]:
        """Y of consecutive samples, a cacheful at a time."""
        for part in blocks(motion):
            q, v, a = motion.q[part].T, motion.v[part].T, motion.a[part].T
            states = sweep(self.tree, q, v, a)
            carried = [
                _combine(columns, raw_columns(states[columns.link], columns.raw))
                for columns in self.links
            ]
            terms = [TERM[t.kind](q[t.qadr] - t.reference, v[t.row], a[t.row]) for t in self.terms]
            yield Block(self, part, carried, terms)

    def dense(self, motion: Trajectory) -> Regressor:
        """Y (N, nv, p) at once: for small motions and witnesses."""
        parts = [block.dense() for block in self.blocks(motion)]
        return Regressor(np.concatenate(parts), self.rows, self.columns)

    def torque(self, motion: Trajectory, theta: Array) -> Array:
        """Y theta (N, nv)."""
        tau = np.empty((len(motion), len(self.rows)))
        for block in self.blocks(motion):
            for i, places in enumerate(self.touched):
                tau[block.samples, i] = theta[places] @ block.row(i)
        return tau


@dataclass(frozen=True, eq=False)
class Block:
    """Y of the samples `samples`, kept compact; `row` and `dense` take it apart."""

    regression: Regression
    samples: slice
    carried: list[Array]  # (k, dofs, n) of each LinkColumns
    terms: list[Array]  # (n,) of each TermColumn

    @property
    def count(self) -> int:
        """n, the number of samples."""
        return self.samples.stop - self.samples.start

    def row(self, i: int, out: Array | None = None) -> Array:
        """Row i of Y, (k, n), in the columns `touched[i]`."""
        regression = self.regression
        if out is None:
            out = np.empty((len(regression.touched[i]), self.count))
        start = 0
        for columns, values in zip(regression.links, self.carried, strict=True):
            for place in np.flatnonzero(regression.tree.links[columns.link].dofs == i):
                out[start : start + len(values)] = values[:, place]
                start += len(values)
        for term, values in zip(regression.terms, self.terms, strict=True):
            if term.row == i:
                out[start] = values
                start += 1
        return out

    def dense(self) -> Array:
        """Y (n, nv, p) with its zeros."""
        Y = np.zeros((self.count, len(self.regression.rows), len(self.regression.columns)))
        for i, places in enumerate(self.regression.touched):
            Y[:, i, places] = self.row(i).T
        return Y


def regression(robot: RobotModel, columns: Sequence[str]) -> Regression:
    """The regression of a robot on the parameters named in `columns`, in that order.

    Raises UsageError for a name that the robot does not have.
    """
    inertial = {name: i for i, name in enumerate(robot.inertial_columns)}
    joint_terms = _term_names(robot)
    weights: dict[int, list[tuple[int, Array]]] = {}
    terms = []
    for place, name in enumerate(columns):
        if name in joint_terms:
            row, kind, qadr, reference = joint_terms[name]
            terms.append(TermColumn(place, row, kind, qadr, reference))
        elif name in inertial:
            body, parameter = divmod(inertial[name], 10)
            if robot.tree.carrier[body] >= 0:  # a body welded to the world moves nothing
                weight = robot.tree.X[body][:, parameter]
                weights.setdefault(int(robot.tree.carrier[body]), []).append((place, weight))
        else:
            raise unknown_name("parameter", name, [*inertial, *joint_terms])
    links = tuple(_link_columns(link, weights[link]) for link in sorted(weights))
    return Regression(robot.tree, robot.rows, tuple(columns), links, tuple(terms))


def _term_names(robot: RobotModel) -> dict[str, tuple[int, str, int, float]]:
    names = {}
    for joint in robot.joints:
        if joint.kind not in ("hinge", "slide"):
            continue
        for kind in SUFFIX.values():
            reference = (
                float(robot.joint_terms.spring_reference[joint.vadr]) if kind == "k" else 0.0
            )
            names[f"{joint.name}.{kind}"] = (joint.vadr, kind, joint.qadr, reference)
    return names


def _link_columns(link: int, weights: list[tuple[int, Array]]) -> LinkColumns:
    places = np.array([place for place, _ in weights])
    mix = np.array([weight for _, weight in weights])
    raw = tuple(int(c) for c in np.flatnonzero(mix.any(axis=0)))
    mix = mix[:, raw]
    plain = mix.shape[0] == mix.shape[1] and np.array_equal(mix, np.eye(len(raw)))
    return LinkColumns(link, raw, None if plain else mix, places)


def _combine(columns: LinkColumns, raw: Array) -> Array:
    return raw if columns.mix is None else np.tensordot(columns.mix, raw, axes=1)
