"""Identification of one robot from recordings of the real one."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.evaluation.covariance import standard_errors
from sysid_bench.evaluation.recorded_score import (
    joint_errors,
    rms_error,
    torque_error,
)
from sysid_bench.evaluation.score import data_figures, feasible_figures
from sysid_bench.experiments.prepared import Prepared
from sysid_bench.experiments.recorded.payload_mass import payload_mass
from sysid_bench.experiments.recorded.prepare import LogOptions, prepare_logs
from sysid_bench.experiments.recorded.preprocess import LogProcessing, ProcessedLog
from sysid_bench.experiments.recorded.repeatability import repeatability_error
from sysid_bench.experiments.recorded.source import RecordedSource, predict_log
from sysid_bench.experiments.recorded.term_selection import TermSelection
from sysid_bench.identification.identify import identify as estimate_parameters
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.naming import build
from sysid_bench.reporting.torque_figure import torque_figure
from sysid_bench.signals.log_description import read_description
from sysid_bench.tasks.task import find_task
from sysid_bench.types import Array, Estimate
from sysid_bench.verbs.estimate_fields import (
    base_of,
    bodies_of,
    joints_of,
    std_from,
    warnings_of,
)
from sysid_bench.verbs.identify_result import IdentifyResult
from sysid_bench.verbs.log_warnings import log_warnings
from sysid_bench.verbs.result import OMIT_NONE, value_text
from sysid_bench.verbs.task_terms import check_term_names
from sysid_bench.verbs.write_model import check_files, write_model

DENOMINATOR: Final = "RMS of the measured torque, filtered as described, over the same samples"
ESTIMATOR: Final = "wls"


@dataclass(frozen=True, kw_only=True)
class RecordedRequest:
    """Identification from recordings described by TOML files.

    `derivatives`: "from q", or "from v" (the default where every log has v). `moving`: samples of
    a joint slower than this (rad/s, m/s) are left out. `choose`: joint terms and features ("play",
    "tanh", "poly", or your own) that cross-validation within the training recordings may add.
    `position_given`: with the task `payload`, its mass is the only unknown. `accept`:
    contradictions in the data that may pass.
    """

    model: str
    logs: tuple[Path, ...]
    tests: tuple[Path, ...] = ()
    task: str = "robot"
    terms: tuple[str, ...] | None = None
    estimator: str | None = None
    filter: str | None = None
    derivatives: str | None = None
    moving: float = 0.0
    choose: tuple[str, ...] = ()
    position_given: bool = False
    accept: tuple[str, ...] = ()
    model_out: Path | None = None
    json_out: Path | None = None
    figure: Path | None = None
    robots_dir: Path | None = None


@dataclass(frozen=True, eq=False, repr=False)
class RecordedResult(IdentifyResult):
    """Identification from recordings. `training` and `tests`: {joint: rmse, rms, relative} of the
    predicted torques; `replayed`: errors of the training torque itself where a test repeats the
    training motion; `logs`: the samples used of each file, with what was found in them."""

    model: str
    file: str
    task: str
    terms: list[str]
    rows: list[str]
    locked: dict[str, float]
    estimator: str
    signals: dict[str, Any]
    denominator: str
    selection: dict[str, Any] | None
    rank: int | None
    data_rank: int | None
    parameters: int | None
    rank_gap: float | None
    near_degenerate: int
    condition: float | None
    condition_unit: float | None
    rmse_train: float | None
    rmse_test: float | None
    torque_error: float | None
    training: dict[str, dict[str, float]]
    tests: dict[str, dict[str, dict[str, float]]]
    replayed: dict[str, Any]
    logs: list[dict[str, Any]]
    std_from: str | None
    base: list[dict[str, Any]]
    bodies: dict[str, dict[str, Any]]
    joints: dict[str, dict[str, dict[str, Any]]]
    payload: dict[str, Any] | None
    feasible: bool | None
    warnings: list[str]
    figure: str | None = field(default=None, metadata=OMIT_NONE)
    model_out: str | None = field(default=None, metadata=OMIT_NONE)

    def __post_init__(self) -> None:
        self._make_plain()

    def summary(self) -> str:
        """Table of the joints' errors, then payload and warnings."""
        test = next(iter(self.tests.values()), None)
        lines = [
            f"{self.model}, task {self.task}, {self.estimator}: rank {self.rank} "
            f"of {self.parameters}, condition {value_text(self.condition)}",
            f"  {self._signals_line()}",
            *_selection_lines(self.selection),
            "  joint                  RMS     train" + ("          test" if test else ""),
        ]
        for joint, train in self.training.items():
            line = f"  {joint:18} {train['rms']:8.4g}  {_error(train)}"
            lines.append(line + (f"  {_error(test[joint])}" if test else ""))
        for label, table in list(self.tests.items())[1:]:
            errors = ", ".join(_error(joint).strip() for joint in table.values())
            lines.append(f"  {label}: {errors}")
        if self.payload is not None:
            lines.append(f"  payload: {_payload_line(self.payload)}")
        return "\n".join(lines + self._closing_lines())

    def _signals_line(self) -> str:
        seconds = sum(log["seconds"] for log in self.logs if log["use"] == "train")
        return (
            f"{seconds:.1f} s of training, filter {self.signals['filter']!r}, derivatives "
            f"{self.signals['derivatives']!r}; errors in % of the {self.denominator}"
        )


