"""Information of a motion: its regressor, and criteria of optimal experiment design with gradients.

All criteria but `cond-unit` are functions f of the singular values of W S, W (M, r) the base
regressor, with a fixed S (r, r): with W S = U diag(s) V', the gradient by W is
W S V diag(f'(s) / s) V' S'. All are logarithms to be minimised, so that weighted sums make sense
(Pukelsheim 1993; Swevers et al. 1997).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.coupling.pullback import Slopes
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import SensorSubtree, instruments_of
from sysid_bench.models.tree import Tree
from sysid_bench.qr_factor import qr_factor
from sysid_bench.regressors.coupled import (
    AnyRegression,
    pullback,
    pullback_torque,
    smooth_regression,
    torque_regression,
)
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.types import Array, Trajectory

SpectralFunction = Callable[[Array], tuple[float, Array]]
"""Map of singular values s (r,), the largest first, to f and f' (r,)."""


def _condition(s: Array) -> tuple[float, Array]:
    slope = np.zeros_like(s)
    slope[0] += 1 / s[0]
    slope[-1] -= 1 / s[-1]
    return float(np.log(s[0] / s[-1])), slope


def _d_optimality(s: Array) -> tuple[float, Array]:
    return float(-2 * np.log(s).mean()), -2 / (len(s) * s)


def _a_optimality(s: Array) -> tuple[float, Array]:
    total = (s**-2.0).sum()
    return float(np.log(total)), -2 * s**-3.0 / total


def _e_optimality(s: Array) -> tuple[float, Array]:
    slope = np.zeros_like(s)
    slope[-1] = -2 / s[-1]
    return float(-2 * np.log(s[-1])), slope


CRITERIA: Final[Mapping[str, str]] = {
    "cond": "log of the condition number, SI columns",
    "cond-unit": "log of the condition number, unit columns",
    "D": "minus log det of the information matrix, per parameter",
    "A": "log of the summed variance of the base parameters, SI columns",
    "E": "minus log of the information about the worst direction, SI columns: its smallest "
    "eigenvalue, the square of the smallest singular value",
    "predict": "log of the predicted variance of the torques of other motions",
}
"""Criteria by name, all to be minimised."""

_SPECTRAL: Final[Mapping[str, SpectralFunction]] = {
    "cond": _condition,
    "cond-unit": _condition,
    "D": _d_optimality,
    "A": _a_optimality,
    "E": _e_optimality,
    "predict": _a_optimality,
}


@dataclass(frozen=True, eq=False)
class Criterion:
    """Weighted sum of criteria on rows W (M, r).

    `known` (k, r): rows recorded before, or their R factor, which are stacked on W. `whiten`
    (r, r): S of `predict`, the inverse R factor of the motions whose torques are predicted.
    """

    weights: Mapping[str, float]
    known: Array
    whiten: Array

    def value(self, W: Array) -> float:
        """Return the sum; infinity where the rows leave a parameter undetermined."""
        return self._evaluate(W, slope=False)[0]

    def gradient(self, W: Array) -> Array:
        """Return the gradient by W (M, r)."""
        return self._evaluate(W, slope=True)[1]

    def _evaluate(self, W: Array, slope: bool) -> tuple[float, Array]:
        total, by_W = 0.0, np.zeros_like(W) if slope else W
        rows = np.concatenate([self.known, W])
        R = qr_factor([rows])  # singular values of R are those of the rows
        for name, weight in self.weights.items():
            spectrum = self._spectrum(name, R)
            if spectrum is None:
                return np.inf, by_W
            f, df = _SPECTRAL[name](spectrum.s)
            total += weight * f
            if slope:
                by_W += _weighted_gradient(weight, spectrum, df, W, rows)
        return total, by_W

    def _spectrum(self, name: str, R: Array) -> "_Spectrum | None":
        """Return the singular values of a criterion, None where a parameter is undetermined."""
        norms = np.linalg.norm(R, axis=0) if name == "cond-unit" else None
        if len(R) < R.shape[1] or (norms is not None and not norms.all()):
            return None
        S = self.whiten if name == "predict" else None
        if norms is not None:
            S = np.diag(1 / norms)
        scaled = R if S is None else R @ S
        if not np.isfinite(scaled).all():  # limits near the smallest numbers
            return None
        _, s, Vt = np.linalg.svd(scaled)
        return _Spectrum(s, Vt, S, norms) if s[-1] > 1e-12 * s[0] else None


class _Spectrum(NamedTuple):
    """Singular values s (r,) of R S, its right singular vectors, S (None: identity), and the norms
    of the columns where S scales them to one."""

    s: Array
    Vt: Array
    S: Array | None
    norms: Array | None


def _weighted_gradient(
    weight: float, spectrum: _Spectrum, df: Array, W: Array, rows: Array
) -> Array:
    """Return weight times the gradient by W (M, r), from the slope df (r,) by s."""
    s, Vt, S, norms = spectrum
    core = (Vt.T * (df / s)) @ Vt
    if norms is not None:
        # All rows together have columns of norm 1. The norms change with W, so the part along each
        # column, which only lengthens it, is projected out.
        unit, rows = W / norms, rows / norms
        along = (rows * (rows @ core)).sum(axis=0)
        return np.asarray(weight * (unit @ core - unit * along) / norms)
    return np.asarray(weight * (W @ (core if S is None else S @ core @ S.T)))


