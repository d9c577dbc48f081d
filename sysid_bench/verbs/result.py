"""An estimate in the words of a user: bodies and joints, each number with its verdict."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from sysid_bench.evaluation.covariance import StandardError
from sysid_bench.identifiability.base_expressions import base_expressions, expression
from sysid_bench.identifiability.verdicts import verdicts
from sysid_bench.models.robot import SUFFIX
from sysid_bench.spatial.inertia import NAMES, mass_com_inertia, six_of_matrix
from sysid_bench.types import Array, Estimate, Problem

Sure = Mapping[str, StandardError]
"""How sure an estimate is, the way that is told first."""

TERM: Final = {suffix: term for term, suffix in SUFFIX.items()}


def values_of(estimate: Estimate, problem: Problem) -> Array:
    """theta (p,) as far as the method answers it: NaN where it gives a combination alone."""
    if estimate.theta is not None:
        return estimate.theta
    assert estimate.beta is not None
    told = np.array(verdicts(problem.base)) == "identifiable"
    return np.where(told, problem.base.embed(estimate.beta), np.nan)


def bodies_of(estimate: Estimate, problem: Problem, sure: Sure) -> dict[str, dict[str, Any]]:
    """{name: mass (kg), com (m), inertia about it (six, kg m^2), each None unless identifiable, and
    `parameters`, `identifiable` (verdicts), `std` of the ten}."""
    places = {name: j for j, name in enumerate(problem.parameters)}
    theta, told = values_of(estimate, problem), np.array(verdicts(problem.base))
    std = _std(problem, sure)
    answer = {}
    for body in problem.bodies:
        at = [places[column] for column in body.columns]
        alone = told[at] == "identifiable"
        _, com, inertia = mass_com_inertia(np.where(alone, theta[at], 0.0))
        answer[body.name] = {
            "mass": float(theta[at[0]]) if alone[0] else None,
            "com": com.tolist() if alone[:4].all() and theta[at[0]] > 0 else None,
            "inertia": six_of_matrix(inertia).tolist() if alone.all() else None,
            "parameters": dict(zip(NAMES, theta[at].tolist(), strict=True)),
            "identifiable": dict(zip(NAMES, told[at].tolist(), strict=True)),
            "std": dict(zip(NAMES, std[at].tolist(), strict=True)),
        }
    return answer


def base_of(estimate: Estimate, problem: Problem, sure: Sure) -> list[dict[str, Any]]:
    """[{expression, terms, value, std}] of the base parameters, in the order of their pivots."""
    assert estimate.beta is not None
    std = standard_deviations(sure, problem.base.rank)
    return [
        {"expression": expression(terms), "terms": terms, "value": float(value), "std": float(s)}
        for terms, value, s in zip(base_expressions(problem.base), estimate.beta, std, strict=True)
    ]


def joints_of(
    estimate: Estimate, problem: Problem, sure: Sure
) -> dict[str, dict[str, dict[str, Any]]]:
    """{joint: {term: value, identifiable, std}} of the joint terms that were asked for."""
    inertial = {column for body in problem.bodies for column in body.columns}
    theta, told, std = values_of(estimate, problem), verdicts(problem.base), _std(problem, sure)
    answer: dict[str, dict[str, dict[str, Any]]] = {}
    for j, name in enumerate(problem.parameters):
        if name not in inertial:
            joint, term = _joint_and_term(name)
            value = {"value": float(theta[j]), "identifiable": told[j], "std": float(std[j])}
            answer.setdefault(joint, {})[term] = value
    return answer


def _joint_and_term(name: str) -> tuple[str, str]:
    """ "j5.fv" is j5's "viscous", "j5.fv.j6" its "viscous_coupling.j6"."""
    joint, _, suffix = name.rpartition(".")
    if suffix in TERM:
        return joint, TERM[suffix]
    if ".fv." in name:
        joint, _, other = name.partition(".fv.")
        return joint, f"viscous_coupling.{other}"
    return joint, suffix


def warnings_of(estimate: Estimate, problem: Problem) -> list[str]:
    """What a reader of the numbers has to know first."""
    told = verdicts(problem.base)
    doubtful = [
        name
        for name, verdict in zip(problem.parameters, told, strict=True)
        if verdict != "identifiable"
    ]
    if not doubtful:
        return []
    names = f"{', '.join(doubtful[:10])}{', ...' if len(doubtful) > 10 else ''}"
    text = f"{len(doubtful)} of {len(told)} parameters are not identifiable on their own: {names}"
    if estimate.theta is not None:
        text += "; their values are the method's choice, and no residual can show it"
    return [text]


def std_from(sure: Sure) -> str | None:
    """Where standard deviations come from: "periods", "residuals", "textbook" (see
    evaluation/covariance.py); None where the method tells none."""
    return next(iter(sure), None)


def standard_deviations(sure: Sure, rank: int) -> Array:
    """Standard deviations (r,) of the base parameters; NaN where the method tells none."""
    return next((spread.std for spread in sure.values()), np.full(rank, np.nan))


def changed_parameters(estimate: Estimate, problem: Problem) -> list[str]:
    """What a completion had to change of the base parameters, where it had to."""
    if "moved" not in estimate.stats:
        return []
    return [
        "no bodies that can exist have exactly these base parameters: the nearest that do are "
        f"told, {estimate.stats['moved']:.3g} more in the sum of squared residuals over their "
        f"noise (about {problem.base.rank}, the number of base parameters, is what noise alone "
        "does)"
    ]


def _std(problem: Problem, sure: Sure) -> Array:
    """Standard deviations (p,) of the parameters that are identifiable, NaN elsewhere."""
    std = np.full(len(problem.parameters), np.nan)
    std[problem.base.pivots] = standard_deviations(sure, problem.base.rank)
    return np.where(np.array(verdicts(problem.base)) == "identifiable", std, np.nan)