def identify_recorded(request: RecordedRequest) -> RecordedResult:
    """Identify a robot from recordings.

    Raises UsageError for descriptions, files or names that cannot be used and for contradictions
    in the data that `accept` does not name, EstimationError where the method fails.
    """
    check_term_names(request.terms)
    descriptions = [read_description(log) for log in (*request.logs, *request.tests)]
    name = request.estimator or ESTIMATOR
    method = build("estimator", name)
    manifest = find_manifest(request.model, request.robots_dir)
    if request.model_out is not None or request.json_out is not None:
        robot = load_robot(manifest)
        check_files(robot, request.task, request.model_out, request.json_out)
    training = descriptions[: len(request.logs)]
    testing = dict(zip(_labels(request.tests), descriptions[len(training) :], strict=True))
    posed = prepare_logs(manifest, training, testing, _options(request))
    estimate = estimate_parameters(method, posed.problem, posed.experiment)
    if estimate.status != "ok" or estimate.beta is None:
        raise EstimationError(f"{name} on {manifest.name}: {estimate.reason}")
    result = _result(request, manifest, posed, estimate, estimate.beta)
    if request.figure is not None:
        _draw(request.figure, posed, estimate.beta)
    if request.model_out is not None:
        robot = posed.source.training[0].robot
        write_model(robot, request.task, estimate, posed.problem, request.model_out)
    return result


def _options(request: RecordedRequest) -> LogOptions:
    return LogOptions(
        task=request.task,
        terms=request.terms,
        filter=request.filter,
        derivatives=request.derivatives,
        moving=request.moving,
        candidates=request.choose,
        position_given=request.position_given,
        accept=request.accept,
    )


def _result(
    request: RecordedRequest,
    manifest: Manifest,
    posed: Prepared[RecordedSource],
    estimate: Estimate,
    beta: Array,
) -> RecordedResult:
    problem, source = posed.problem, posed.source
    robot = source.training[0].robot
    errors = standard_errors(problem, estimate)
    bodies, joints = bodies_of(estimate, problem, errors), joints_of(estimate, problem, errors)
    training = joint_errors(problem, beta)
    replayed = {
        label: repeatability_error(source.training, test, problem.rows)
        for label, test in source.tests.items()
    }
    figures = data_figures(problem, {})
    processed = (*source.training, *source.tests.values())
    payload: dict[str, Any] | None = None
    if find_task(request.task).identifies_payload:
        payload = list(bodies.values())[-1]
        if request.position_given:
            method = build("estimator", request.estimator or ESTIMATOR)
            payload = asdict(payload_mass(method, problem, source.builder, source.training, beta))
    return RecordedResult(
        model=manifest.name,
        file=str(manifest.path),
        task=request.task,
        terms=list(source.terms),
        rows=list(problem.rows),
        locked=dict(robot.manifest.locked),
        estimator=request.estimator or ESTIMATOR,
        signals=_signals(source.builder.preprocessing),
        denominator=DENOMINATOR,
        selection=None if source.selection is None else _selection(source.selection),
        rank=figures["rank"],
        data_rank=figures["data_rank"],
        parameters=figures["parameters"],
        rank_gap=figures["rank_gap"],
        near_degenerate=figures["near_degenerate"],
        condition=figures.get("condition"),
        condition_unit=figures.get("condition_unit"),
        rmse_train=rms_error(problem, beta),
        rmse_test=_mean([rms_error(test, beta) for test in posed.held_out.values()]),
        torque_error=torque_error(posed.held_out, beta),
        training=training,
        tests={label: joint_errors(test, beta) for label, test in posed.held_out.items()},
        replayed=replayed,
        logs=[
            *(_segment(log, "train") for log in source.training),
            *(_segment(log, "test") for log in source.tests.values()),
        ],
        std_from=std_from(errors),
        base=base_of(estimate, problem, errors),
        bodies=bodies,
        joints=joints,
        payload=payload,
        feasible=feasible_figures(estimate.theta, problem).get("feasible"),
        warnings=[
            *robot.repairs,
            *_findings(processed),
            *log_warnings(training, joints),
            *_repeated(replayed),
            *warnings_of(estimate, problem),
        ],
        figure=None if request.figure is None else str(request.figure),
        model_out=None if request.model_out is None else str(request.model_out),
    )


