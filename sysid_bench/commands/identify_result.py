"""Result of an identification from any data: metrics of the row of its cell, the estimate with the
verdict on each parameter, warnings, and their text."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from sysid_bench.commands.result import HIDDEN, OMIT_NONE, Result, estimate_text, short_names
from sysid_bench.errors import SHOWN, EstimationError, count_text, first_names
from sysid_bench.evaluation.baselines import (
    FILE,
    FILE_FRICTION,
    MEAN,
    WORDS,
    ZERO,
    ZERO_TORQUE,
    Baselines,
)
from sysid_bench.evaluation.covariance import block_errors, motion_fit, standard_errors
from sysid_bench.evaluation.feasible_body import FeasibleBody
from sysid_bench.evaluation.intervals import coverage_factor, is_stated, level_text
from sysid_bench.evaluation.open_directions import OpenDirections, open_directions
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.identifiability.base_expressions import (
    base_expressions,
    expression,
    parameter_verdict,
)
from sysid_bench.identifiability.base_map import left_out_torque
from sysid_bench.identification.estimators.bayesian import GuardedWLS
from sysid_bench.identification.feasibility.lmi_fit import binding_constraints
from sysid_bench.identification.identify import fit_fields
from sysid_bench.identification.identify import identify as estimate_parameters
from sysid_bench.models.robot import SUFFIX
from sysid_bench.spatial import NAMES, body_mass_inertia, inertia_values
from sysid_bench.types import Array, Body, Estimate, Problem
from sysid_bench.words import INTERVAL_LIMITS

REPORTED: Final = (
    *("rank", "rank_gap", "near_degenerate", "data_rank", "parameters", "condition"),
    *("condition_unit", "rmse_train", "rmse_test"),
    *("torque_error", "torque_error_null", "torque_error_mean", "torque_error_floor"),
    *("torque_error_best", "gap_closed", "beaten_by"),
    *("feasible", "converged", "iterations", "simulations", "stop"),
)
"""Fields of the row of any identification that its result has as well."""
OF_CELLS: Final = (*REPORTED, "torque_error_moving", "torque_error_weighted", "standstill")
"""The same of those that run the pipeline of suites."""

WEAKEST: Final = 3
"""Base parameters at the end of the summary, those with the largest relative deviations."""

KNOWN: Final = 0.1  # 10 %
"""Relative standard deviation below which the first sentence counts a base parameter as known."""

TERMS: Final = 4
"""Terms of one base parameter in the summary."""

STD_FROM: Final = {
    "motions": "from the spread between different motions",
    "periods": "from the spread over repeated periods",
    "residuals": "from residuals and the correlation of neighbouring ones",
    "blocks": "from the fits with one of 8 parts of the motion left out (jackknife)",
    "files": "between the values of single files",
    "textbook": "by the method's own formula",
}


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class IdentifyResult(Result):
    """Identified parameters with their verdicts, and the errors of the predicted torques.

    `scores`: metrics of the row of the cell (`sysid-bench help metrics`), each of which is a field
    of its own, as `result.torque_error`. `bodies`: {name: mass (kg), com (m), inertia about the
    centre of mass (Ixx Ixy Ixz Iyy Iyz Izz, kg m^2), parameters, identifiable, std}; a value is
    None unless it is identifiable. `joints`: {joint: {term: value, identifiable, std}}. `base`:
    base parameters with one standard deviation. `std_limit`: what these deviations hold, and which
    bias they do not know of. `reach`: where a confidence level is stated, half of the length of its
    intervals in standard deviations, which the text then has. `open_directions`: number of
    directions of the base parameters that the motion leaves open; `prior_weight`: that of the
    prior in `wls-guarded`, 0 for least squares; `failure`: why the answer fails its test
    (`beaten_by`: baselines that err less). Sentences on these are the first of `warnings`.
    `written`: model files, read again and judged.
    """

    model: str
    file: str
    task: str
    terms: list[str]
    rows: list[str]
    estimator: str
    scores: Mapping[str, Any] = field(metadata=HIDDEN)
    from_file: bool = field(default=True, metadata=HIDDEN)  # the null model, else a prior
    std_from: str | None
    std_limit: str | None
    reach: float | None = field(default=None, metadata=OMIT_NONE)
    joints: dict[str, dict[str, Any]]
    base: list[dict[str, Any]] = field(default_factory=list)
    bodies: dict[str, dict[str, Any]] = field(default_factory=dict)
    payload: dict[str, Any] | None = None
    warnings: list[str]
    open_directions: int | None = field(default=None, metadata=OMIT_NONE)
    prior_weight: float | None = field(default=None, metadata=OMIT_NONE)
    failure: str | None = field(default=None, metadata=OMIT_NONE)
    figure: str | None = field(default=None, metadata=OMIT_NONE)
    model_out: str | None = field(default=None, metadata=OMIT_NONE)
    written: dict[str, Any] | None = field(default=None, metadata=OMIT_NONE)

    def __post_init__(self) -> None:
        self._make_plain()

    def __getattr__(self, name: str) -> Any:
        scores = vars(self).get("scores", {})
        if name in scores:
            return scores[name]
        raise AttributeError(f"{type(self).__name__!r} has no attribute {name!r}.")

    def _fields(self) -> dict[str, Any]:
        own = super()._fields()
        asked = ("model", "file", "task", "terms", "rows", "estimator")
        return {**{key: own.pop(key) for key in asked}, **self.scores, **own}

    @property
    def _urgent(self) -> int:
        """Number of warnings that come before the answer: open directions, a prior that decides
        them, a failed test."""
        is_drawn = bool(self.open_directions or self.prior_weight)
        return is_drawn + bool(self.failure or self.scores.get("beaten_by"))

    def _of_level(self, entries: Mapping[Any, Any]) -> dict[Any, Any]:
        """Entries of the text: deviations as half of the length of intervals of a stated level."""
        reach = self.reach or 1.0

        def scaled(value: Any, is_std: bool = False) -> Any:
            if isinstance(value, Mapping):
                return {key: scaled(x, is_std or key == "std") for key, x in value.items()}
            return reach * value if is_std and value is not None else value

        return {name: scaled(entry) for name, entry in entries.items()}

    def _opening_lines(self) -> list[str]:
        """Warnings without which the answer is misread."""
        return [f"warning: {warning}" for warning in self.warnings[: self._urgent]]

    def _headline(self, exact: str = "", way_on: str = "") -> str:
        """Known parameters, errors beside those of the baselines, and the next step."""
        texts = [exact]
        if self.base and not exact:
            sure = sum(bool(e["std"]) and e["std"] < KNOWN * abs(e["value"]) for e in self.base)
            known = f"{sure} of {len(self.base)} base parameters are known within 10 %"
            texts = [known if self.std_from else f"{len(self.base)} base parameters, no intervals"]
            # That of a recorded load has lines of its own.
            if len(self.bodies) == 1 and "by_joint" not in (self.payload or {}):
                ((name, body),) = self._of_level(self.bodies).items()
                mass = estimate_text(body["mass"], body["std"]["m"])
                texts[0] = f"mass of {name} {mass} kg, {texts[0]}" if body["mass"] else texts[0]
        # What a warning above advises comes first.
        texts = list(filter(None, [*texts, self._error_text(), "" if self._urgent else way_on]))
        return f"{self.model}: {'. '.join(texts)}."

    def _error_text(self) -> str:
        """The error of the answer on its test beside those of predictions without one."""
        error = self.scores.get("torque_error")
        if error is None:
            return ""
        name = FILE_FRICTION if self.joints and self.bodies else FILE
        null = WORDS[name] if self.from_file else WORDS[name].replace("model file", "prior")
        errors = {null: "null", WORDS[MEAN]: "mean"}
        known = {words: self.scores.get(f"torque_error_{key}") for words, key in errors.items()}
        known |= {WORDS[ZERO]: ZERO_TORQUE}
        known |= {"the training torque, played again": self.scores.get("torque_error_floor")}
        known |= {"the model fitted to these motions": self.scores.get("torque_error_best")}
        texts = [f"{words} {100 * e:.3g} %" for words, e in known.items() if e is not None]
        return f"Torques of {self._judged_on()} err by {100 * error:.3g} % ({', '.join(texts)})"

    def _judged_on(self) -> str:
        """Words for the motions of the test."""
        return "other motions"

    def _closing_lines(self) -> list[str]:
        """The other warnings, and files."""
        lines = [f"  warning: {warning}" for warning in self.warnings[self._urgent :]]
        # A model that was read again and judged has lines of its own.
        files = {"figure": self.figure, "model": None if self.written else self.model_out}
        return lines + [f"  {name}: {file}" for name, file in files.items() if file]


# --- Fields -------------------------------------------------------------------------------------


def solved(prepared: ExperimentData[Any], method: Any, name: str, hint: str = "") -> Estimate:
    """Return the estimate of a `method`, of a robot and estimator called `name`; raise
    EstimationError with its reason and a `hint` where it fails."""
    estimate = estimate_parameters(method, prepared.problem, prepared.experiment)
    if estimate.status != "ok" or estimate.beta is None:
        raise EstimationError(f"{name}: {estimate.reason} {hint}".rstrip())
    return estimate


def cell_fields(
    prepared: ExperimentData[Any],
    method: Any,
    estimate: Estimate,
    scores: Sequence[str] = OF_CELLS,
    row: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the fields of an estimate that all cells have: those of the row that `scores` names,
    `rows`, values with their deviations, open directions, failure, and the `warnings` of these;
    `row`: fields besides those of the cell."""
    problem = prepared.problem
    whole = prepared.score(method, estimate) | prepared.fields | fit_fields(estimate)
    whole |= row or {}
    directions, warnings = open_directions(problem), []
    weight = estimate.stats.get("weight") if isinstance(method, GuardedWLS) else None
    if directions.count or weight:
        warnings.append(_open_text(directions, weight, problem.prior is not None))
    failure = _failure(whole, prepared.baselines, problem.file is not None)
    warnings += [failure] if failure else []
    warnings += _dropped_texts(problem)
    return {
        "rows": list(problem.rows),
        "scores": {name: whole.get(name) for name in scores},
        **_estimate_fields(estimate, problem, method),
        "from_file": problem.file is not None,
        "open_directions": directions.count,
        "prior_weight": weight,
        "failure": failure,
        "warnings": warnings,
    }


