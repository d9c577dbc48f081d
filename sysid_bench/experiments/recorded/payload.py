"""Payloads identified from recordings: mass, centre of mass and inertia, with their intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.evaluation.feasible_body import GROUPS, FeasibleBody, body_values, feasible_body
from sysid_bench.evaluation.intervals import confidence_level, coverage_factor, jackknife_std
from sysid_bench.evaluation.score import base_parameters
from sysid_bench.experiments.recorded.left_out_parts import leave_one_fold_out
from sysid_bench.experiments.recorded.problem import LogProblemBuilder
from sysid_bench.experiments.recorded.process_log import ProcessedLog
from sysid_bench.experiments.recorded.unknowns import MASS
from sysid_bench.identifiability.base_expressions import parameter_verdict
from sysid_bench.identification.identify import identify
from sysid_bench.identification.linear.least_squares import RESIDUALS, row_std
from sysid_bench.types import Array, Body, Factor, Problem

SEPARATE: Final = 1e-3
"""Share of the payload's column of a row that the other columns must leave, for a mass there."""

ROUNDING: Final = 1e-12
"""Share of the largest column of a row below which a column is a rounding error."""

SMALLEST: Final = 1e-6
"""Share of the largest deviation of the joints that each has at least: along the axis of a joint a
load may have no torque at all, and the weights of the others would be lost in rounding."""

LARGEST: Final = 1e3
"""Deviation of torque scales that is not looked beyond: the load's mass is then unknown."""

BELOW: Final = 0.158655
"""Probability of a normal variable below minus one standard deviation."""

STEP: Final = 0.01
"""Change of a torque scale for the derivative of the payload by it, about as large as its error."""


# --- Scale of the torques -----------------------------------------------------------------------


@dataclass(frozen=True)
class TorqueScale:
    """Standard uncertainty (share) of the scale of the torques, as of drive gains. `std`: by joint;
    `common`: one factor for all joints, else factors of their own. `source`: "stated" by the logs
    (`tau.gain_std`), or between "joints": what their masses differ by; empty where neither is
    known."""

    source: str = ""
    std: Mapping[str, float] = field(default_factory=dict)
    common: bool = False

    def variance(self, slopes: Array) -> Array:
        """Return the variance (k,) of values whose derivatives by the scales of the rows are
        `slopes` (rows, k), rows in the order of `std`."""
        u = np.array(list(self.std.values()))
        if not len(u):
            return np.zeros(slopes.shape[1])
        moved = u[:, None] * slopes
        return np.asarray(moved.sum(axis=0) ** 2 if self.common else (moved**2).sum(axis=0))


def _stated_scale(rows: Sequence[str], training: Sequence[ProcessedLog]) -> TorqueScale | None:
    """The uncertainty that logs state, the largest of each joint; None without a statement."""
    std, common = dict.fromkeys(rows, 0.0), True
    for log in (one.log.description for one in training):
        common = common and len(log.tau.gain_std) <= 1
        if log.tau.gain_std:
            values = log.joint_values("tau.gain_std", log.tau.gain_std).tolist()
            for joint, value in zip(log.joints, values, strict=True):
                if joint in std:
                    std[joint] = max(std[joint], value)
    return TorqueScale("stated", std, common) if any(std.values()) else None


def largest_spread(values: Array, std: Array, slopes: Array) -> float:
    """The largest standard deviation of independent factors (k,) that `values` (n,), which should
    be equal, do not exclude at one standard deviation, given their own deviations `std` (n,) and
    their derivatives `slopes` (n, k) by the factors.

    Their weighted squares about the mean, Q, fall to the quantile of chi-squared with n - 1 degrees
    of freedom (Viechtbauer 2007). The usual estimate, Q equal to its mean, is zero where `std` is
    large, and would then claim exact gains.
    """
    from scipy.optimize import brentq
    from scipy.special import chdtri

    # P(Q < quantile) is that of a normal variable below minus one standard deviation.
    quantile = float(chdtri(len(values) - 1, 1.0 - BELOW))
    own, moved = np.diag(np.maximum(std, SMALLEST * std.max()) ** 2), slopes @ slopes.T

    def excess(spread: float) -> float:
        w = np.linalg.inv(own + spread**2 * moved)
        away = values - w.sum(axis=0) @ values / w.sum()
        return float(away @ w @ away) - quantile

    if excess(0.0) <= 0:
        return 0.0
    most = float(np.ptp(values))
    while excess(most) > 0 and most < LARGEST:
        most *= 2
    return float(brentq(excess, 0.0, most)) if most < LARGEST else LARGEST


