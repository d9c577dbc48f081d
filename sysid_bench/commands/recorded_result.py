"""Result of an identification from recordings: its fields and their text."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from sysid_bench.commands.identify_result import (
    EstimateResult,
    base_lines,
    behind,
    joint_line,
    parameters_with,
    std_lines,
)
from sysid_bench.commands.result import OMIT_NONE, interval_text, value_text
from sysid_bench.errors import SHOWN
from sysid_bench.evaluation.intervals import level_text
from sysid_bench.evaluation.torque_errors import RowErrors
from sysid_bench.identification.estimators.feasible import LMI
from sysid_bench.identification.feasibility.lmi_fit import binding_constraints, problem_without
from sysid_bench.identification.identify import identify
from sysid_bench.identification.linear.least_squares import RMS_TORQUE
from sysid_bench.types import Array, Problem

TRIED: Final = 24
"""Most constraints that are left out one by one."""


GROUPS: Final = ("all bodies", "all joint terms")
"""Constraints that are left out together, too."""


def binding_errors(problem: Problem, tests: Mapping[str, Problem]) -> list[dict[str, Any]] | None:
    """Return [{constraint, cost}] of the constraints that bind in the `lmi` fit of a problem, the
    most costly first, then of all bodies and of all joint terms together where several bind; None
    where `lmi` finds no bodies. Springs are not constrained.

    `cost`: error with all constraints minus that without this one, on the tests (share of the RMS
    torque; without tests that of training). A negative cost means that the constraint improves
    the prediction.
    """
    theta = identify(LMI(), problem).theta
    if theta is None:
        return None
    judged = list(tests.values()) or [problem]
    with_all = _error(theta, problem, judged)
    costs = []
    for name, members in _left_out(problem, binding_constraints(problem, theta)):
        free = identify(LMI(), problem_without(problem, *members)).theta
        error = _error(free, problem, judged)
        if error is not None and with_all is not None:
            costs.append({"constraint": name, "cost": with_all - error})
    return sorted(costs, key=lambda cost: (cost["constraint"] in GROUPS, -cost["cost"]))


def _error(theta: Array | None, problem: Problem, judged: list[Problem]) -> float | None:
    """Share of the RMS torque that parameters leave; None without them or without torque."""
    if theta is None:
        return None
    return RowErrors(judged, problem.base.K @ theta).torque_error


def _left_out(problem: Problem, binding: Sequence[str]) -> Iterator[tuple[str, Sequence[str]]]:
    """Yield names and members of the constraints to leave out: groups, then one by one."""
    bodies = {body.name for body in problem.bodies}
    of_bodies = [name for name in binding if name in bodies]
    of_terms = [name for name in binding if name not in bodies]
    groups = zip(GROUPS, (of_bodies, of_terms), strict=True)
    yield from ((name, members) for name, members in groups if len(members) > 1)
    yield from ((name, [name]) for name in binding[:TRIED])


_COORDINATES: Final = {
    "mass": (("mass",), "kg"),
    "com": (("centre of mass x", "y", "z"), "m"),
    "inertia": (("inertia about it Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz"), "kg m^2"),
}
"""Names of the numbers of a payload, and their unit."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class RecordedResult(EstimateResult):
    """Identification from recordings. `training` and `tests`: {joint: rmse, rms, relative} of the
    predicted torques; `replayed`: errors of the training torque itself where a test repeats the
    training motion; `logs`: the samples used of each file, with what was found in them."""

    locked: dict[str, float] = field(metadata=behind("rows"))
    signals: dict[str, Any] = field(metadata=behind("estimator"))
    denominator: str = field(metadata=behind("estimator"))
    selection: dict[str, Any] | None = field(metadata=behind("estimator"))
    rank_gap: float | None = field(metadata=behind("parameters"))
    near_degenerate: int = field(metadata=behind("parameters"))
    training: dict[str, dict[str, float]] = field(metadata=behind("standstill"))
    tests: dict[str, dict[str, dict[str, float]]] = field(metadata=behind("standstill"))
    replayed: dict[str, Any] = field(metadata=behind("standstill"))
    logs: list[dict[str, Any]] = field(metadata=behind("standstill"))
    prior: dict[str, str] = field(metadata=behind("feasible"))
    constraints: list[dict[str, Any]] | None = field(metadata=behind("feasible"))
    figure: str | None = field(default=None, metadata=OMIT_NONE | behind("warnings"))
    written: dict[str, Any] | None = field(default=None, metadata=OMIT_NONE)

    def summary(self) -> str:
        """Errors and terms of the joints, base parameters, payload, model files, warnings."""
        test = next(iter(self.tests.values()), None)
        lines = [
            *self._opening_lines(),
            f"{self.model}, task {self.task}, {self.estimator}: rank {self.rank} "
            f"of {self.parameters}, condition {value_text(self.condition)}",
            f"  {self._signals_line()}",
            f"  {self._prior_line()}",
            *_selection_lines(self.selection),
            "  joint                  RMS     train" + ("          test" if test else ""),
            *(_joint_line(joint, train, test) for joint, train in self.training.items()),
            *(_test_line(label, table) for label, table in list(self.tests.items())[1:]),
            *(joint_line(name, terms) for name, terms in self.joints.items()),
            *base_lines(self.base),
            *std_lines(self.std_from, self.std_limit),
            *_payload_lines(self.payload),
            *_constraint_lines(self.constraints),
            *_written_lines(self.written),
        ]
        return "\n".join(lines + self._closing_lines())

    def _prior_line(self) -> str:
        """The prior that methods may use, or the reason why there is none."""
        if self.prior["reason"]:
            return f"no prior: {self.prior['reason']}"
        return f"prior for methods that use one: the model file's links, {self.prior['spreads']}"

    def _signals_line(self) -> str:
        seconds = sum(log["seconds"] for log in self.logs if log["use"] == "train")
        return (
            f"{seconds:.1f} s of training, pipeline {self.signals['pipeline']!r}, "
            f"filter {self.signals['filter']!r}, "
            f"derivatives {self.signals['derivatives']!r}; errors in % of the {self.denominator}"
        )