def _open_text(directions: OpenDirections, weight: float | None, has_prior: bool) -> str:
    """Sentence on directions that the motion leaves open, and on the prior that decides them."""
    richer = "Record a richer motion (sysid-bench excite)"
    found = f"the motion determines some of the {directions.rank} base parameters weakly"
    if directions.count:
        found = (
            f"the motion leaves {directions.count} of {directions.rank} directions of the base "
            f"parameters open, most of all {', '.join(directions.names)}"
        )
    if not weight:
        return (
            f"{found}: noise or a prior decides them, and torques of other motions may be far off. "
            f"{richer}, or use a method with a prior (--estimator lmi)"
        )
    towards = "the bodies of the model file" if has_prior else "zero, since there is no prior"
    return (
        f"{found}: least squares predicts left-out parts of the motion worse than an answer that "
        f"is drawn to {towards} (weight {weight:.3g}), which is given. {richer}"
    )


def _dropped_texts(problem: Problem) -> list[str]:
    """Sentence on directions that the rank rule drops though they are no rounding, with the torque
    that they have for what is known beforehand."""
    base = problem.base
    if not base.near_degenerate:
        return []
    first = base.singular_values[base.rank]
    known = problem.file if problem.prior is None else problem.prior.theta
    share = ""
    if known is not None and base.dropped is not None:
        torque = left_out_torque(base, known)
        share = f"; their torque, {torque:.1e} of the whole by what is known beforehand, is lost"
    return [
        f"the rank rule drops {count_text(base.near_degenerate, 'nearly dependent direction')} "
        f"(singular values from {first / base.singular_values[0]:.1e} of the largest, gap "
        f"{base.gap:.3g} to the last kept one){share}"
    ]


