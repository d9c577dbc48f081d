"""Y of tau = Y theta for chosen parameters, block by block and row by row: never stacked."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import Measured
from sysid_bench.regressors.columns import Columns, LinkColumns, TermColumn
from sysid_bench.regressors.kernel_c import Library, layout_of, selected_kernel
from sysid_bench.regressors.kernel_layout import TERM_CODES
from sysid_bench.regressors.kernel_numpy import blocks, body_columns, link_motions
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
class Regression(Columns):
    """Y (N, nv, p) along any motion."""

    @cached_property
    def library(self) -> Library | None:
        """The compiled kernel, where this process has one and it knows all of these columns."""
        known = all(term.kind in TERM_CODES for term in self.terms)
        return selected_kernel().library if known else None

    def blocks(self, motion: Trajectory) -> Iterator["Block"]:
        """Y of consecutive samples, a cacheful at a time, by the kernel of this process."""
        library = self.library
        for part in blocks(motion):
            span = _part(motion, part)
            values = library.rows(layout_of(self), span) if library else self._values(span)
            yield Block(self, part, values)

    def _values(self, motion: Trajectory) -> Array:
        """The values of a block by the NumPy kernel."""
        q, v, a = motion.q.T, motion.v.T, motion.a.T
        free = list(self.starts)
        out = np.empty((sum(len(places) + 1 for places in self.touched), len(motion)))
        states = link_motions(self.tree, q, v, a)
        for columns in self.links:
            state = states[columns.link]
            A = body_columns(state, columns.raw)
            if columns.mix is not None:
                A = columns.mix @ A
            for zu, row in zip(state.ZU, self.tree.links[columns.link].dofs, strict=True):
                end = free[row] + A.shape[1]
                # One pass of many products over numbers that the nearest cache holds.
                np.einsum("in,icn->cn", zu, A, out=out[free[row] : end])
                free[row] = end
        for term in self.terms:
            values = TERM[term.kind](q[term.qadr] - term.reference, v[term.rate], a[term.rate])
            out[free[term.row]] = values
            free[term.row] += 1
        return out

    def dense(self, motion: Trajectory, out: Array | None = None) -> Regressor:
        """Y (N, nv, p) at once, into `out` where it is given: for small motions and witnesses."""
        if out is None:
            out = np.empty((len(motion), len(self.rows), len(self.columns)))
        library = self.library
        if library is not None:
            library.dense(layout_of(self), motion, out)
        else:
            for block in self.blocks(motion):
                block.dense(out[block.samples])
        return Regressor(out, self.rows, self.columns)

    def torque(self, motion: Trajectory, theta: Array) -> Array:
        """Y theta (N, nv)."""
        tau = np.empty((len(motion), len(self.rows)))
        for block in self.blocks(motion):
            for i, places in enumerate(self.touched):
                tau[block.samples, i] = theta[places] @ block.row(i)
        return tau


@dataclass(frozen=True, eq=False)
class Block:
    """Y of the samples `samples`, kept compact: the rows' columns one after the other in `values`
    (k, n), as `starts` says; `row` and `dense` take it apart."""

    regression: Regression
    samples: slice
    values: Array

    @property
    def count(self) -> int:
        """n, the number of samples."""
        return self.samples.stop - self.samples.start

    def row(self, i: int, out: Array | None = None) -> Array:
        """Row i of Y, (k, n), in the columns `touched[i]`: a view, or the given array filled."""
        start = self.regression.starts[i]
        values = self.values[start : start + len(self.regression.touched[i])]
        if out is None:
            return values
        out[:] = values
        return out

    def augmented(self, i: int, b: Array) -> Array:
        """Row i with a right-hand side b (n,) below it, (k + 1, n): a view, in the place kept."""
        start = self.regression.starts[i]
        end = start + len(self.regression.touched[i])
        self.values[end] = b
        return self.values[start : end + 1]

    def dense(self, out: Array | None = None) -> Array:
        """Y (n, nv, p) with its zeros: a new array, or the given one filled."""
        shape = (self.count, len(self.regression.rows), len(self.regression.columns))
        Y = np.empty(shape) if out is None else out
        Y[:] = 0.0
        for i, places in enumerate(self.regression.touched):
            values = self.row(i)
            for run in _runs(places):
                Y[:, i, places[run.start] : places[run.stop - 1] + 1] = values[run].T
        return Y


def _runs(places: Array, most: int = 16) -> Iterator[slice]:
    """Neighbouring columns; few at a time, since NumPy copies a wide transpose four times slower,
    and single columns twenty times slower."""
    ends = (np.flatnonzero(np.diff(places) != 1) + 1).tolist()
    for start, end in pairwise([0, *ends, len(places)]):
        for first in range(start, end, most):
            yield slice(first, min(first + most, end))


def _part(motion: Trajectory, part: slice) -> Trajectory:
    return Trajectory(motion.t[part], motion.q[part], motion.v[part], motion.a[part])


def regression(
    robot: RobotModel, columns: Sequence[str], measured: Measured | None = None
) -> Regression:
    """The regression of a robot on the parameters named in `columns`, in that order; `measured`:
    with the rows of sensors, along motions that have their places (None: joint torques alone).

    Raises UsageError for a name that the robot does not have.
    """
    tree, rows = (robot.tree, robot.rows) if measured is None else (measured.tree, measured.rows)
    inertial = {name: i for i, name in enumerate(robot.inertial_columns)}
    constants = {f"{row}.offset": robot.nv + k for k, row in enumerate(rows[robot.nv :])}
    weights: dict[int, list[tuple[int, Array]]] = {}
    terms = []
    for place, name in enumerate(columns):
        if name in inertial:
            body, parameter = divmod(inertial[name], 10)
            if tree.carrier[body] >= 0:  # a body welded to the world moves nothing
                weight = tree.X[body][:, parameter]
                weights.setdefault(int(tree.carrier[body]), []).append((place, weight))
        else:
            row = constants.get(name)  # of a sensor's component, or a joint's term
            terms.append(
                _term_column(robot, place, name)
                if row is None
                else TermColumn(place, row, "offset", 0, 0.0, row)
            )
    links = tuple(_link_columns(link, weights[link]) for link in sorted(weights))
    return Regression(tree, rows, tuple(columns), links, tuple(terms))


def _term_column(robot: RobotModel, place: int, name: str) -> TermColumn:
    try:
        term, dof, other = robot.term_index(name)
    except UsageError as error:
        raise unknown_name(
            "parameter", name, [*robot.inertial_columns, *_term_names(robot)]
        ) from error
    joint = next(joint for joint in robot.joints if joint.vadr == dof)
    suffix = SUFFIX["viscous" if other is not None else term]
    reference = float(robot.joint_terms.spring_reference[dof]) if term == "spring" else 0.0
    return TermColumn(place, dof, suffix, joint.qadr, reference, dof if other is None else other)


def _term_names(robot: RobotModel) -> list[str]:
    return [f"{robot.rows[dof]}.{suffix}" for dof in robot.scalar_dofs for suffix in TERM]


def _link_columns(link: int, weights: list[tuple[int, Array]]) -> LinkColumns:
    places = np.array([place for place, _ in weights])
    mix = np.array([weight for _, weight in weights])
    raw = tuple(int(c) for c in np.flatnonzero(mix.any(axis=0)))
    mix = mix[:, raw]
    plain = mix.shape[0] == mix.shape[1] and np.array_equal(mix, np.eye(len(raw)))
    return LinkColumns(link, raw, None if plain else mix, places)