def _selection(selection: TermSelection) -> dict[str, Any]:
    return {
        "added": [{"parameter": name, "error": error} for name, error in selection.added],
        "error_before": selection.error_before,
        "error_after": selection.error_after,
        "left_out": selection.parts,
    }


def _selection_lines(selection: Mapping[str, Any] | None) -> list[str]:
    if selection is None:
        return []
    names = ", ".join(step["parameter"] for step in selection["added"]) or "nothing"
    return [
        f"  chosen on {selection['left_out']}: {names} (mean error there "
        f"{100 * selection['error_before']:.1f} -> {100 * selection['error_after']:.1f} %)"
    ]


def _draw(path: Path, posed: Prepared[RecordedSource], beta: Array) -> None:
    """Measured and predicted torque of the first test log, or of the training one."""
    found = predict_log(posed, beta)
    units = [kind.removeprefix("joint ") for kind in found.problem.kinds]
    torque_figure(path, found.t, found.problem.rows, found.measured, found.predicted, units)


def _error(joint: Mapping[str, Any]) -> str:
    relative = joint["relative"]
    share = "     -" if relative is None else f"{100 * relative:5.1f}%"
    return f"{joint['rmse']:8.3g} {share}"


def _payload_line(payload: Mapping[str, Any]) -> str:
    if "interval" in payload:
        low, high = payload["interval"]
        return (
            f"mass {payload['mass']:.4g} kg, {100 * payload['confidence']:.0f} % in [{low:.4g}, "
            f"{high:.4g}] by leaving parts of the motion out"
        )
    single = [key for key, verdict in payload["identifiable"].items() if verdict == "identifiable"]
    units = {"m": "kg", "h": "kg m", "I": "kg m^2"}
    values = [f"{key} {value_text(payload['parameters'][key])} {units[key[0]]}" for key in single]
    return ", ".join(values) or "nothing of it is identifiable on its own"


def _signals(preprocessing: LogProcessing) -> dict[str, Any]:
    return {
        "filter": preprocessing.filter,
        "derivatives": preprocessing.derivatives,
        "torque": "filtered",
        "moving": preprocessing.moving,
    }


def _labels(tests: Sequence[Path]) -> list[str]:
    """Stems of the test files; whole paths where two stems are the same."""
    stems = [test.stem for test in tests]
    return [
        stem if stems.count(stem) == 1 else str(test)
        for stem, test in zip(stems, tests, strict=True)
    ]


def _mean(values: Sequence[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def _segment(processed: ProcessedLog, use: str) -> dict[str, Any]:
    """Samples of a file that were used, and the findings in it."""
    log, recording = processed.log, processed.recording
    return {
        "use": use,
        "log": str(log.description.source),
        "samples": log.samples,
        "rows": None if log.description.rows is None else list(log.description.rows),
        "rate": recording.rate,
        "measured_rate": log.measured_rate,
        "used_samples": len(recording),
        "used_from": float(recording.t[0]),
        "seconds": float(recording.t[-1] - recording.t[0]),
        "payload": processed.payload.name,
        "findings": [
            {"name": f.name, "count": f.count, "text": f.text, "contradiction": f.contradiction}
            for f in log.findings
        ],
    }


def _findings(logs: Sequence[ProcessedLog]) -> list[str]:
    return [
        f"{one.log.description.source.name}: {finding.text}"
        for one in logs
        for finding in one.log.findings
    ]


def _repeated(replayed: Mapping[str, Mapping[str, float] | None]) -> list[str]:
    """Warn about tests on the training motion: they say nothing about other motions."""
    warnings = []
    for label, errors in replayed.items():
        if errors is not None:
            shares = " ".join(f"{100 * error:.1f}" for error in errors.values())
            warnings.append(
                f"{label} repeats the training motion: its errors show how well the same motion is "
                "predicted again, not how well others are; the training torque itself, played "
                f"again, errs by {shares} %"
            )
    return warnings