def _failure(row: Mapping[str, Any], against: Baselines, has_file: bool) -> str | None:
    """Reason for which an answer is worse than none, with what to do; None where it is not. A
    simulated robot has no file (`has_file`) but a prior."""
    error, names = row.get("torque_error"), against.beaten_by(row.get("torque_error"))
    if error is None or not names:
        return None
    texts = against.text(names)
    advice = "do not use it for other motions"
    if names[0] in (FILE, FILE_FRICTION) and not has_file:
        texts = texts.replace("the model file", "the prior")
        advice = (
            "the noise makes the parameters worse than those of the prior. Use a method with a "
            "prior (--estimator a-priori), or a richer motion (sysid-bench excite)"
        )
    elif names[0] == FILE_FRICTION:
        advice = (
            "this motion makes the bodies worse than those of the file. Use those (--estimator "
            "file-friction) or a richer motion (sysid-bench excite), and check the recordings "
            "(sysid-bench diagnose)"
        )
    return f"torque error {error:.4g} on held-out data: the answer errs more than {texts}; {advice}"


def _estimate_fields(estimate: Estimate, problem: Problem, method: Any) -> dict[str, Any]:
    """`std_from`, `std_limit`, `base`, `bodies` and `joints`.

    `std_from`: origin of the standard deviations, "motions", "periods", "residuals", "textbook"
    (see evaluation/covariance.py) or, where the `method` gives none, "blocks" of time; None without
    any. `std_limit`: what they do not hold, or the reason why there are none.
    """
    errors, limit = standard_errors(problem, estimate), None
    if errors:
        fits = motion_fit(problem, estimate)
        limit = INTERVAL_LIMITS[next(iter(errors))]
        limit += f" (none between motions: {fits})" if isinstance(fits, str) else ""
    # Fits with a part left out: slow, and so only where the residuals give no deviation.
    elif isinstance(found := block_errors(problem, estimate, method), str):
        limit = found
    else:
        errors, limit = {"blocks": found}, INTERVAL_LIMITS["blocks"]
    std_from = next(iter(errors), None)
    deviations = np.full(problem.base.rank, np.nan) if std_from is None else errors[std_from].std
    verdict = np.array(parameter_verdict(problem.base))
    # The deviation of a base parameter is that of its pivot only where the pivot stands alone.
    std = np.full(len(problem.parameters), np.nan)
    std[problem.base.pivots] = deviations
    std[verdict != "identifiable"] = np.nan
    assert estimate.beta is not None
    bound: frozenset[str] = frozenset()
    if estimate.theta is not None and "roundness" in estimate.stats:  # a feasible fit
        bound = frozenset(binding_constraints(problem, estimate.theta))
    return {
        "std_from": std_from,
        "std_limit": limit,
        "reach": None
        if std_from is None or not is_stated()
        else coverage_factor(errors[std_from].freedom),
        "base": [
            {"expression": expression(terms), "terms": terms, "value": float(beta), "std": float(s)}
            | ({"at_bound": True} if len(terms) == 1 and bound & terms.keys() else {})
            for terms, beta, s in zip(
                base_expressions(problem.base), estimate.beta, deviations, strict=True
            )
        ],
        **_values(problem, values_of(estimate, problem), verdict, std, bound),
    }