def _selection_lines(selection: Mapping[str, Any] | None) -> list[str]:
    if selection is None:
        return []
    names = ", ".join(step["parameter"] for step in selection["added"]) or "nothing"
    return [
        f"  chosen on {selection['left_out']}: {names} (mean error there "
        f"{100 * selection['error_before']:.1f} -> {100 * selection['error_after']:.1f} %)"
    ]


def _joint_line(
    joint: str, train: Mapping[str, Any], test: Mapping[str, Mapping[str, Any]] | None
) -> str:
    """RMS torque of a joint and its errors in training and in the first test."""
    line = f"  {joint:18} {train['rms']:8.4g}  {_error_text(train)}"
    return line + (f"  {_error_text(test[joint])}" if test else "")


def _test_line(label: str, errors: Mapping[str, Mapping[str, Any]]) -> str:
    """Errors of all joints in a further test."""
    return f"  {label}: {', '.join(_error_text(joint).strip() for joint in errors.values())}"


def _error_text(joint: Mapping[str, Any]) -> str:
    relative = joint["relative"]
    share = "     -" if relative is None else f"{100 * relative:5.1f}%"
    return f"{joint['rmse']:8.3g} {share}"


def _payload_lines(payload: Mapping[str, Any] | None) -> list[str]:
    """Lines of the identified payload; none for tasks without one."""
    if payload is None:
        return []
    if "interval" in payload:
        return [f"  payload: {_mass_text(payload)}", *_joint_mass_lines(payload["by_joint"])]
    return [f"  payload: {_values_text(payload)}", *_interval_lines(payload)]


def _joint_mass_lines(masses: Mapping[str, Sequence[float]]) -> list[str]:
    """The mass by the torque of each joint alone; torques of a wrong scale make them differ."""
    parts = [f"{name} {mass:.3g} ± {std:.1g}" for name, (mass, std) in masses.items()]
    return [f"    by the torque of one joint alone: {', '.join(parts)} kg"] if parts else []


