"""Identification of one robot from recordings of the real one."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from sysid_bench.commands.diagnose import check_contradictions
from sysid_bench.commands.result import file_text
from sysid_bench.commands.task_terms import check_term_names
from sysid_bench.errors import EstimationError, ModelError, WriteError
from sysid_bench.evaluation.open_directions import open_directions
from sysid_bench.evaluation.score import data_figures, feasible_figures, joint_errors
from sysid_bench.evaluation.torque_errors import RowErrors, torque_figures
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.recorded.left_out_parts import (
    TermSelection,
    payload_interval,
    payload_mass,
)
from sysid_bench.experiments.recorded.model_prior import MODEL, ModelPrior
from sysid_bench.experiments.recorded.prepare import TERMS_TOO, LogOptions, prepare_recordings
from sysid_bench.experiments.recorded.process_log import LogProcessing, ProcessedLog
from sysid_bench.experiments.recorded.source import RecordedSource, predict_log, repetition_error
from sysid_bench.experiments.tasks.task import find_task
from sysid_bench.identification.identify import identify as estimate_parameters
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.plugin_names import build
from sysid_bench.reporting.signal_figures import StoredTorque, torque_figure
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.signals.pipeline_choice import default_log_pipeline
from sysid_bench.types import Array, Estimate
from sysid_bench.verbs.identify.binding_errors import binding_errors
from sysid_bench.verbs.identify.estimate_fields import (
    estimate_fields,
    failure_of,
    open_warnings,
    warnings_of,
)
from sysid_bench.verbs.identify.identify_request import IdentifyRequest
from sysid_bench.verbs.identify.log_warnings import (
    finding_warnings,
    friction_warnings,
    gain_warnings,
    repetition_warnings,
)
from sysid_bench.verbs.identify.recorded_result import RecordedResult
from sysid_bench.verbs.identify.write_model import check_files, check_output_files
from sysid_bench.verbs.recorded.find_description import find_description

DENOMINATOR: Final = "RMS of the measured torque, filtered as described, over the same samples"
ESTIMATOR: Final = "wls"
_FIGURES: Final = (
    *("rank", "data_rank", "parameters", "rank_gap", "near_degenerate"),
    *("condition", "condition_unit"),
)
"""Figures of the data; the two conditions are absent where the data excite nothing."""
_ON_TESTS: Final = ("rmse_test", "torque_error", "torque_error_moving", "torque_error_weighted")
"""Errors on all test recordings together; None without one."""


@dataclass(frozen=True, kw_only=True)
class RecordedRequest(IdentifyRequest):
    """Identification from recordings described by TOML files, or in memory.

    `derivatives`: "from q", or "from v" (the default where every log has v). `moving`: samples of
    a joint slower than this (rad/s, m/s) are left out. `choose`: joint terms and features ("play",
    "tanh", "poly", or your own) that cross-validation within the training recordings may add.
    `share`: with the task `actuators`, words or patterns; joints whose names hold the same one have
    equal armature and friction; `also`: its further unknowns, "gain", "bias", "load".
    `prior`: "model" (the file's inertias, where they are plausible), "none", or their spreads.
    `feasible`: "terms" or "bodies", see LogOptions. `position_given`: with the task `payload`, its
    mass is the only unknown. `accept`: contradictions in the data that may pass. `sensor`: with the
    task `wrench`, the one that is used; None: the only one of the recordings.
    """

    logs: tuple[Path | LogDescription, ...]
    tests: tuple[Path | LogDescription, ...] = ()
    filter: str | None = None
    derivatives: str | None = None
    moving: float = 0.0
    choose: tuple[str, ...] = ()
    position_given: bool = False
    share: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    accept: tuple[str, ...] = ()
    figure: Path | None = None
    prior: str | Mapping[str, Any] = MODEL
    feasible: str = TERMS_TOO
    sensor: str | None = None


def identify_recorded(request: RecordedRequest) -> RecordedResult:
    """Identify a robot from recordings.

    Raises UsageError for descriptions, files or names that cannot be used and for contradictions
    in the data that `accept` does not name, EstimationError where the method fails.
    """
    check_term_names(request.terms, features=True)
    training, tests = log_summary(request)
    method = build("estimator", _estimator(request))
    manifest = find_manifest(request.model, request.robots_dir)
    _check_targets(request, manifest, [*training, *tests.values()])
    posed = prepare_recordings(manifest, training, tests, _options(request))
    doubts = check_contradictions(posed.source.recordings, request.accept)
    estimate = estimate_parameters(method, posed.problem, posed.experiment)
    if estimate.status != "ok" or estimate.beta is None:
        raise EstimationError(
            f"{_estimator(request)} on {manifest.name}: {estimate.reason}{_no_prior(posed)}"
        )
    result = _result(request, manifest, posed, estimate, estimate.beta)
    result = replace(result, warnings=list(dict.fromkeys([*result.warnings, *doubts])))
    if request.figure is not None:
        _draw(request.figure, posed, estimate.beta)
    if request.model_out is None:
        return result
    return _with_model(result, request.model_out, request.complete, posed, estimate)


def _with_model(
    result: RecordedResult,
    file: Path,
    complete: str | None,
    posed: ExperimentData[RecordedSource],
    estimate: Estimate,
) -> RecordedResult:
    """The result with the written model; a WriteError holds it where the model is refused."""
    # Both engines, which read the file again, load for longer than a short recording is fitted.
    from sysid_bench.verbs.identify.recorded_model import write_recorded_model

    try:
        written = write_recorded_model(posed, estimate, file, complete)
    except (EstimationError, ModelError) as error:
        raise WriteError(str(error), result) from error
    return replace(result, model_out=written.file, written=asdict(written))


def _no_prior(posed: ExperimentData[RecordedSource]) -> str:
    """Sentence with the reason for the absence of a prior, for methods that need one."""
    reason = posed.source.prior.reason
    return f" The prior is absent: {reason}." if reason else ""


def _check_targets(
    request: RecordedRequest, manifest: Manifest, logs: Sequence[LogDescription]
) -> None:
    """Raise UsageError, before anything runs, for files that cannot or must not be written."""
    if request.model_out is not None or request.json_out is not None:
        robot = load_robot(manifest)
        check_files(robot, request.task, request.model_out, request.json_out)
    beside = None if request.model_out is None else request.model_out.with_suffix(".toml")
    check_output_files(written_files(request), beside, read_files(logs))


def written_files(request: RecordedRequest) -> tuple[Path | None, ...]:
    """Return the files that a request names for its results."""
    return request.model_out, request.json_out, request.figure


def read_files(logs: Sequence[LogDescription]) -> list[Path]:
    """Return the descriptions of recordings and the files that they name."""
    return [file for log in logs for file in (log.source, *log.files)]


def log_summary(
    request: RecordedRequest,
) -> tuple[list[LogDescription], dict[str, LogDescription]]:
    """Return descriptions of the training recordings, and of the tests by label."""
    tests = zip(_labels(request.tests), request.tests, strict=True)
    training = [find_description(log) for log in request.logs]
    return training, {label: find_description(log) for label, log in tests}


def _estimator(request: RecordedRequest) -> str:
    return request.estimator or ESTIMATOR


def _options(request: RecordedRequest) -> LogOptions:
    own_filter = {} if request.filter is None else {"filter": request.filter}
    return LogOptions(
        task=request.task,
        terms=request.terms,
        filter=request.filter,
        derivatives=request.derivatives,
        moving=request.moving,
        candidates=request.choose,
        position_given=request.position_given,
        accept=request.accept,
        pipeline=request.pipeline_with_default(default_log_pipeline(own_filter)),
        prior=request.prior,
        feasible=request.feasible,
        sensor=request.sensor,
    )


def _result(
    request: RecordedRequest,
    manifest: Manifest,
    posed: ExperimentData[RecordedSource],
    estimate: Estimate,
    beta: Array,
) -> RecordedResult:
    problem, source = posed.problem, posed.source
    robot = source.training[0].robot
    fields = estimate_fields(estimate, problem, build("estimator", _estimator(request)))
    errors = _errors(posed, beta)
    data = data_figures(problem, {})
    payload = _payload(request, posed, beta, fields["bodies"])
    open_ones, failure = open_directions(problem), failure_of(errors["torque_error"])
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
        payload=payload,
        feasible=feasible_figures(estimate.theta, problem).get("feasible"),
        open_directions=open_ones.count,
        failure=failure,
        warnings=[
            *open_warnings(open_ones),
            *([failure] if failure else []),
            *_warnings(posed, estimate, errors, fields["joints"]),
            *gain_warnings(payload, max(log.payload.mass for log in posed.source.training)),
        ],
        figure=file_text(request.figure),
        constraints=_constraints(request, posed),
        prior=_prior(posed.source.prior),
    )


def _constraints(
    request: RecordedRequest, posed: ExperimentData[RecordedSource]
) -> list[dict[str, Any]] | None:
    """Costs of the constraints that bind, for the estimator `lmi` and for written models."""
    if request.model_out is None and _estimator(request) != "lmi":
        return None
    return binding_errors(posed.problem, posed.held_out)


def _prior(prior: ModelPrior) -> dict[str, str]:
    """The spreads of the prior, or the reason why there is none."""
    return {"spreads": prior.text, "reason": prior.reason}


def _errors(posed: ExperimentData[RecordedSource], beta: Array) -> dict[str, Any]:
    """Errors of the predicted torques: pooled, by joint, and of the training torque itself."""
    problem, source, tests = posed.problem, posed.source, posed.held_out
    figures = torque_figures(tests, posed.held_out_moving, beta)
    return {
        "rmse_train": RowErrors([problem], beta).rms_error,
        **{name: figures.get(name) for name in _ON_TESTS},
        "standstill": posed.figures["standstill"],
        "training": joint_errors(problem, beta),
        "tests": {label: joint_errors(test, beta) for label, test in tests.items()},
        "replayed": {
            label: repetition_error(source.training, test, problem.rows)
            for label, test in source.tests.items()
        },
    }


def _payload(
    request: RecordedRequest,
    posed: ExperimentData[RecordedSource],
    beta: Array,
    bodies: Mapping[str, dict[str, Any]],
) -> dict[str, Any] | None:
    """Identified payload, or its mass alone where its position is given; None for other tasks."""
    if not find_task(request.task).identifies_payload:
        return None
    method, source = build("estimator", _estimator(request)), posed.source
    if not request.position_given:
        intervals = payload_interval(method, posed.problem, source.builder, source.training, beta)
        return {**list(bodies.values())[-1], "intervals": intervals}
    return asdict(payload_mass(method, posed.problem, source.builder, source.training, beta))


def _warnings(
    posed: ExperimentData[RecordedSource],
    estimate: Estimate,
    errors: Mapping[str, Any],
    joints: Mapping[str, Any],
) -> list[str]:
    """Repairs of the model, findings in the logs, doubtful torques, repeated motions, verdicts."""
    source = posed.source
    return [
        *source.training[0].robot.repairs,
        *finding_warnings((*source.training, *source.tests.values())),
        *friction_warnings(joints),
        *repetition_warnings(errors["replayed"]),
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


def _draw(path: Path, posed: ExperimentData[RecordedSource], beta: Array) -> None:
    """Measured and predicted torque of the first test log, or of the training one."""
    found = predict_log(posed, beta)
    units = [kind.removeprefix("joint ") for kind in found.problem.kinds]
    rows = tuple(found.problem.rows)
    torque_figure(
        path, StoredTorque("", found.t, found.measured, found.predicted, rows, tuple(units))
    )


def _signals(preprocessing: LogProcessing) -> dict[str, Any]:
    return {
        "filter": preprocessing.filter,
        "derivatives": preprocessing.derivatives,
        "torque": "filtered",
        "moving": preprocessing.moving,
        "pipeline": preprocessing.name,
    }


def _labels(tests: Sequence[Path | LogDescription]) -> list[str]:
    """Stems of the test files; whole paths where two stems are the same."""
    paths = [test.source if isinstance(test, LogDescription) else test for test in tests]
    stems = [path.stem for path in paths]
    return [
        stem if stems.count(stem) == 1 else str(path)
        for stem, path in zip(stems, paths, strict=True)
    ]


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