def values_of(estimate: Estimate, problem: Problem) -> Array:
    """Return theta (p,); NaN where the method identifies a combination alone."""
    if estimate.theta is not None:
        return estimate.theta
    assert estimate.beta is not None
    is_known = np.array(parameter_verdict(problem.base)) == "identifiable"
    return np.asarray(np.where(is_known, problem.base.embed(estimate.beta), np.nan))


def _values(
    problem: Problem, theta: Array, verdict: Array, std: Array, bound: frozenset[str]
) -> dict[str, Any]:
    """Bodies and joint terms by name from theta, verdicts and deviations (p,); `bound`: terms that
    a constraint holds at zero."""
    index = {name: j for j, name in enumerate(problem.parameters)}
    bodies: dict[str, dict[str, Any]] = {}
    for body in problem.bodies:
        ten = [index.pop(column) for column in body.columns]
        bodies[body.name] = {
            **_body_values(theta[ten], verdict[ten] == "identifiable"),
            "identifiable": dict(zip(NAMES, verdict[ten].tolist(), strict=True)),
            "std": dict(zip(NAMES, std[ten].tolist(), strict=True)),
        }
    term_of = {suffix: term for term, suffix in SUFFIX.items()}
    joints: dict[str, dict[str, dict[str, Any]]] = {}
    for name, j in index.items():
        joint, _, suffix = name.rpartition(".")
        term = term_of.get(suffix, suffix)
        if suffix not in term_of and ".fv." in name:  # "j5.fv.j6", friction between two joints
            joint, _, other = name.partition(".fv.")
            term = f"viscous_coupling.{other}"
        entry = {"value": float(theta[j]), "identifiable": str(verdict[j]), "std": float(std[j])}
        joints.setdefault(joint, {})[term] = entry | ({"at_bound": True} if name in bound else {})
    return {"bodies": bodies, "joints": joints}