# --- Mass of a load whose place is given ---------------------------------------------------------


@dataclass(frozen=True)
class PayloadMass:
    """kg; `parts`: the mass with each part of the motion left out; `by_joint`: the mass that the
    torque of one joint alone gives, with its deviation. They are equal up to noise if all torques
    have the right scale."""

    mass: float
    std: float
    interval: tuple[float, float]
    parts: tuple[float, ...]
    confidence: float
    by_joint: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def payload_mass(
    method: Any,
    problem: Problem,
    builder: LogProblemBuilder,
    training: Sequence[ProcessedLog],
    beta: Array,
) -> PayloadMass:
    """The mass in `beta` (r,), its deviation by the jackknife over parts of the motion (Tukey
    1958), by the disagreement of the joints and by the uncertainty of gains that logs state, and
    the interval of Student's t.

    Residuals are not white: a formal deviation would be too small by an order of magnitude. Raises
    EstimationError where the method fails without one of the parts.
    """
    index = problem.base.names.index(MASS)
    parts = leave_one_fold_out(problem, builder, training)
    masses = [float(_identified(method, part)[index]) for part in parts]
    by_joint = {}
    for i, row in enumerate(problem.rows):
        values = np.array([_row_mass(one.factors[i], index) for one in (problem, *parts)])
        # No mass of its own where the row's other unknowns explain the payload's torque as well.
        if np.isfinite(values).all():
            by_joint[row] = (float(values[0]), float(jackknife_std(values[1:, None])[0][0]))
    spread, freedom = jackknife_std(np.array(masses)[:, None])
    variance = spread[0] ** 2 + _disagreement(by_joint)
    if stated := _stated_scale(problem.rows, training):
        each = [np.eye(problem.base.rank)] * len(problem.rows)
        variance += stated.variance(_scale_slopes(problem, each)[index, :, None])[0]
    mass, std, factor = float(beta[index]), float(np.sqrt(variance)), coverage_factor(freedom)
    interval = (mass - factor * std, mass + factor * std)
    return PayloadMass(mass, std, interval, tuple(masses), confidence_level(), by_joint)


def _disagreement(by_joint: Mapping[str, tuple[float, float]]) -> float:
    """Variance (kg^2) that the mean over the joints has because they disagree by more than their
    deviations, as with errors of their torque scales."""
    masses, std = np.array(list(by_joint.values())).reshape(-1, 2).T
    if len(masses) < 2 or not (std > 0).all():
        return 0.0
    std = np.maximum(std, SMALLEST * std.max())
    w = 1 / std**2
    # DerSimonian and Laird (1986).
    excess = float(w @ (masses - w @ masses / w.sum()) ** 2) - (len(masses) - 1)
    between = max(excess, 0.0) / float(w.sum() - (w @ w) / w.sum())
    return float(1 / (1 / (std**2 + between)).sum() - 1 / w.sum())