def _interval_lines(payload: Mapping[str, Any]) -> list[str]:
    """Mass, centre of mass and inertia about it, as far as they are known, with 95 % intervals."""
    lines = [
        f"    {', '.join(map(_interval_of, names, np.atleast_1d(payload[quantity]), ends))} {unit}"
        for quantity, (names, unit) in _COORDINATES.items()
        if (ends := payload["intervals"].get(quantity))
    ]
    note = (
        f"    {level_text()} intervals by leaving parts of the motion out; a wrong torque scale, "
        "as of drive gains, moves all of them alike and is not in them"
    )
    return [*lines, note] if lines else []


def _interval_of(name: str, value: float, ends: Sequence[float]) -> str:
    text = interval_text(*ends)
    return f"{name} {value:.4g} in {text}" if text.startswith("[") else f"{name} {text}"


def _mass_text(payload: Mapping[str, Any]) -> str:
    share, ends = 100 * payload["confidence"], interval_text(*payload["interval"])
    return (
        f"mass {payload['mass']:.4g} kg, {share:.0f} % in {ends} by leaving parts of the motion "
        "out and by the joints"
    )


def _values_text(payload: Mapping[str, Any]) -> str:
    """Parameters of the payload that are identifiable on their own, with units."""
    units = {"m": "kg", "h": "kg m", "I": "kg m^2"}
    values = [
        f"{key} {value_text(payload['parameters'][key])} {units[key[0]]}"
        for key in parameters_with(payload, "identifiable")
    ]
    return ", ".join(values) or "nothing of it is identifiable on its own"


def _constraint_lines(constraints: Sequence[Mapping[str, Any]] | None) -> list[str]:
    """The constraints of the feasible fit that bind, with what each adds to the error."""
    if not constraints:
        return []
    texts = {c["constraint"]: f"{c['constraint']} {100 * c['cost']:+.2g}" for c in constraints}
    together = [texts.pop(name) for name in GROUPS if name in texts]
    groups = f"; together: {', '.join(together)}" if together else ""
    listed = _shown(list(texts.values()))
    return [f"  constraints that bind, with what each adds to the error in %: {listed}{groups}"]


def _shown(texts: Sequence[str]) -> str:
    more = f", and {len(texts) - SHOWN} more (--json)" if len(texts) > SHOWN else ""
    return f"{', '.join(texts[:SHOWN])}{more}"


def _written_lines(written: Mapping[str, Any] | None) -> list[str]:
    """Lines of the written model and of its errors when it is read again."""
    if written is None:
        return []
    label, errors = next(iter(written["tests"].items()), ("the training", written["training"]))
    shares = " ".join("-" if e is None else f"{100 * e:.1f}" for e in errors.values())
    lines = [
        f"  model: {written['file']}, its joint terms in {written['manifest']}; {_origin(written)}",
        f"    read again in both engines (gap {written['gap']:.1e}), it predicts {label} with "
        f"errors of {shares} %{_cost(written)}",
    ]
    more = written["left_out"]
    return lines + ([f"    in neither file: {', '.join(more)}"] if more else [])


def _cost(written: Mapping[str, Any]) -> str:
    """Error of a written model relative to the estimate's."""
    return "" if written["ratio"] is None else f", {written['ratio']:.2f} x those of the estimate"


def _origin(written: Mapping[str, Any]) -> str:
    """Origin of the whole bodies of a written model."""
    if written["refitted"] and written["weights"] == RMS_TORQUE:
        return (
            "a feasible fit, since no feasible bodies have exactly these base parameters; its rows "
            "count relative to the torque of their joint, since weights of the noise would have "
            "cost more"
        )
    if written["refitted"]:
        return "a feasible fit, since no feasible bodies have exactly these base parameters"
    if written["completed"] is None:
        return "bodies of the estimator itself"
    return f"whole bodies nearest to the prior ({written['completed']})"
