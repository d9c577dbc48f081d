"""Regression tau = Y theta on chosen parameters, evaluated in blocks of samples, row by row.

Each row of Y is stored without its structural zeros: joint i feels only the links behind it.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import Measured
from sysid_bench.regressors.kernel_c import Library, count_kernel, layout_of, select_kernel
from sysid_bench.regressors.kernel_layout import TERM_CODES, Columns, LinkColumns, TermColumn
from sysid_bench.regressors.kernel_numpy import blocks, body_columns, link_motions, motion_part
from sysid_bench.types import Array, Regressor, Trajectory

TermFunction = Callable[[Array, Array, Array], Array]

SMOOTH_RATE: Final = 0.05
"""rad/s, m/s: scale of tanh(v / scale), which replaces sign(v) in Coulomb friction while a motion
is optimised, since sign(v) has no gradient."""

TERM: Final[dict[str, TermFunction]] = {
    "fv": lambda q, v, a: v,
    "fc": lambda q, v, a: np.sign(v),
    "fc smooth": lambda q, v, a: np.tanh(v / SMOOTH_RATE),
    "offset": lambda q, v, a: np.ones_like(v),
    "Ia": lambda q, v, a: a,
    "k": lambda q, v, a: q,  # deflection of the spring: q minus its reference
}
"""Columns of joint terms as functions of (q, v, a) of the joint: viscous and Coulomb friction,
offset, rotor inertia, stiffness."""


@dataclass(frozen=True, eq=False)
class Regression(Columns):
    """Regressor Y (N, nv, p) of fixed columns along any motion."""

    @cached_property
    def library(self) -> Library | None:
        """Compiled kernel, if this process has one that supports all columns; else None."""
        known = all(term.kind in TERM_CODES for term in self.terms)
        return select_kernel().library if known else None

    def blocks(self, motion: Trajectory) -> Iterator["Block"]:
        """Yield Y of consecutive samples, in blocks that fit the cache."""
        library = self.library
        for part in blocks(motion):
            span = motion_part(motion, part)
            if library is not None:
                values = library.rows(layout_of(self), span)
            else:
                start = time.thread_time()
                values = self._values(span)
                count_kernel(start)
            yield Block(self, part, values)

    def _values(self, motion: Trajectory) -> Array:
        """Values (k, n) of a block by the NumPy kernel."""
        q, v, a = motion.q.T, motion.v.T, motion.a.T
        free = list(self.first)
        out = np.empty((sum(len(row) + 1 for row in self.row_columns), len(motion)))
        states = link_motions(self.tree, q, v, a)
        for columns in self.links:
            state = states[columns.link]
            A = body_columns(state, columns.raw)
            if columns.mix is not None:
                A = columns.mix @ A
            for zu, row in zip(state.ZU, self.tree.links[columns.link].dofs, strict=True):
                end = free[row] + A.shape[1]
                # einsum into a slice: one pass over A while it is in the first-level cache.
                np.einsum("in,icn->cn", zu, A, out=out[free[row] : end])
                free[row] = end
        for term in self.terms:
            values = TERM[term.kind](q[term.qadr] - term.reference, v[term.rate], a[term.rate])
            out[free[term.row]] = values
            free[term.row] += 1
        return out

    def dense(self, motion: Trajectory, out: Array | None = None) -> Regressor:
        """Return Y (N, nv, p) with its zeros, into `out` if it is given; for short motions and for
        comparisons."""
        if out is None:
            out = np.empty((len(motion), len(self.rows), len(self.columns)))
        library = self.library
        if library is not None:
            library.dense(layout_of(self), motion, out)
        else:
            for block in self.blocks(motion):
                block.dense(out[block.samples])
        return Regressor(out, self.rows, self.columns)

    def sample(self) -> "SampleRegressor":
        """Return Y as a function of one sample; each thread needs a function of its own."""
        nq, nv = self.tree.nq, self.tree.nv
        motion = Trajectory(np.zeros(1), np.zeros((1, nq)), np.zeros((1, nv)), np.zeros((1, nv)))
        Y = np.zeros((1, len(self.rows), len(self.columns)))
        if self.library is None:
            run: Callable[[], object] = partial(self.dense, motion, Y)
        else:
            run = self.library.bound(layout_of(self), motion, Y)
        return SampleRegressor(motion.q[0], motion.v[0], motion.a[0], Y[0], run)

    def torque(self, motion: Trajectory, theta: Array) -> Array:
        """Return Y theta (N, nv)."""
        tau = np.empty((len(motion), len(self.rows)))
        for block in self.blocks(motion):
            for i, touched in enumerate(self.row_columns):
                tau[block.samples, i] = theta[touched] @ block.row(i)
        return tau


@dataclass(frozen=True, eq=False)
class SampleRegressor:
    """Y (rows, p) of one sample at a time, for online use: the memory of the last sample q (nq,),
    v, a (nv,) and its Y, which every call overwrites."""

    q: Array
    v: Array
    a: Array
    Y: Array
    run: Callable[[], object]

    def __call__(self, q: Array, v: Array, a: Array) -> Array:
        """Return Y at one sample."""
        self.q[:], self.v[:], self.a[:] = q, v, a
        self.run()
        return self.Y


@dataclass(frozen=True, eq=False)
class Block:
    """Y of consecutive samples without structural zeros.

    `values` (k, n) holds the non-zero columns of all rows, row after row, from index `starts[i]` of
    the regression on for row i.
    """

    regression: Regression
    samples: slice
    values: Array

    @property
    def count(self) -> int:
        """Number n of samples."""
        return int(self.samples.stop - self.samples.start)

    def row(self, i: int, out: Array | None = None) -> Array:
        """Return row i of Y, (k, n), in the columns `touched[i]`: a view, or `out` if given."""
        start = self.regression.first[i]
        values = self.values[start : start + len(self.regression.row_columns[i])]
        if out is None:
            return values
        out[:] = values
        return out

    def row_with(self, i: int, b: Array) -> Array:
        """Return row i with a right-hand side b (n,) below it, (k + 1, n): a view of `values`."""
        start = self.regression.first[i]
        end = start + len(self.regression.row_columns[i])
        self.values[end] = b
        return self.values[start : end + 1]

    def dense(self, out: Array | None = None) -> Array:
        """Return Y (n, nv, p) with its zeros, into `out` if it is given."""
        shape = (self.count, len(self.regression.rows), len(self.regression.columns))
        Y = np.empty(shape) if out is None else out
        Y[:] = 0.0
        for i, touched in enumerate(self.regression.row_columns):
            values = self.row(i)
            for run in _runs(touched):
                Y[:, i, touched[run.start] : touched[run.stop - 1] + 1] = values[run].T
        return Y


def _runs(indices: Array, most: int = 16) -> Iterator[slice]:
    """Slices of at most `most` consecutive indices.

    Measured: NumPy copies wider transposes four times slower, single columns twenty times slower.
    """
    ends = (np.flatnonzero(np.diff(indices) != 1) + 1).tolist()
    for start, end in pairwise([0, *ends, len(indices)]):
        for first in range(start, end, most):
            yield slice(first, min(first + most, end))


def regression(
    robot: RobotModel, columns: Sequence[str], measured: Measured | None = None
) -> Regression:
    """Return the regression of a robot on the parameters named in `columns`, in that order.

    Rows are the joint torques; with `measured` also those of sensors, along motions that contain
    the sensors' coordinates. Raises UsageError for an unknown name.
    """
    tree, rows = (robot.tree, robot.rows) if measured is None else (measured.tree, measured.rows)
    inertial = {name: i for i, name in enumerate(robot.inertial_columns)}
    constants = {f"{row}.offset": robot.nv + k for k, row in enumerate(rows[robot.nv :])}
    weights: dict[int, list[tuple[int, Array]]] = {}
    terms = []
    for index, name in enumerate(columns):
        if name not in inertial:
            terms.append(_term_column(robot, index, name, constants))
            continue
        body, parameter = divmod(inertial[name], 10)
        if tree.carrier[body] >= 0:  # a body welded to the world loads no joint
            weight = tree.X[body][:, parameter]
            weights.setdefault(int(tree.carrier[body]), []).append((index, weight))
    links = []
    for link in sorted(weights):
        indices = np.array([index for index, _ in weights[link]])
        mix = np.array([weight for _, weight in weights[link]])
        # Raw columns that no parameter uses are not computed.
        raw = tuple(int(c) for c in np.flatnonzero(mix.any(axis=0)))
        mix = mix[:, raw]
        identity = mix.shape[0] == mix.shape[1] and np.array_equal(mix, np.eye(len(raw)))
        links.append(LinkColumns(link, raw, None if identity else mix, indices))
    return Regression(tree, rows, tuple(columns), tuple(links), tuple(terms))


def _term_column(
    robot: RobotModel, index: int, name: str, constants: Mapping[str, int]
) -> TermColumn:
    """Column of a joint term, or of the offset of a wrench component in its row of `constants`."""
    if name in constants:
        return TermColumn(index, constants[name], "offset", 0, 0.0, constants[name])
    try:
        term, dof, other = robot.resolve_term(name)
    except UsageError as error:
        terms = [f"{robot.rows[dof]}.{suffix}" for dof in robot.scalar_dofs for suffix in TERM]
        raise unknown_name("parameter", name, [*robot.inertial_columns, *terms]) from error
    joint = next(joint for joint in robot.joints if joint.vadr == dof)
    suffix = SUFFIX["viscous" if other is not None else term]
    reference = float(robot.joint_terms.spring_reference[dof]) if term == "spring" else 0.0
    return TermColumn(index, dof, suffix, joint.qadr, reference, dof if other is None else other)
