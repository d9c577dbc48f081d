"""Result of an identification, from simulated or recorded data."""

from collections.abc import Mapping
from typing import Any, Final

from sysid_bench.verbs.result import Result, estimate_text

STD_FROM: Final = {
    "periods": "from the spread over repeated periods",
    "residuals": "from residuals and the correlation of neighbouring ones",
    "textbook": "by the method's own formula",
}


class IdentifyResult(Result):
    """Identified parameters with their verdicts, and the errors of the predicted torques.

    `bodies`: {name: mass (kg), com (m), inertia about the centre of mass (Ixx Ixy Ixz Iyy Iyz Izz,
    kg m^2), parameters, identifiable, std}; a value is None unless it is identifiable. `joints`:
    {joint: {term: value, identifiable, std}}. `base`: base parameters with one standard deviation.
    RMS errors in N m or N.
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
    std_from: str | None
    base: list[dict[str, Any]]
    bodies: dict[str, dict[str, Any]]
    joints: dict[str, dict[str, dict[str, Any]]]
    payload: dict[str, Any] | None
    feasible: bool | None
    warnings: list[str]
    model_out: str | None

    def _closing_lines(self) -> list[str]:
        """Warnings and files."""
        lines = [f"  warning: {warning}" for warning in self.warnings]
        files = ("figure", "model_out")
        names = [(name.removesuffix("_out"), self.get(name)) for name in files]
        return lines + [f"  {name}: {file}" for name, file in names if file]


def body_lines(name: str, body: Mapping[str, Any]) -> list[str]:
    """Mass of a body, then the parameters that are identifiable on their own."""
    single = [
        f"{key} {estimate_text(body['parameters'][key], body['std'][key])}"
        for key, verdict in body["identifiable"].items()
        if verdict == "identifiable"
    ]
    return [
        f"  {name}: mass {estimate_text(body['mass'], body['std']['m'], 'not identifiable')}",
        f"    {', '.join(single) or 'nothing is identifiable on its own'}",
    ]


def joint_line(name: str, terms: Mapping[str, Mapping[str, Any]]) -> str:
    """Terms of a joint, each with its standard deviation or `not identifiable`."""
    parts = [
        f"{term} {estimate_text(value['value'], value['std'])}"
        if value["identifiable"] == "identifiable"
        else f"{term} not identifiable"
        for term, value in terms.items()
    ]
    return f"  {name}: {', '.join(parts)}"
