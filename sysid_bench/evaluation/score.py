"""Scores of one estimate: against the ground truth of a simulation, or on recordings.

The errors of both are those of torque_errors.py. On recordings only the measured torque is known.
Feasible is not plausible: some masses hardly affect the torques, and a feasible fit may give a link
a mass of a tonne. Density and centre of mass are therefore compared with the geometry of each body.
"""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from scipy.linalg import solve_triangular

from sysid_bench.evaluation.intervals import StandardError, held
from sysid_bench.evaluation.torque_errors import RowErrors, joint_figures, row_rms, torque_figures
from sysid_bench.identifiability.base_expressions import APART, parameter_verdict
from sysid_bench.identification.linear.least_squares import data_rank, stacked_factor
from sysid_bench.numerics import qr_factor
from sysid_bench.spatial import body_mass_inertia, feasible_margins, pseudo_inertia_distance
from sysid_bench.types import Array, BodyExtents, Estimate, Problem, Score, Truth

MAX_DENSITY: Final = 8000.0
"""kg/m^3: density of steel; the bounding box of a link has no higher mean density."""

MASSLESS: Final = 1e-6
"""kg: a lighter body is a frame without mass, and its centre of mass has no meaning."""


def body_plausibility(phi: Array, extent: BodyExtents | None) -> str:
    """Return what is implausible about a body with parameters phi (10,), as text; empty if nothing.

    `extent` is its bounding box in body axes; None leaves the checks of density and centre of mass
    out.
    """
    mass, com, _ = body_mass_inertia(phi)
    # Relative to the largest entry: a point mass has eigenvalues of zero up to rounding.
    if feasible_margins(phi) < -1e-9 * float(np.abs(phi).max()):
        return "it is not physically feasible"
    if mass <= MASSLESS or extent is None:
        return ""
    if mass > MAX_DENSITY * extent.volume:
        return f"{mass:.4g} kg in its {extent.volume:.2g} m^3 is denser than steel"
    outside = np.maximum(extent.low - com, com - extent.high).max()
    if outside > 0:
        return f"its centre of mass lies {outside:.2g} m outside of the link"
    return ""


def plausibility_findings(
    bodies: Mapping[str, Array], extents: Mapping[str, BodyExtents]
) -> dict[str, str]:
    """Return {name: reason} of the implausible ones among bodies {name: phi (10,)}."""
    reasons = {name: body_plausibility(phi, extents.get(name)) for name, phi in bodies.items()}
    return {name: reason for name, reason in reasons.items() if reason}


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
    return Score(
        **about_data,
        **torque_figures(held_out, moving or {}, beta),
        **_error_figures(list(held_out.values()), beta, beta_true),
        rmse_train=RowErrors([problem], beta).rms_error,
        beta_error=_relative(beta - beta_true, beta_true),
        coverage={
            kind: float(held(e, beta, beta_true).mean()) for kind, e in (errors or {}).items()
        },
        joints=tuple(joint_figures(problem, held_out, beta)),
        **_body_figures(_whole_theta(estimate, problem), problem, truth, extents),
    )


def base_parameters(estimate: Estimate) -> Array | None:
    """Return beta (r,) of an estimate; None where the method failed, whatever it returned."""
    return estimate.beta if estimate.status == "ok" else None


def _error_figures(tests: list[Problem], beta: Array, beta_true: Array) -> dict[str, Any]:
    if not tests:
        return {}
    r = len(beta)
    # |W x| = |R x| for each problem, so that W itself is not needed.
    R = np.concatenate([stacked_factor(problem)[:, :r] for problem in tests])
    return {
        "torque_error_sample": _sample_error(tests, beta),
        # In the metric of the held-out torques: a parameter that acts on none of them may be wrong.
        "parameter_error": _relative(R @ (beta - beta_true), R @ beta_true),
    }


def data_figures(problem: Problem, held_out: Mapping[str, Problem]) -> dict[str, Any]:
    """Return rank, condition numbers and information of the data, independent of the method.

    `condition` is that of the base regressor W, `condition_unit` with columns of unit length.
    """
    base = problem.base
    R = stacked_factor(problem)[: base.rank, : base.rank]
    norms = np.linalg.norm(R, axis=0)
    rank = data_rank(R)
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
    rms = row_rms(held_out)
    weights = np.where(rms > 0, 1.0 / np.where(rms > 0, rms, 1.0), 0.0).tolist()
    train = stacked_factor(problem, weights)[:r, :r]
    if data_rank(train) < r:
        return None
    # QR of the stacked factors: products R'R would square the condition number.
    tests = qr_factor(stacked_factor(test, weights)[:r, :r] for test in held_out)
    samples = sum(test.samples for test in held_out)
    spreads = np.linalg.svd(
        solve_triangular(train, tests.T, trans="T").T / np.sqrt(samples), compute_uv=False
    )
    # Directions that the held-out motions do not excite are rounding errors, whose log is large.
    spreads = spreads[spreads > 1e-9 * spreads[0]]
    return float(-2 * np.log(spreads).sum())


