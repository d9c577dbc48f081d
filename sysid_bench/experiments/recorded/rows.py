"""Cells of a suite's [[log]]: some recordings of a real robot, and what is asked of them."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.evaluation.recorded_score import score_recorded
from sysid_bench.evaluation.score import data_figures
from sysid_bench.experiments.recorded.payload_mass import payload_mass
from sysid_bench.experiments.recorded.prepare import LogOptions, prepare_logs
from sysid_bench.experiments.recorded.prepared_logs import PreparedLogs
from sysid_bench.experiments.recorded.repeatability import repeatability_error
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.identifiability.base_expressions import base_expressions, expression
from sysid_bench.identifiability.verdicts import verdicts
from sysid_bench.models.manifest import find_manifest
from sysid_bench.naming import resolve_paths
from sysid_bench.signals.log_description import LogDescription, log_description, name_of
from sysid_bench.types import Array, Estimate, Problem, Row, Score
from sysid_bench.units import quantity


def prepare_recorded(
    spec: ExperimentSpec, robots_dir: str | None, folder: str | None
) -> PreparedLogs:
    """The problems of a recorded experiment; files are found from the suite's `folder`."""
    assert spec.log is not None
    place = Path(folder or ".")
    extra = None if robots_dir is None else Path(robots_dir)
    manifest = find_manifest(spec.robot, extra, place)
    asked = LogOptions(
        task=str(resolve_paths({"use": spec.task}, place)["use"]),
        terms=spec.terms,
        filter=spec.signals.get("filter"),
        derivatives=spec.signals.get("derivatives"),
        moving=float(spec.log["moving"]),
        candidates=tuple(spec.log["choose"]),
        position_given=bool(spec.log["position_given"]),
        accept=tuple(spec.log["accept"]),
    )
    training = [log_description(written, place) for written in spec.log["train"]]
    return prepare_logs(manifest, training, _tests(spec.log["test"], place), asked)


def log_files(log: Mapping[str, Any], folder: Path) -> list[Path]:
    """Descriptions and recordings that an experiment reads, as far as they can be found."""
    found: list[Path] = []
    for written in (*log["train"], *log["test"]):
        try:
            description = log_description(written, folder)
            found += [description.source, *description.files]
        except UsageError:  # told when the cell runs; it has no row that could be stale
            continue
    return found


def recorded_score(
    method: Any, estimate: Estimate, posed: PreparedLogs, truth: float | None
) -> Score:
    """The figures of one estimate, with the mass of an unknown load; `truth`: what a scale said it
    is (kg)."""
    figures = score_recorded(estimate, posed.problem, posed.tests, data_figures(posed.problem, {}))
    figures = replace(figures, joints=tuple(_with_replayed(figures.joints, posed)))
    if estimate.status != "ok" or estimate.beta is None:
        return figures
    told = _mass(method, estimate.beta, posed)
    if "mass" in told and truth is not None:
        told["mass_error"] = abs(told["mass"] - truth)
    return replace(figures, **told)


def _mass(method: Any, beta: Array, posed: PreparedLogs) -> dict[str, Any]:
    """The load's mass: with an interval where its position is given, alone where all ten numbers
    are unknown and it is identifiable."""
    ask, base = posed.builder.unknowns, posed.problem.base
    if ask.given:
        found = payload_mass(method, posed, beta)
        low, high = found.interval
        return {"mass": found.mass, "mass_low": low, "mass_high": high}
    if not ask.payload_parameters:
        return {}
    place = base.parameters.index(ask.payload_parameters[0])
    sure = verdicts(base)[place] == "identifiable"
    return {"mass": float(base.embed(beta)[place])} if sure else {}


def _with_replayed(joints: Iterable[Mapping[str, Any]], posed: PreparedLogs) -> Iterator[Row]:
    """Errors of joints beside those of the training torque itself, of the first test log."""
    again: Mapping[str, float] = {}
    for test in list(posed.testing.values())[:1]:
        again = repeatability_error(posed.training, test, posed.problem.rows) or {}
    for joint in joints:
        yield {**joint, "replayed": again.get(joint["name"])}


def stated_mass(spec: ExperimentSpec) -> float | None:
    """What the load weighs on a scale (kg), where the suite says so."""
    told = None if spec.log is None else spec.log.get("true_mass")
    return None if told is None else quantity(told, "kg")


def log_fields(posed: PreparedLogs) -> Row:
    """What a row tells of the data, whatever the method."""
    logs = [*posed.training, *posed.testing.values()]
    selection, treatment = posed.selection, posed.builder.preprocessing
    return {
        "log": {
            "filter": treatment.filter,
            "derivatives": treatment.derivatives,
            "seconds": sum(float(np.ptp(log.recording.t)) for log in posed.training),
            "findings": "; ".join(
                dict.fromkeys(
                    f"{log.log.description.source.name}: {finding.text}"
                    for log in logs
                    for finding in log.log.findings
                )
            ),
            "chosen": "" if selection is None else " ".join(name for name, _ in selection.added),
            "error_before": None if selection is None else selection.error_before,
            "error_after": None if selection is None else selection.error_after,
        }
    }


def parameter_table(estimate: Estimate, problem: Problem) -> list[Row]:
    """The estimated base parameters, each with the sum that it stands for."""
    if estimate.status != "ok" or estimate.beta is None:
        return []
    told = verdicts(problem.base)
    rows = []
    for j, value, terms in zip(
        problem.base.pivots.tolist(), estimate.beta, base_expressions(problem.base), strict=True
    ):
        body, _, name = problem.parameters[j].rpartition(".")
        rows.append(
            {
                "body": body,
                "name": name,
                "true": None,
                "estimate": float(value),
                "std": None,
                "identifiable": told[j],
                "expression": expression(terms),
            }
        )
    return rows


def predict_test(
    posed: PreparedLogs, beta: Array, test: str | None
) -> tuple[Any, Array, Array, Problem]:
    """Times (N,), measured and predicted torque (N, rows) of a test log (None: of the first, or of
    the first training log), and its problem."""
    from sysid_bench.experiments.recorded.problem import predict_torque

    if test is not None and test not in posed.tests:
        known = ", ".join(posed.tests) or "none"
        raise UsageError(f"There is no test log {test!r} in this cell; there are: {known}.")
    label = test or next(iter(posed.tests), None)
    problem = posed.problem if label is None else posed.tests[label]
    log = posed.training[0] if label is None else posed.testing[label]
    measured, found = predict_torque(problem, beta)
    N = len(log.recording)
    return log.recording.t, measured[:N], found[:N], problem


def _tests(written: Any, folder: Path) -> dict[str, LogDescription]:
    names = [name_of(one) for one in written]
    return {
        name if names.count(name) == 1 else f"{name} {k + 1}": log_description(one, folder)
        for k, (name, one) in enumerate(zip(names, written, strict=True))
    }
