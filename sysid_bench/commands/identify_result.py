"""Result of an identification from any data: fields of an estimate, with verdicts, and its text."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Final

import numpy as np

from sysid_bench.commands.result import OMIT_NONE, Result, estimate_text
from sysid_bench.errors import SHOWN, count_text, first_names
from sysid_bench.evaluation.covariance import block_errors, motion_fit, standard_errors
from sysid_bench.evaluation.intervals import StandardError
from sysid_bench.evaluation.open_directions import OpenDirections
from sysid_bench.identifiability.base_expressions import (
    base_expressions,
    expression,
    parameter_verdict,
)
from sysid_bench.identification.identify import fit_fields
from sysid_bench.models.robot import SUFFIX
from sysid_bench.spatial import NAMES, body_mass_inertia, inertia_values
from sysid_bench.types import Array, Estimate, Problem
from sysid_bench.words import INTERVAL_LIMITS

Errors = Mapping[str, StandardError]
"""Standard errors by the way they were found; the first one is reported."""

ZERO_TORQUE: Final = 1.0
"""Torque error of an answer that predicts no torque at all."""

TERM: Final = {suffix: term for term, suffix in SUFFIX.items()}


def estimate_fields(estimate: Estimate, problem: Problem, method: Any) -> dict[str, Any]:
    """Return the fields `converged`, `iterations`, `simulations`, `stop`, `std_from`, `std_limit`,
    `base`, `bodies` and `joints` of an estimate.

    `std_from`: origin of the standard deviations, "motions", "periods", "residuals", "textbook"
    (see evaluation/covariance.py) or, where the `method` gives none, "blocks" of time; None without
    any. `std_limit`: what they do not hold, or the reason why there are none.
    """
    errors: Errors = standard_errors(problem, estimate)
    reason = None
    if not errors:
        found = block_errors(problem, estimate, method)
        errors, reason = ({}, found) if isinstance(found, str) else ({"blocks": found}, None)
    return {
        **fit_fields(estimate),
        "std_from": next(iter(errors), None),
        "std_limit": reason or _limit(estimate, problem, errors),
        "base": _base(estimate, problem, errors),
        "bodies": _bodies(estimate, problem, errors),
        "joints": _joints(estimate, problem, errors),
    }


def _limit(estimate: Estimate, problem: Problem, errors: Errors) -> str | None:
    """Contents and limits of the deviations, and the reason where there are none between motions;
    None without any deviations."""
    kind = next(iter(errors), None)
    if kind in (None, "blocks"):
        return None if kind is None else INTERVAL_LIMITS[kind]
    fits = motion_fit(problem, estimate)
    reason = f" (none between motions: {fits})" if isinstance(fits, str) else ""
    return INTERVAL_LIMITS[kind] + reason


def parameters_with(body: Mapping[str, Any], verdict: str) -> list[str]:
    """Return the parameters of a body that have a verdict."""
    return [key for key, value in body["identifiable"].items() if value == verdict]


def values_of(estimate: Estimate, problem: Problem) -> Array:
    """Return theta (p,); NaN where the method identifies a combination alone."""
    if estimate.theta is not None:
        return estimate.theta
    assert estimate.beta is not None
    values: Array = np.where(_identifiable(problem), problem.base.embed(estimate.beta), np.nan)
    return values


def _identifiable(problem: Problem) -> Array:
    """Mask (p,) of the parameters that are identifiable on their own."""
    mask: Array = np.array(parameter_verdict(problem.base)) == "identifiable"
    return mask


def _bodies(estimate: Estimate, problem: Problem, errors: Errors) -> dict[str, dict[str, Any]]:
    """{name: mass (kg), com (m), inertia about the centre of mass (six, kg m^2), each None unless
    identifiable, and `parameters`, `identifiable` (verdicts), `std` of the ten}."""
    columns = {name: j for j, name in enumerate(problem.parameters)}
    theta, verdict = values_of(estimate, problem), np.array(parameter_verdict(problem.base))
    std = _std(problem, errors)
    tens = {body.name: [columns[column] for column in body.columns] for body in problem.bodies}
    return {name: _body(theta[ten], verdict[ten], std[ten]) for name, ten in tens.items()}


def _body(phi: Array, verdict: Array, std: Array) -> dict[str, Any]:
    """Fields of a body from its ten parameters (m, h, I about the frame's origin)."""
    single = verdict == "identifiable"
    # Combinations count as zero here; com and inertia are only given where none is needed.
    _, com, inertia = body_mass_inertia(np.where(single, phi, 0.0))
    return {
        "mass": float(phi[0]) if single[0] else None,
        "com": com.tolist() if single[:4].all() and phi[0] > 0 else None,
        "inertia": inertia_values(inertia).tolist() if single.all() else None,
        "parameters": dict(zip(NAMES, phi.tolist(), strict=True)),
        "identifiable": dict(zip(NAMES, verdict.tolist(), strict=True)),
        "std": dict(zip(NAMES, std.tolist(), strict=True)),
    }


def _base(estimate: Estimate, problem: Problem, errors: Errors) -> list[dict[str, Any]]:
    """[{expression, terms, value, std}] of the base parameters, in order of their pivots."""
    assert estimate.beta is not None
    std = _base_std(errors, problem.base.rank)
    return [
        {"expression": expression(terms), "terms": terms, "value": float(value), "std": float(s)}
        for terms, value, s in zip(base_expressions(problem.base), estimate.beta, std, strict=True)
    ]


def _joints(
    estimate: Estimate, problem: Problem, errors: Errors
) -> dict[str, dict[str, dict[str, Any]]]:
    """{joint: {term: value, identifiable, std}} of the unknown joint terms."""
    inertial = {column for body in problem.bodies for column in body.columns}
    theta, std = values_of(estimate, problem), _std(problem, errors)
    joints: dict[str, dict[str, dict[str, Any]]] = {}
    for name, value, verdict, deviation in zip(
        problem.parameters, theta, parameter_verdict(problem.base), std, strict=True
    ):
        if name not in inertial:
            joint, term = _joint_and_term(name)
            entry = {"value": float(value), "identifiable": verdict, "std": float(deviation)}
            joints.setdefault(joint, {})[term] = entry
    return joints


def _joint_and_term(name: str) -> tuple[str, str]:
    """Joint and term of a parameter: "j5.fv" is j5's "viscous", "j5.fv.j6" its
    "viscous_coupling.j6"."""
    joint, _, suffix = name.rpartition(".")
    if suffix in TERM:
        return joint, TERM[suffix]
    if ".fv." in name:
        joint, _, other = name.partition(".fv.")
        return joint, f"viscous_coupling.{other}"
    return joint, suffix


def warnings_of(estimate: Estimate, problem: Problem) -> list[str]:
    """Warn about an iteration that did not converge, and about parameters that are not identifiable
    on their own, combinations first."""
    warnings = [] if estimate.converged is not False else [_unconverged(estimate)]
    choice = "; their values are the method's choice, which no residual can confirm"
    doubts = _not_alone(problem)
    return [*warnings, *(f"{one}{'' if estimate.theta is None else choice}" for one in doubts)]


def open_warnings(directions: OpenDirections) -> list[str]:
    """Warn about directions that the motion leaves open."""
    if directions.count == 0:
        return []
    return [
        f"the motion leaves {directions.count} of {directions.rank} directions of the base "
        f"parameters open, most of all {', '.join(directions.names)}: noise or a prior decides "
        "them, and torques of other motions may be far off. Record a richer motion (sysid-bench "
        "excite), or use a method with a prior (--estimator lmi)"
    ]


def failure_of(torque_error: float | None) -> str | None:
    """Return why an answer fails its test, as a sentence; None where it does not, or without a
    test."""
    if torque_error is None or torque_error <= ZERO_TORQUE:
        return None
    return (
        f"torque error {torque_error:.4g} on held-out data: the answer errs more than zero torque "
        "does, whose error is 1; do not use it for other motions"
    )


def _not_alone(problem: Problem) -> list[str]:
    """A sentence on the parameters that are not identifiable on their own; nothing without any."""
    # Parameters without effect, as those of a fixed base, come last.
    without_effect = _names(problem, "none")
    names = [*_names(problem, "combination"), *without_effect]
    if not names:
        return []
    effect = f" ({len(without_effect)} have no effect)" if without_effect else ""
    return [
        f"{len(names)} of {len(problem.parameters)} parameters are not identifiable on their own"
        f"{effect}: {', '.join(names[:8])}{', ...' if len(names) > 8 else ''}"
    ]


def _unconverged(estimate: Estimate) -> str:
    return f"the method has not converged; its last iterate is reported: {estimate.stop}"


def _names(problem: Problem, verdict: str) -> list[str]:
    """Parameters with a verdict."""
    verdicts_of = zip(problem.parameters, parameter_verdict(problem.base), strict=True)
    return [name for name, found in verdicts_of if found == verdict]


def _base_std(errors: Errors, rank: int) -> Array:
    """Standard deviations (r,) of the base parameters; NaN where none are known."""
    return next((error.std for error in errors.values()), np.full(rank, np.nan))


def completion_warnings(estimate: Estimate, problem: Problem) -> list[str]:
    """Warn about base parameters that a completion had to change to find feasible bodies."""
    if "moved" not in estimate.stats:
        return []
    return [
        "no feasible bodies have exactly these base parameters: the nearest feasible ones are "
        f"reported, {estimate.stats['moved']:.3g} more in the sum of squared residuals over their "
        f"noise (noise alone adds about {problem.base.rank}, the number of base parameters)"
    ]


def _std(problem: Problem, errors: Errors) -> Array:
    """Standard deviations (p,) of the parameters that are identifiable, NaN elsewhere."""
    std = np.full(len(problem.parameters), np.nan)
    std[problem.base.pivots] = _base_std(errors, problem.base.rank)
    known: Array = np.where(_identifiable(problem), std, np.nan)
    return known


STD_FROM: Final = {
    "motions": "from the spread between different motions",
    "periods": "from the spread over repeated periods",
    "residuals": "from residuals and the correlation of neighbouring ones",
    "blocks": "from the fits with one of 8 parts of the motion left out (jackknife)",
    "files": "between the values of single files",
    "textbook": "by the method's own formula",
}

WEAKEST: Final = 3
"""Base parameters at the end of the summary, those with the largest relative deviations."""

TERMS: Final = 4
"""Terms of one base parameter in the summary."""


_BEHIND: Final = "behind"


def behind(name: str) -> dict[str, Any]:
    """Return the metadata of a field that the JSON has behind another one: a dataclass itself has
    the fields of its base first."""
    return {_BEHIND: name}


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class IdentifyResult(Result):
    """Identified parameters with their verdicts, and the errors of the predicted torques.

    `bodies`: {name: mass (kg), com (m), inertia about the centre of mass (Ixx Ixy Ixz Iyy Iyz Izz,
    kg m^2), parameters, identifiable, std}; a value is None unless it is identifiable. `joints`:
    {joint: {term: value, identifiable, std}}. `base`: base parameters with one standard deviation.
    `std_limit`: what these deviations hold, and which bias they do not know of. RMS errors in N m
    or N.
    """

    model: str
    file: str
    task: str
    terms: list[str]
    rows: list[str]
    estimator: str
    rank: int | None
    data_rank: int | None
    parameters: int | None
    condition: float | None
    condition_unit: float | None
    rmse_train: float | None
    rmse_test: float | None
    torque_error: float | None
    converged: bool | None
    iterations: int | None
    simulations: int | None
    stop: str
    std_from: str | None
    std_limit: str | None
    base: list[dict[str, Any]]
    bodies: dict[str, dict[str, Any]]
    joints: dict[str, dict[str, Any]]
    payload: dict[str, Any] | None
    feasible: bool | None
    warnings: list[str]
    model_out: str | None = field(default=None, metadata=OMIT_NONE)

    def __post_init__(self) -> None:
        self._make_plain()

    def _fields(self) -> dict[str, Any]:
        values, names = super()._fields(), dict[str | None, list[str]]()
        for entry in fields(self):
            names.setdefault(entry.metadata.get(_BEHIND), []).append(entry.name)

        def keys(before: str | None) -> Iterator[str]:
            for name in names.get(before, ()):
                yield name
                yield from keys(name)

        return {key: values[key] for key in keys(None) if key in values}

    @property
    def _urgent(self) -> int:
        """Number of warnings that come before the answer: a failed test, open directions."""
        return bool(self.get("failure")) + bool(self.get("open_directions"))

    def _opening_lines(self) -> list[str]:
        """Warnings without which the answer is misread."""
        return [f"warning: {warning}" for warning in self.warnings[: self._urgent]]

    def _closing_lines(self) -> list[str]:
        """The other warnings, and files."""
        lines = [f"  warning: {warning}" for warning in self.warnings[self._urgent :]]
        # A model that was read again and judged has lines of its own.
        model = None if self.get("written") else self.model_out
        files = {"figure": self.get("figure"), "model": model}
        return lines + [f"  {name}: {file}" for name, file in files.items() if file]


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class EstimateResult(IdentifyResult):
    """Identification of bodies and joint terms. `standstill`: share of the rows left out of the
    fit; `open_directions`: number of directions of the base parameters that the motion leaves open;
    `failure`: why the answer fails its test (torque error above 1). Both sentences are the first of
    `warnings`."""

    torque_error_moving: float | None = field(metadata=behind("torque_error"))
    torque_error_weighted: float | None = field(metadata=behind("torque_error"))
    standstill: float = field(metadata=behind("torque_error"))
    open_directions: int = 0
    failure: str | None = field(default=None, metadata=OMIT_NONE)


def body_lines(bodies: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Mass and parameters of each body that are identifiable on their own, then the other bodies'
    names."""
    lines, others = [], []
    for name, body in bodies.items():
        if parameters_with(body, "identifiable"):
            values = [
                f"{key} {estimate_text(body['parameters'][key], body['std'][key])}"
                for key in parameters_with(body, "identifiable")
                if key != "m"  # it is the mass
            ]
            mass = estimate_text(body["mass"], body["std"]["m"], "not identifiable")
            lines += [f"  {name}: mass {mass}", *([f"    {', '.join(values)}"] if values else [])]
        else:
            others.append(name)
    if others:
        lines.append(f"  nothing is identifiable on its own: {first_names(others, SHOWN)}")
    return lines


def joint_line(name: str, terms: Mapping[str, Mapping[str, Any]]) -> str:
    """Terms of a joint, each with its standard deviation or `not identifiable`."""
    parts = [
        f"{term} {estimate_text(value['value'], value['std'])}"
        f"{_relative_text(value['value'], value['std'])}"
        if value["identifiable"] == "identifiable"
        else f"{term} not identifiable"
        for term, value in terms.items()
    ]
    return f"  {name}: {', '.join(parts)}"


def base_lines(base: Sequence[Mapping[str, Any]]) -> list[str]:
    """Base parameters with the largest ratio of value to standard deviation, or the largest values
    where no deviation is known; then the number of the others, and the weakest."""
    ranked = sorted(base, key=_significance, reverse=True)
    first, last = ranked[:SHOWN], ranked[max(SHOWN, len(ranked) - WEAKEST) :]
    hidden = len(base) - len(first) - len(last)
    more = [f"    ... {hidden} more (--json)"] if hidden else []
    numbers = [*map(_base_number, (*first, *last))]
    width = max(map(len, numbers), default=0)
    lines = [
        f"    {number:<{width}}  {_shortened(entry)}"
        for number, entry in zip(numbers, (*first, *last), strict=True)
    ]
    lines[len(first) : len(first)] = more
    order = "most significant" if any(entry["std"] for entry in base) else "largest"
    return [f"  base parameters, {order} first:", *lines] if base else []


def _base_number(entry: Mapping[str, Any]) -> str:
    share = _relative_text(entry["value"], entry["std"])
    return estimate_text(entry["value"], entry["std"]) + share


def _relative_text(value: float | None, std: float | None) -> str:
    """Standard deviation over the value, " (4.1 %)"; empty where either is unknown or zero."""
    if not value or not std:
        return ""
    share = 100 * abs(std / value)
    return f" ({share:.2g} %)" if share < 100 else " (> 100 %)"


def std_lines(std_from: str | None, std_limit: str | None) -> list[str]:
    """Meaning of ±, and what it does not hold; none without standard deviations."""
    if std_from is None:
        return [f"  {std_limit}"] if std_limit else []
    return [f"  ±: one standard deviation, {STD_FROM[std_from]}", f"     {std_limit}"]


def _significance(entry: Mapping[str, Any]) -> float:
    """|value| / std, the t-statistic of the hypothesis that the parameter is zero."""
    size = abs(entry["value"] or 0.0)
    return float(size / entry["std"] if entry["std"] else size)


def _shortened(entry: Mapping[str, Any]) -> str:
    """Expression of a base parameter, cut after its first terms."""
    more = len(entry["terms"]) - TERMS
    if more <= 0:
        return str(entry["expression"])
    first = dict(list(entry["terms"].items())[:TERMS])
    return f"{expression(first)} and {count_text(more, 'more term')}"