def _row_mass(factor: Factor, index: int) -> float:
    """The mass in the fit of one row; NaN where it is not identifiable there."""
    at = np.flatnonzero(factor.columns == index)
    W, b = factor.R[:, :-1], factor.R[:, -1]
    scale = np.linalg.norm(W, axis=0)
    # A column that is zero up to rounding would be, at unit length, an unknown of random torque.
    acts = scale > ROUNDING * scale.max(initial=0.0)
    if len(at) == 0 or not acts[at[0]]:
        return float("nan")
    W = np.where(acts, W, 0.0) / np.where(acts, scale, 1.0)
    others = np.delete(W, at[0], axis=1)
    # The part of the mass column that the other unknowns of the row cannot take over.
    own = W[:, at[0]] - others @ np.linalg.lstsq(others, W[:, at[0]], rcond=None)[0]
    if np.linalg.norm(own) < SEPARATE:
        return float("nan")
    return float(own @ b / (own @ own) / scale[at[0]])


def _scale_slopes(problem: Problem, columns: Sequence[Array]) -> Array:
    """The derivatives (c, rows) by the scale of the torque of each row of x (c,), which the
    least-squares fit has with beta = columns[i] x in the row i, (r, c) each; rows are weighted by
    their residuals. NaN where the other unknowns take over the torque of one."""
    sigma, parts = row_std(problem, RESIDUALS), []
    for factor, one, std in zip(problem.factors, columns, sigma, strict=True):
        W = factor.R[:, :-1] @ one[factor.columns]
        parts.append(np.column_stack([W, factor.R[:, -1]]) / (std or 1.0))
    A = np.vstack(parts)
    scale = np.linalg.norm(A[:, :-1], axis=0)
    # A column that is zero up to rounding would be, at unit length, an unknown of random torque.
    acts = scale > ROUNDING * scale.max(initial=0.0)
    inverse = np.linalg.pinv(A[:, :-1] / np.where(acts, scale, np.inf))
    # The rows of the inverse of unit columns: one over the part that no other column takes over.
    alone = 1 / np.maximum(np.linalg.norm(inverse, axis=1), np.finfo(float).tiny)
    row = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    # x is linear in the torques: each row's part of it is its derivative by the scale of the row.
    slopes = (inverse * A[:, -1]) @ np.eye(len(parts))[row] / np.where(acts, scale, 1.0)[:, None]
    return np.asarray(np.where((acts & (alone > SEPARATE))[:, None], slopes, np.nan))


# --- A load with ten unknowns ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class RecordedPayload:
    """A load whose mass is positive and whose inertia about its centre of mass is feasible.

    `intervals` [low, high]: `mass` (kg), `com` (m, 3), `inertia` (kg m^2, 6), each where its
    parameters are identifiable on their own. `by_joint`: the mass of a load of this shape that the
    torque of each joint shows, with its deviation. `scale`: of the torques, in the intervals.
    """

    feasible: FeasibleBody
    intervals: dict[str, list[list[float]]]
    by_joint: dict[str, tuple[float, float]]
    scale: TorqueScale


def recorded_payload(
    method: Any,
    problem: Problem,
    builder: LogProblemBuilder,
    training: Sequence[ProcessedLog],
    beta: Array,
) -> RecordedPayload:
    """The feasible load nearest to `beta` (r,), with intervals by the jackknife of `payload_mass`
    and by the uncertainty of the torques' scale.

    Without a statement, factors of single joints count as independent, with the largest deviation
    that the joints do not exclude where they weigh the same load. Degrees of freedom of the sum:
    Welch and Satterthwaite.
    """
    columns = builder.unknowns.payload_parameters
    (body,) = (one for one in problem.bodies if one.columns == columns)
    at = [problem.parameters.index(name) for name in columns]
    known = np.array(parameter_verdict(problem.base))[at] == "identifiable"
    found = feasible_body(problem, beta, body)
    centre = body_values(problem.base.embed(found.beta)[at])
    parts = leave_one_fold_out(problem, builder, training)
    fits = [_feasible_values(part, _identified(method, part), body, at) for part in parts]
    mass = float(centre[0])
    by_joint: dict[str, tuple[float, float]] = {}
    scale = TorqueScale()
    if known.all() and mass > 0:
        by_joint, scale = _by_joint(problem, parts, found.beta, at)
    scale = _stated_scale(problem.rows, training) or scale
    each = [np.eye(problem.base.rank)] * len(problem.rows)
    slopes = [
        (_feasible_values(problem, beta + STEP * slope, body, at) - centre) / STEP
        for slope in np.nan_to_num(_scale_slopes(problem, each)).T
    ]
    std, freedom = jackknife_std(np.array(fits))
    # Half of the length (k,) of intervals with a variance (k,) of some degrees of freedom, and
    # one that is known
    variance = std**2
    other = scale.variance(np.array(slopes))
    total, least = variance + other, np.finfo(float).tiny
    freedoms = freedom * (np.maximum(total, least) / np.maximum(variance, least)) ** 2
    factors = np.array([coverage_factor(f) for f in freedoms])
    reach = np.asarray(factors * np.sqrt(total))
    intervals = _intervals(centre, reach, known)
    return RecordedPayload(found, intervals, by_joint, scale)