def _body_values(phi: Array, single: Array) -> dict[str, Any]:
    """Values of phi (10,), of which those in the mask `single` (10,) are identifiable."""
    # Combinations count as zero here; com and inertia are only given where none is needed.
    _, com, inertia = body_mass_inertia(np.where(single, phi, 0.0))
    return {
        "mass": float(phi[0]) if single[0] else None,
        "com": com.tolist() if single[:4].all() and phi[0] > 0 else None,
        "inertia": inertia_values(inertia).tolist() if single.all() else None,
        "parameters": dict(zip(NAMES, phi.tolist(), strict=True)),
    }


def feasible_entry(
    entry: Mapping[str, Any], problem: Problem, body: Body, found: FeasibleBody
) -> dict[str, Any]:
    """The entry of a body with its feasible values, and what that constraint changes as
    `constraint`."""
    values: dict[str, Any] = {}
    if found.binds:
        theta = problem.base.embed(found.beta)
        phi = theta[[problem.parameters.index(column) for column in body.columns]]
        single = [verdict == "identifiable" for verdict in entry["identifiable"].values()]
        values = _body_values(phi, np.array(single))
    change = {"binds": found.binds, "excess": found.excess, "cost": found.cost}
    return {**entry, **values, "constraint": change | {"without": found.without}}


def warnings_of(estimate: Estimate, problem: Problem) -> list[str]:
    """Warn about an iteration that did not converge, about parameters that are not identifiable on
    their own, combinations first, and about a completion that changed base parameters."""
    warnings = []
    if estimate.converged is False:
        warnings.append(
            f"the method has not converged; its last iterate is reported: {estimate.stop}"
        )
    verdicts = list(zip(problem.parameters, parameter_verdict(problem.base), strict=True))
    # Parameters without effect, as those of a fixed base, come last.
    without_effect = [name for name, verdict in verdicts if verdict == "none"]
    names = [name for name, verdict in verdicts if verdict == "combination"] + without_effect
    if names:
        effect = f" ({len(without_effect)} have no effect)" if without_effect else ""
        choice = "; their values are the method's choice, which no residual can confirm"
        warnings.append(
            f"{len(names)} of {len(problem.parameters)} parameters are not identifiable on their "
            f"own{effect}: {', '.join(names[:8])}{', ...' if len(names) > 8 else ''}"
            f"{'' if estimate.theta is None else choice}"
        )
    if "moved" in estimate.stats:
        warnings.append(
            "no feasible bodies have exactly these base parameters: the nearest feasible ones are "
            f"reported, {estimate.stats['moved']:.3g} more in the sum of squared residuals over "
            f"their noise (noise alone adds about {problem.base.rank}, the number of base "
            "parameters)"
        )
    return warnings