def criterion_weights(objective: str | Mapping[str, float]) -> dict[str, float]:
    """Return criteria and weights of a name or a table {D = 1, cond = 0.1}.

    Raises UsageError for an unknown name, a weight that is not positive, or an empty table.
    """
    table = {objective: 1.0} if isinstance(objective, str) else dict(objective)
    for name, weight in table.items():
        if name not in CRITERIA:
            raise unknown_name("objective", name, CRITERIA)
        number = isinstance(weight, (int, float)) and not isinstance(weight, bool)
        if not (number and 0 < weight < np.inf):
            raise UsageError(f"The objective {name!r} needs a positive weight; got {weight!r}.")
    if not table:
        raise UsageError(f"An objective needs a criterion; there are: {', '.join(CRITERIA)}.")
    return table


@dataclass(frozen=True, eq=False)
class InformationModel:
    """Base regressor of a task: `columns` of `regression` at its `measured` rows.

    `instrumented` adds the degrees of freedom of force sensors to a motion.
    """

    regression: AnyRegression
    measured: tuple[int, ...]
    columns: tuple[int, ...]
    instrumented: Callable[[Trajectory], Trajectory] = lambda motion: motion

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the base parameters (r,)."""
        return tuple(self.regression.columns[c] for c in self.columns)

    def rows(self, motion: Trajectory) -> Array:
        """Return Y (N, rows, r) in SI."""
        rows, columns = list(self.measured), list(self.columns)
        blocks = self.regression.blocks(self.instrumented(motion))
        return np.concatenate([block.dense()[:, rows][:, :, columns] for block in blocks])

    def gradient(self, motion: Trajectory, G: Array) -> Slopes:
        """Return derivatives of sum(G * Y) by q, v, a (N, nv); G (N, rows, r)."""
        whole = np.zeros((len(motion), len(self.regression.rows), len(self.regression.columns)))
        rows, columns = np.ix_(self.measured, self.columns)
        whole[:, rows, columns] = G
        q, v, a = pullback(self.regression, self.instrumented(motion), whole)
        nv = motion.v.shape[1]  # sensors come after all joints
        return q[:, :nv], v[:, :nv], a[:, :nv]

    def select_columns(self, names: tuple[str, ...]) -> "InformationModel":
        """Return the same model of some of its base parameters."""
        return replace(self, columns=tuple(self.regression.columns.index(name) for name in names))

    @cached_property
    def smooth(self) -> "InformationModel":
        """Same model with a smooth sign(v), differentiable for a search."""
        return replace(self, regression=smooth_regression(self.regression))


@dataclass(frozen=True, eq=False)
class TorqueModel:
    """Torques of the independent joints by known parameters: `theta` (p,) of `regression`, and
    inertial parameters `links` (n_links, 10) of the tree."""

    regression: AnyRegression
    theta: Array
    links: Array
    tree: Tree
    coupling: Coupling | None = None

    def of(self, motion: Trajectory) -> Array:
        """Return tau (N, n) in N m or N."""
        tau = newton_euler(self.tree, self.links, motion)
        if self.coupling is not None:
            tau = self.coupling.reduced(motion.q, tau)
        return np.asarray(tau + self.regression.torque(motion, self.theta))

    def gradient(self, motion: Trajectory, U: Array) -> Slopes:
        """Return derivatives of sum(U * tau) by q, v, a (N, nv); U (N, n)."""
        parts = [pullback_torque(self.tree, self.coupling, self.links, motion, U)]
        if self.theta.any():
            parts.append(pullback(self.regression, motion, U[:, :, None] * self.theta))
        q, v, a = (sum(part) for part in zip(*parts, strict=True))
        return q, v, a


def information_model(
    robot: RobotModel,
    base_names: tuple[str, ...],
    rows: tuple[str, ...] | None = None,
    cuts: tuple[SensorSubtree, ...] = (),
) -> InformationModel:
    """Return the regressor of the base parameters named.

    `rows`: measured torques and wrench components (None: torques of all independent joints, and
    all components of the force sensors `cuts`).
    """
    instruments = instruments_of(robot, cuts)
    names = instruments.measured if rows is None else rows
    measured = tuple(instruments.measured.index(row) for row in names)
    regression = torque_regression(robot, base_names, instruments)
    columns = tuple(range(len(base_names)))
    return InformationModel(regression, measured, columns, instruments.motion)


def torque_model(robot: RobotModel) -> TorqueModel:
    """Return the torque model by the parameters in the robot's own file, payload included."""
    between = np.argwhere(robot.joint_terms.viscous_coupling)
    terms = (*SUFFIX, *(f"{robot.rows[i]}.fv.{robot.rows[j]}" for i, j in between))
    columns = torque_regression(robot, robot.term_columns(terms))
    links = robot.tree.link_parameters(robot.phi)
    return TorqueModel(columns, robot.term_values(terms), links, robot.tree, robot.coupling)