def _intervals(centre: Array, reach: Array, known: Array) -> dict[str, list[list[float]]]:
    """Ends of those values whose parameters are all in the mask `known` (10,)."""
    low = centre - reach
    low[[0, 4, 7, 9]] = np.maximum(low[[0, 4, 7, 9]], 0.0)  # mass and moments are not negative
    ends = np.stack([low, centre + reach], axis=1)
    # The centre of a mass that may be zero is anywhere.
    return {
        name: ends[part].tolist()
        for name, (part, count) in GROUPS.items()
        if known[:count].all() and (name == "mass" or low[0] > 0)
    }


def _feasible_values(problem: Problem, beta: Array, body: Body, at: Sequence[int]) -> Array:
    return body_values(problem.base.embed(feasible_body(problem, beta, body).beta)[at])


def _by_joint(
    problem: Problem, parts: Sequence[Problem], beta: Array, at: Sequence[int]
) -> tuple[dict[str, tuple[float, float]], TorqueScale]:
    """The mass of the load in `beta` (r,) that the torque of each joint shows, with its deviation,
    and the spread of the torque scales by which the joints disagree, two or more of them; `at`: the
    load's parameters, all identifiable."""
    own = [problem.base.pivots.tolist().index(i) for i in at]
    load = np.zeros(problem.base.rank)
    load[own] = beta[own]
    slopes, *others = (_shares_by_joint(one, load, own) for one in (problem, *parts))
    # A share is linear in the torques: the sum of its derivatives by their scales.
    shares = slopes.sum(axis=1)
    std, _ = jackknife_std(np.array([other.sum(axis=1) for other in others]))
    known = np.isfinite(shares + std)
    mass, names = float(load[own[0]]), np.array(problem.rows)[known].tolist()
    masses = (mass * np.column_stack([shares, std])[known]).tolist()
    found = {row: (value, deviation) for row, (value, deviation) in zip(names, masses, strict=True)}
    if known.sum() < 2 or not (std[known] > 0).all():
        return found, TorqueScale()
    spread = largest_spread(shares[known], std[known], slopes[known])
    return found, TorqueScale("joints", dict.fromkeys(problem.rows, spread))


def _shares_by_joint(problem: Problem, load: Array, own: Sequence[int]) -> Array:
    """The derivatives (rows, rows) by the scales of the torques of the factors (rows,) by which the
    torque of each joint would have a load whose base parameters are `load` (r,), `own` its indices,
    with all other unknowns common to the joints; NaN where these take over the load's torque."""
    n, r = len(problem.rows), problem.base.rank
    columns = np.zeros((n, r, n))
    columns[np.arange(n), :, np.arange(n)] = load
    others = np.delete(np.eye(r), own, axis=1)
    return _scale_slopes(problem, [np.hstack([others, one]) for one in columns])[-n:]


def _identified(method: Any, part: Problem) -> Array:
    """Base parameters (r,) of the motion without a part; EstimationError where there are none."""
    estimate = identify(method, part)
    beta = base_parameters(estimate)
    if beta is None:
        raise EstimationError(f"With a part of the motion left out: {estimate.reason}")
    return beta
