"""Scores of one estimate against the ground truth of a simulated experiment."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from scipy.linalg import solve_triangular

from sysid_bench.evaluation.plausibility import plausibility_findings
from sysid_bench.evaluation.standard_error import StandardError
from sysid_bench.identification.linear.normal_qr import excited_rank, residual_norm, stacked_factor
from sysid_bench.qr_factor import upper_factor
from sysid_bench.spatial.inertia import mass_com_inertia, min_eigenvalues
from sysid_bench.types import Array, BodyExtents, Estimate, Problem, Score, Truth

SMALL_JOINT: Final = 0.01
"""A row whose RMS torque is below this fraction of the largest of its kind is left out of the
means. Forces and torques, of joints and of a floating base, are kinds of their own
(`Problem.kinds`)."""

ROUNDING: Final = 1e-12
"""A row whose RMS torque is below this fraction of the largest of all rows is a rounding error."""

UNTESTED: Final = {"rmse_test": None, "rms": None, "relative": None, "small": True}
"""Fields of a joint without held-out motions."""


def score(
    estimate: Estimate,
    problem: Problem,
    held_out: Mapping[str, Problem],
    truth: Truth,
    extents: Mapping[str, BodyExtents] | None = None,
    about_data: Mapping[str, Any] | None = None,
    errors: Mapping[str, StandardError] | None = None,
    moving: Mapping[str, Problem] | None = None,
) -> Score:
    """Return the scores of one estimate against the truth.

    `held_out` are test problems with exact signals, `moving` the same without rows at standstill
    (None: not scored). `extents` are bounding boxes of bodies by name,
    for the plausibility check (None: no check); `errors` are standard errors by kind, whose
    coverage is reported (None: not reported). `about_data` is the result of `data_figures`,
    computed once for many estimates of a problem; it is reported for failed estimates too.
    """
    beta = base_parameters(estimate)
    about_data = data_figures(problem, held_out) if about_data is None else about_data
    if beta is None:
        return Score(**about_data)
    beta_true = problem.base.K @ truth.theta
    tests = list(held_out.values())
    train, test = RowErrors([problem], beta), RowErrors(tests, beta) if tests else None
    return Score(
        **about_data,
        **_held_out_figures(test, held_out, beta_true),
        **_moving_figures(list((moving or {}).values()), beta),
        rmse_train=train.rms_error,
        beta_error=_relative(beta - beta_true, beta_true),
        coverage={kind: _coverage(e, beta, beta_true) for kind, e in (errors or {}).items()},
        joints=tuple(_joint_figures(problem.rows, train, test)),
        **_body_figures(_whole_theta(estimate, problem), problem, truth, extents),
    )


def base_parameters(estimate: Estimate) -> Array | None:
    """Return beta (r,) of an estimate; None where the method failed, whatever it returned."""
    return estimate.beta if estimate.status == "ok" else None


def _held_out_figures(
    test: "RowErrors | None", held_out: Mapping[str, Problem], beta_true: Array
) -> dict[str, Any]:
    if test is None:
        return {}
    beta = test.beta
    return {
        "rmse_test": test.rms_error,
        "torque_error": test.torque_error,
        "torque_error_weighted": test.weighted,
        "torque_error_sample": _sample_error(test.problems, beta),
        "torque_error_worst": test.largest,
        "torque_error_by_motion": {
            name: RowErrors([problem], beta).torque_error for name, problem in held_out.items()
        },
        "parameter_error": _parameter_error(test.problems, beta, beta_true),
    }


def _moving_figures(moving: list[Problem], beta: Array) -> dict[str, Any]:
    """Return the error on the rows of moving joints; {} without held-out motions."""
    return {"torque_error_moving": RowErrors(moving, beta).torque_error} if moving else {}


def data_figures(problem: Problem, held_out: Mapping[str, Problem]) -> dict[str, Any]:
    """Return rank, condition numbers and information of the data, independent of the method.

    `condition` is that of the base regressor W, `condition_unit` with columns of unit length.
    """
    base = problem.base
    R = stacked_factor(problem)[: base.rank, : base.rank]
    norms = np.linalg.norm(R, axis=0)
    rank = excited_rank(R)
    figures: dict[str, Any] = {
        "rank": base.rank,
        "data_rank": rank,
        "parameters": len(problem.parameters),
        "rank_gap": base.gap if np.isfinite(base.gap) else None,
        "near_degenerate": base.near_degenerate,
    }
    if base.rank == 0 or rank < base.rank:
        return figures
    figures["condition"] = float(np.linalg.cond(R))
    # Columns in kg, kg m and kg m^2: a change of units scales them and alters the plain condition.
    figures["condition_unit"] = float(np.linalg.cond(R / norms))
    if held_out:
        figures["d_optimality"] = _d_optimality(problem, list(held_out.values()))
    return figures


def _d_optimality(problem: Problem, held_out: list[Problem]) -> float | None:
    """Return log det of the information that the training motion contains about held-out torques.

    With rows scaled by the held-out RMS torque of their joint, R factors R of training and R_h of
    the held-out motions, predicted torques have the covariance R_h (R'R)^-1 R_h' times the noise
    variance. The result is minus the log determinant, per mean sample, over the directions that the
    held-out motions excite. None if the rows with held-out torque do not identify all base
    parameters; a row without held-out torque has no scale.
    """
    r = problem.base.rank
    rms = _row_rms(held_out)
    weights = np.where(rms > 0, 1.0 / np.where(rms > 0, rms, 1.0), 0.0).tolist()
    train = stacked_factor(problem, weights)[:r, :r]
    if excited_rank(train) < r:
        return None
    # QR of the stacked factors: products R'R would square the condition number.
    tests = upper_factor(stacked_factor(test, weights)[:r, :r] for test in held_out)
    samples = sum(test.samples for test in held_out)
    spreads = np.linalg.svd(
        solve_triangular(train, tests.T, trans="T").T / np.sqrt(samples), compute_uv=False
    )
    # Directions that the held-out motions do not excite are rounding errors, whose log is large.
    spreads = spreads[spreads > 1e-9 * spreads[0]]
    return float(-2 * np.log(spreads).sum())


def _row_rms(problems: list[Problem]) -> Array:
    """RMS torque of each row (rows,) over all samples, known contributions included; zero where it
    is a rounding error."""
    squares = np.array([_row_counts(problem) * _torque(problem) ** 2 for problem in problems])
    rms = np.sqrt(squares.sum(axis=0) / _all_counts(problems))
    return np.where(rms > ROUNDING * rms.max(initial=0.0), rms, 0.0)


def _row_counts(problem: Problem) -> Array:
    """Return the samples of each row (rows,), at least 1: rows at standstill may be left out."""
    return np.array([max(factor.samples, 1) for factor in problem.factors])


def _all_counts(problems: list[Problem]) -> Array:
    return np.asarray(sum(_row_counts(problem) for problem in problems))


def _torque(problem: Problem) -> Array:
    """RMS torque of each row (rows,) of one problem."""
    if problem.torque is not None:
        return problem.torque
    # The last column of R is Q'b, which has the norm of b: Q is orthogonal.
    norms = np.array([np.linalg.norm(factor.R[:, -1]) for factor in problem.factors])
    return np.asarray(norms / np.sqrt(_row_counts(problem)))


@dataclass(frozen=True, eq=False)
class RowErrors:
    """Torque errors of `beta` on each row (rows,), over the samples of all `problems`."""

    problems: list[Problem]
    beta: Array

    @cached_property
    def errors(self) -> Array:
        """RMS error."""
        squares = np.array([residual_norm(p, self.beta) ** 2 for p in self.problems])
        return np.asarray(np.sqrt(squares.sum(axis=0) / _all_counts(self.problems)))

    @cached_property
    def rms(self) -> Array:
        """RMS torque."""
        return _row_rms(self.problems)

    @cached_property
    def judged_rows(self) -> Array:
        """Mask of the rows with enough torque to count in means."""
        # The relative error of a joint that carries hardly any torque is that of its noise.
        large = np.zeros(len(self.rms), dtype=bool)
        for of_kind in self._kinds:
            large[of_kind] = self.rms[of_kind] >= SMALL_JOINT * self.rms[of_kind].max()
        return np.asarray(large & (self.rms > 0))

    @cached_property
    def _kinds(self) -> list[Array]:
        """Mask of the rows of each kind: only their torques have a common unit."""
        names = np.array(self.problems[0].kinds or ("",) * len(self.rms))
        return [names == kind for kind in dict.fromkeys(names)]

    @cached_property
    def relative(self) -> Array:
        """RMS error over RMS torque; NaN where no unknown or no torque acts."""
        defined = np.array([len(factor.columns) > 0 for factor in self.problems[0].factors])
        defined &= self.rms > 0
        return np.where(defined, self.errors / np.where(defined, self.rms, 1.0), np.nan)

    @cached_property
    def judged(self) -> Array:
        """Relative errors of the rows in `judged_rows`."""
        return np.asarray(self.relative[self.judged_rows & np.isfinite(self.relative)])

    @property
    def rms_error(self) -> float:
        """RMS of all rows' errors."""
        return float(np.sqrt((self.errors**2).mean()))

    @property
    def torque_error(self) -> float | None:
        """RMS of the judged relative errors."""
        return float(np.sqrt((self.judged**2).mean())) if len(self.judged) else None

    @property
    def weighted(self) -> float | None:
        """RMS of the relative errors with each joint weighted by its RMS torque; kinds of rows,
        whose torques have no common unit, count equally."""
        rows = [kind & np.isfinite(self.relative) for kind in self._kinds]
        squares = [
            np.average(self.relative[part] ** 2, weights=self.rms[part])
            for part in rows
            if part.any()
        ]
        return float(np.sqrt(np.mean(squares))) if squares else None

    @property
    def largest(self) -> float | None:
        """Largest judged relative error."""
        return float(self.judged.max()) if len(self.judged) else None


def _sample_error(problems: list[Problem], beta: Array) -> float | None:
    """Mean over samples of |error| / |torque|, norms over the joints, as in BIRDy (Leboutet et al.
    2021); None unless all rows are joint torques."""
    # A norm over rows in N and in N m would depend on the unit of length.
    if set(problems[0].kinds) != {"joint N m"}:
        return None
    relative = np.concatenate([r for problem in problems for r in _sample_ratios(problem, beta)])
    return float(relative.mean()) if len(relative) else None


def _sample_ratios(problem: Problem, beta: Array) -> Iterator[Array]:
    """|error| / |torque| (n,) of the samples of each block that have a torque."""
    for Y, b in problem.blocks():
        size = np.linalg.norm(b, axis=1)
        nonzero = size > 0
        yield np.linalg.norm(b - Y @ beta, axis=1)[nonzero] / size[nonzero]


def _parameter_error(problems: list[Problem], beta: Array, beta_true: Array) -> float | None:
    """|W (beta - beta*)| / |W beta*| over the held-out rows."""
    r = len(beta)
    # |W x| = |R x| for each problem, so that W itself is not needed.
    R = np.concatenate([stacked_factor(problem)[:, :r] for problem in problems])
    return _relative(R @ (beta - beta_true), R @ beta_true)


def _coverage(error: StandardError, beta: Array, beta_true: Array) -> float:
    """Fraction of parameters whose confidence interval contains the truth."""
    low, high = error.interval(beta)
    return float(((low <= beta_true) & (beta_true <= high)).mean())


def _relative(difference: Array, reference: Array) -> float | None:
    size = float(np.linalg.norm(reference))
    return float(np.linalg.norm(difference)) / size if size > 0 else None


def _joint_figures(
    names: Sequence[str], train: RowErrors, test: RowErrors | None
) -> Iterator[dict[str, Any]]:
    for i, name in enumerate(names):
        held_out = UNTESTED if test is None else _joint_on_tests(test, i)
        yield {"name": name, "rmse_train": float(train.errors[i]), **held_out}


def _joint_on_tests(test: RowErrors, i: int) -> dict[str, Any]:
    """Fields of row i on the held-out motions."""
    return {
        "rmse_test": float(test.errors[i]),
        "rms": float(test.rms[i]),
        "relative": float(test.relative[i]) if np.isfinite(test.relative[i]) else None,
        "small": not bool(test.judged_rows[i]),
    }


def _whole_theta(estimate: Estimate, problem: Problem) -> Array | None:
    """All parameters (p,) of an estimate; None if the method determines base parameters alone."""
    if estimate.theta is not None or estimate.beta is None:
        return estimate.theta
    # Each parameter is then a base parameter of its own, as those of a payload are.
    complete = problem.base.rank == len(problem.parameters)
    return problem.base.embed(estimate.beta) if complete else None


def _body_figures(
    theta: Array | None, problem: Problem, truth: Truth, extents: Mapping[str, BodyExtents] | None
) -> dict[str, Any]:
    """Feasibility, plausibility and errors of bodies; {} unless all ten parameters of each body are
    estimated or known."""
    if theta is None or not problem.bodies:
        return {}
    figures, phi = feasible_figures(theta, problem), _body_parameters(theta, problem)
    if extents is not None:
        named = {body.name: one for body, one in zip(problem.bodies, phi, strict=True)}
        figures["plausible"] = not plausibility_findings(named, extents)
    if len(problem.bodies) == 1:
        figures |= _payload_figures(phi[0], _body_parameters(truth.theta, problem)[0])
    return figures


def feasible_figures(theta: Array | None, problem: Problem) -> dict[str, Any]:
    """Return the smallest pseudo-inertia eigenvalue of all bodies, and `feasible`: True if all
    bodies are; {} without parameters theta (p,) or without unknown bodies."""
    if theta is None or not problem.bodies:
        return {}
    phi = _body_parameters(theta, problem)
    smallest = min_eigenvalues(phi)
    scale = np.abs(phi).max(axis=1)
    return {
        "min_eigenvalue": float(smallest.min()),
        # The pseudo-inertia of a point mass has rank one: an eigenvalue of zero up to rounding is
        # still feasible.
        "feasible": bool((smallest >= -1e-9 * scale).all()),
    }


def _body_parameters(theta: Array, problem: Problem) -> Array:
    """phi (nb, 10) of the unknown bodies."""
    index = {name: i for i, name in enumerate(problem.parameters)}
    return np.array([[theta[index[c]] for c in body.columns] for body in problem.bodies])


def _payload_figures(phi: Array, phi_true: Array) -> dict[str, Any]:
    mass, com, inertia = mass_com_inertia(phi)
    mass_true, com_true, inertia_true = mass_com_inertia(phi_true)
    return {
        "payload_error": _relative(phi - phi_true, phi_true),
        "mass_error": abs(mass - mass_true),
        "com_error": float(np.linalg.norm(com - com_true)),
        "inertia_error": _relative(inertia - inertia_true, inertia_true),
    }
