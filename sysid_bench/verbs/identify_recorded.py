"""Identification of one robot from recordings of the real one."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import EstimationError, UsageError
from sysid_bench.evaluation.covariance import standard_errors
from sysid_bench.evaluation.recorded_score import (
    joint_errors,
    rms_error,
    torque_error,
    weighted_error,
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
from sysid_bench.signals.log_description import LogDescription, read_description
from sysid_bench.tasks.task import find_task
from sysid_bench.types import Array, Estimate
from sysid_bench.verbs.estimate_fields import (
    estimate_fields,
    parameters_with,
    warnings_of,
)
from sysid_bench.verbs.identify_request import IdentifyRequest
from sysid_bench.verbs.identify_result import IdentifyResult, base_lines, std_lines
from sysid_bench.verbs.log_warnings import log_warnings
from sysid_bench.verbs.result import OMIT_NONE, file_text, value_text
from sysid_bench.verbs.task_terms import check_term_names
from sysid_bench.verbs.write_model import check_files, write_model

DENOMINATOR: Final = "RMS of the measured torque, filtered as described, over the same samples"
ESTIMATOR: Final = "wls"
DESCRIPTION: Final = (
    "file = '{}', rate = '200 Hz', joints = ['j1'], q = {{ columns = [1], unit = 'rad' }}, "
    "tau = {{ columns = [2], unit = 'N m' }}, one key a line."
)
"""Smallest description of a recording, with the name of its file left open."""
_FIGURES: Final = (
    *("rank", "data_rank", "parameters", "rank_gap", "near_degenerate"),
    *("condition", "condition_unit"),
)
"""Figures of the data; the two conditions are absent where the data excite nothing."""


@dataclass(frozen=True, kw_only=True)
class RecordedRequest(IdentifyRequest):
    """Identification from recordings described by TOML files.

    `derivatives`: "from q", or "from v" (the default where every log has v). `moving`: samples of
    a joint slower than this (rad/s, m/s) are left out. `choose`: joint terms and features ("play",
    "tanh", "poly", or your own) that cross-validation within the training recordings may add.
    `position_given`: with the task `payload`, its mass is the only unknown. `accept`:
    contradictions in the data that may pass.
    """

    logs: tuple[Path, ...]
    tests: tuple[Path, ...] = ()
    filter: str | None = None
    derivatives: str | None = None
    moving: float = 0.0
    choose: tuple[str, ...] = ()
    position_given: bool = False
    accept: tuple[str, ...] = ()
    figure: Path | None = None


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
    torque_error_moving: float | None
    torque_error_weighted: float | None
    standstill: float
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
            *(_joint_line(joint, train, test) for joint, train in self.training.items()),
            *(_test_line(label, table) for label, table in list(self.tests.items())[1:]),
            *base_lines(self.base),
            *std_lines(self.std_from),
            *_payload_lines(self.payload),
        ]
        return "\n".join(lines + self._closing_lines())

    def _signals_line(self) -> str:
        seconds = sum(log["seconds"] for log in self.logs if log["use"] == "train")
        return (
            f"{seconds:.1f} s of training, pipeline {self.signals['pipeline']!r}, filter "
            f"{self.signals['filter']!r}, derivatives "
            f"{self.signals['derivatives']!r}; errors in % of the {self.denominator}"
        )


def identify_recorded(request: RecordedRequest) -> RecordedResult:
    """Identify a robot from recordings.

    Raises UsageError for descriptions, files or names that cannot be used and for contradictions
    in the data that `accept` does not name, EstimationError where the method fails.
    """
    check_term_names(request.terms)
    training, tests = _descriptions(request)
    method = build("estimator", _estimator(request))
    manifest = find_manifest(request.model, request.robots_dir)
    _check_targets(request, manifest)
    posed = prepare_logs(manifest, training, tests, _options(request))
    estimate = estimate_parameters(method, posed.problem, posed.experiment)
    if estimate.status != "ok" or estimate.beta is None:
        raise EstimationError(f"{_estimator(request)} on {manifest.name}: {estimate.reason}")
    result = _result(request, manifest, posed, estimate, estimate.beta)
    if request.figure is not None:
        _draw(request.figure, posed, estimate.beta)
    if request.model_out is not None:
        robot = posed.source.training[0].robot
        write_model(robot, request.task, estimate, posed.problem, request.model_out)
    return result


def _check_targets(request: RecordedRequest, manifest: Manifest) -> None:
    """Raise UsageError, before anything runs, for files that cannot be written."""
    if request.model_out is not None or request.json_out is not None:
        robot = load_robot(manifest)
        check_files(robot, request.task, request.model_out, request.json_out)


def _descriptions(
    request: RecordedRequest,
) -> tuple[list[LogDescription], dict[str, LogDescription]]:
    """Descriptions of the training recordings, and of the tests by label."""
    tests = zip(_labels(request.tests), request.tests, strict=True)
    training = [_description(log) for log in request.logs]
    return training, {label: _description(log) for label, log in tests}


def _description(file: Path) -> LogDescription:
    """Description of a recording; for a file that is not TOML, an error with an example."""
    try:
        return read_description(file)
    except UsageError as error:
        if file.suffix.lower() == ".toml" or not file.is_file():
            raise
        raise UsageError(
            f"{str(file)!r} is not the description of a recording. Write a TOML file that names "
            f"its data and its columns, and give that: {DESCRIPTION.format(file.name)}"
        ) from error


def _estimator(request: RecordedRequest) -> str:
    return request.estimator or ESTIMATOR


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
        pipeline=request.named_pipeline,
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
    fields = estimate_fields(estimate, problem, standard_errors(problem, estimate))
    errors = _errors(posed, beta)
    data = data_figures(problem, {})
    figures: dict[str, Any] = {key: data.get(key) for key in _FIGURES}
    return RecordedResult(
        model=manifest.name,
        file=str(manifest.path),
        task=request.task,
        terms=list(source.terms),
        rows=list(problem.rows),
        locked=dict(robot.manifest.locked),
        estimator=_estimator(request),
        signals=_signals(source.builder.preprocessing),
        denominator=DENOMINATOR,
        selection=_selection(source.selection),
        **figures,
        **errors,
        **fields,
        logs=_segments(source),
        payload=_payload(request, posed, beta, fields["bodies"]),
        feasible=feasible_figures(estimate.theta, problem).get("feasible"),
        warnings=_warnings(posed, estimate, errors, fields["joints"]),
        figure=file_text(request.figure),
        model_out=file_text(request.model_out),
    )


def _errors(posed: Prepared[RecordedSource], beta: Array) -> dict[str, Any]:
    """Errors of the predicted torques: pooled, by joint, and of the training torque itself."""
    problem, source, tests = posed.problem, posed.source, posed.held_out
    return {
        "rmse_train": rms_error(problem, beta),
        "rmse_test": _mean([rms_error(test, beta) for test in tests.values()]),
        "torque_error": torque_error(tests, beta),
        "torque_error_moving": torque_error(posed.held_out_moving, beta),
        "torque_error_weighted": weighted_error(tests, beta),
        "standstill": posed.figures["standstill"],
        "training": joint_errors(problem, beta),
        "tests": {label: joint_errors(test, beta) for label, test in tests.items()},
        "replayed": {
            label: repeatability_error(source.training, test, problem.rows)
            for label, test in source.tests.items()
        },
    }


def _payload(
    request: RecordedRequest,
    posed: Prepared[RecordedSource],
    beta: Array,
    bodies: Mapping[str, dict[str, Any]],
) -> dict[str, Any] | None:
    """Identified payload, or its mass alone where its position is given; None for other tasks."""
    if not find_task(request.task).identifies_payload:
        return None
    if not request.position_given:
        return list(bodies.values())[-1]
    method, source = build("estimator", _estimator(request)), posed.source
    return asdict(payload_mass(method, posed.problem, source.builder, source.training, beta))


def _warnings(
    posed: Prepared[RecordedSource],
    estimate: Estimate,
    errors: Mapping[str, Any],
    joints: Mapping[str, Any],
) -> list[str]:
    """Repairs of the model, findings in the logs, doubtful torques, repeated motions, verdicts."""
    source = posed.source
    return [
        *source.training[0].robot.repairs,
        *_findings((*source.training, *source.tests.values())),
        *log_warnings(errors["training"], joints),
        *_repeated(errors["replayed"]),
        *warnings_of(estimate, posed.problem),
    ]


def _selection(selection: TermSelection | None) -> dict[str, Any] | None:
    if selection is None:
        return None
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


def _joint_line(
    joint: str, train: Mapping[str, Any], test: Mapping[str, Mapping[str, Any]] | None
) -> str:
    """RMS torque of a joint and its errors in training and in the first test."""
    line = f"  {joint:18} {train['rms']:8.4g}  {_error(train)}"
    return line + (f"  {_error(test[joint])}" if test else "")


def _test_line(label: str, errors: Mapping[str, Mapping[str, Any]]) -> str:
    """Errors of all joints in a further test."""
    return f"  {label}: {', '.join(_error(joint).strip() for joint in errors.values())}"


def _error(joint: Mapping[str, Any]) -> str:
    relative = joint["relative"]
    share = "     -" if relative is None else f"{100 * relative:5.1f}%"
    return f"{joint['rmse']:8.3g} {share}"


def _payload_lines(payload: Mapping[str, Any] | None) -> list[str]:
    """Line of the identified payload; none for tasks without one."""
    if payload is None:
        return []
    return [f"  payload: {(_mass_text if 'interval' in payload else _values_text)(payload)}"]


def _mass_text(payload: Mapping[str, Any]) -> str:
    low, high = payload["interval"]
    return (
        f"mass {payload['mass']:.4g} kg, {100 * payload['confidence']:.0f} % in [{low:.4g}, "
        f"{high:.4g}] by leaving parts of the motion out"
    )


def _values_text(payload: Mapping[str, Any]) -> str:
    """Parameters of the payload that are identifiable on their own, with units."""
    units = {"m": "kg", "h": "kg m", "I": "kg m^2"}
    values = [
        f"{key} {value_text(payload['parameters'][key])} {units[key[0]]}"
        for key in parameters_with(payload, "identifiable")
    ]
    return ", ".join(values) or "nothing of it is identifiable on its own"


def _signals(preprocessing: LogProcessing) -> dict[str, Any]:
    return {
        "filter": preprocessing.filter,
        "derivatives": preprocessing.derivatives,
        "torque": "filtered",
        "moving": preprocessing.moving,
        "pipeline": preprocessing.name,
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


def _segments(source: RecordedSource) -> list[dict[str, Any]]:
    training = [_segment(log, "train") for log in source.training]
    return training + [_segment(log, "test") for log in source.tests.values()]


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
    return [
        _repeated_test(label, errors) for label, errors in replayed.items() if errors is not None
    ]


def _repeated_test(label: str, errors: Mapping[str, float]) -> str:
    shares = " ".join(f"{100 * error:.1f}" for error in errors.values())
    return (
        f"{label} repeats the training motion: its errors show how well the same motion is "
        "predicted again, not how well others are; the training torque itself, played "
        f"again, errs by {shares} %"
    )