def _sample_error(problems: list[Problem], beta: Array) -> float | None:
    """Mean over samples of |error| / |torque|, norms over the joints, as in BIRDy (Leboutet et al.
    2021); None unless all rows are joint torques."""
    # A norm over rows in N and in N m would depend on the unit of length.
    if set(problems[0].kinds) != {"joint N m"}:
        return None
    ratios = []
    for Y, b in (block for problem in problems for block in problem.blocks()):
        size = np.linalg.norm(b, axis=1)
        nonzero = size > 0
        ratios.append(np.linalg.norm(b - Y @ beta, axis=1)[nonzero] / size[nonzero])
    relative = np.concatenate(ratios)
    return float(relative.mean()) if len(relative) else None


def _relative(difference: Array, reference: Array) -> float | None:
    size = float(np.linalg.norm(reference))
    return float(np.linalg.norm(difference)) / size if size > 0 else None


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
        true = _body_parameters(truth.theta, problem)[0]
        figures |= _payload_figures(phi[0], true, _has_mass(theta, problem))
    return figures


def _has_mass(theta: Array, problem: Problem) -> bool:
    """False where the mass of the only body acts on no row and theta (p,) leaves it at zero: then
    there is no centre of mass."""
    index = problem.parameters.index(problem.bodies[0].columns[0])
    # Within the row space of K such a mass is zero up to APART |theta|, and h / m is any number.
    is_left_out = abs(theta[index]) <= APART * np.linalg.norm(theta)
    return not (is_left_out and parameter_verdict(problem.base)[index] == "none")


def feasible_figures(theta: Array | None, problem: Problem) -> dict[str, Any]:
    """Return the smallest pseudo-inertia eigenvalue of all bodies, and `feasible`: True if all
    bodies are; {} without parameters theta (p,) or without unknown bodies."""
    if theta is None or not problem.bodies:
        return {}
    phi = _body_parameters(theta, problem)
    smallest = feasible_margins(phi)
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


def _payload_figures(phi: Array, phi_true: Array, has_mass: bool) -> dict[str, Any]:
    """Errors of phi (10,); those of the centre of mass and about it are None without a mass."""
    mass, com, inertia = body_mass_inertia(phi)
    mass_true, com_true, inertia_true = body_mass_inertia(phi_true)
    errors = {
        "mass_error": abs(mass - mass_true),
        "com_error": float(np.linalg.norm(com - com_true)) if has_mass else None,
        "inertia_error": _relative(inertia - inertia_true, inertia_true) if has_mass else None,
    }
    return {
        "payload_error": _relative(phi - phi_true, phi_true),
        "payload_mass_error_relative": abs(mass - mass_true) / mass_true if mass_true else None,
        "payload_distance": pseudo_inertia_distance(phi, phi_true),
        **{key: value for name, value in errors.items() for key in (name, f"payload_{name}")},
    }


def joint_errors(problem: Problem, beta: Array) -> dict[str, dict[str, Any]]:
    """Return {joint: {samples, rms, rmse, relative}} of one problem: RMS torque and RMS error
    (N m, N) for base parameters `beta` (r,)."""
    errors = RowErrors([problem], beta)
    return {
        factor.row: {
            "samples": factor.samples,
            "rms": float(errors.rms[i]),
            "rmse": float(errors.errors[i]),
            "relative": errors.relative_of(i),
        }
        for i, factor in enumerate(problem.factors)
    }


def score_recorded(
    estimate: Estimate,
    problem: Problem,
    tests: Mapping[str, Problem],
    about_data: Mapping[str, Any],
    moving: Mapping[str, Problem] | None = None,
) -> Score:
    """Return the scores of one estimate on recordings, without ground truth.

    `about_data` is the result of `data_figures`. Errors of joints are those of training and of the
    tests; the latter are RMS over all samples of the test recordings. `moving` are the tests
    without rows at standstill (None: not scored).
    """
    beta = base_parameters(estimate)
    if beta is None:
        return Score(**about_data)
    train = RowErrors([problem], beta)
    return Score(
        **about_data,
        **feasible_figures(estimate.theta, problem),
        rmse_train=train.rms_error,
        **torque_figures(tests, moving or {}, beta),
        joints=tuple(
            {**joint, "relative_train": train.relative_of(i)}
            for i, joint in enumerate(joint_figures(problem, tests, beta))
        ),
    )
