"""Result of an identification, from simulated or recorded data."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from sysid_bench.commands.result import Result, estimate_text
from sysid_bench.errors import SHOWN, count_text, first_names
from sysid_bench.identifiability.base_expressions import expression
from sysid_bench.verbs.identify.estimate_fields import parameters_with

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


class IdentifyResult(Result):
    """Identified parameters with their verdicts, and the errors of the predicted torques.

    `bodies`: {name: mass (kg), com (m), inertia about the centre of mass (Ixx Ixy Ixz Iyy Iyz Izz,
    kg m^2), parameters, identifiable, std}; a value is None unless it is identifiable. `joints`:
    {joint: {term: value, identifiable, std}}. `base`: base parameters with one standard deviation.
    `std_limit`: what these deviations hold, and which bias they do not know of. RMS errors in N m
    or N. Bodies and joints alone: `open_directions`, the number of directions of the base
    parameters that the motion leaves open, and `failure`, why the answer fails its test (torque
    error above 1); both sentences are the first of `warnings`.
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
    model_out: str | None

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


def body_lines(bodies: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Mass and parameters of each body that are identifiable on their own, then the other bodies'
    names."""
    lines, others = [], []
    for name, body in bodies.items():
        if parameters_with(body, "identifiable"):
            lines += _body(name, body)
        else:
            others.append(name)
    if others:
        lines.append(f"  nothing is identifiable on its own: {first_names(others, SHOWN)}")
    return lines


def _body(name: str, body: Mapping[str, Any]) -> list[str]:
    values = [
        f"{key} {estimate_text(body['parameters'][key], body['std'][key])}"
        for key in parameters_with(body, "identifiable")
        if key != "m"  # it is the mass
    ]
    mass = estimate_text(body["mass"], body["std"]["m"], "not identifiable")
    return [f"  {name}: mass {mass}", *([f"    {', '.join(values)}"] if values else [])]


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