# --- Text ---------------------------------------------------------------------------------------


def identifiable_of(body: Mapping[str, Any]) -> list[str]:
    """Return the parameters of a body that are identifiable on their own."""
    return [key for key, verdict in body["identifiable"].items() if verdict == "identifiable"]


def body_lines(bodies: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Mass and parameters of each body that are identifiable on their own, then the other bodies'
    names."""
    lines, others = [], []
    for name, body in bodies.items():
        known = identifiable_of(body)
        if not known:
            others.append(name)
            continue
        mass = estimate_text(body["mass"], body["std"]["m"], "not identifiable")
        lines.append(f"  {name}: mass {mass}")
        values = [
            f"{key} {estimate_text(body['parameters'][key], body['std'][key])}"
            for key in known
            if key != "m"  # it is the mass
        ]
        lines += [f"    {', '.join(values)}"] if values else []
    if others:
        lines.append(f"  nothing is identifiable on its own: {first_names(others, SHOWN)}")
    return lines


def joint_lines(joints: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> Iterator[str]:
    """Terms of each joint, each with its standard deviation or `not identifiable`."""
    names, _ = short_names(joints)
    for name, terms in joints.items():
        parts = [
            f"{term} {_number(value)}"
            if value["identifiable"] == "identifiable"
            else f"{term} not identifiable"
            for term, value in terms.items()
        ]
        yield f"  {names[name]}: {', '.join(parts)}"


def base_lines(base: Sequence[Mapping[str, Any]]) -> list[str]:
    """Base parameters with the largest ratio of value to standard deviation, or the largest values
    where no deviation is known; then the number of the others, and the weakest."""
    if not base:
        return []

    def significance(entry: Mapping[str, Any]) -> float:
        """|value| / std, the t-statistic of the hypothesis that the parameter is zero."""
        size = abs(entry["value"] or 0.0)
        return float(size / entry["std"] if entry["std"] else size)

    ranked = sorted(base, key=significance, reverse=True)
    first, last = ranked[:SHOWN], ranked[max(SHOWN, len(ranked) - WEAKEST) :]
    width = max(len(_number(entry)) for entry in (*first, *last))
    lines = [f"    {_number(entry):<{width}}  {_sum_text(entry)}" for entry in (*first, *last)]
    hidden = len(base) - len(lines)
    if hidden:
        lines.insert(len(first), f"    ... {hidden} more (--json)")
    order = "most significant" if any(entry["std"] for entry in base) else "largest"
    return [f"  base parameters, {order} first:", *lines]


def _number(entry: Mapping[str, Any]) -> str:
    """Value and deviation, with their ratio " (4.1 %)" where both are known and not zero."""
    if entry.get("at_bound"):
        return "0 (bound)"
    value, std = entry["value"], entry["std"]
    share = 100 * abs(std / value) if value and std else None
    ratio = "" if share is None else f" ({share:.2g} %)" if share < 100 else " (> 100 %)"
    return estimate_text(value, std) + ratio


def _sum_text(entry: Mapping[str, Any]) -> str:
    """Expression of a base parameter, cut after its first terms."""
    more = len(entry["terms"]) - TERMS
    if more <= 0:
        return str(entry["expression"])
    first = dict(list(entry["terms"].items())[:TERMS])
    return f"{expression(first)} and {count_text(more, 'more term')}"


def std_lines(
    std_from: str | None, std_limit: str | None, reach: float | None = None
) -> Iterator[str]:
    """Meaning of ±, and what it does not hold; none without standard deviations."""
    if std_from is not None:
        size = "one standard deviation" if reach is None else f"{level_text()} interval"
        yield f"  ±: {size}, {STD_FROM[std_from]}"
        yield f"     {std_limit}"
    elif std_limit:
        yield f"  {std_limit}"
