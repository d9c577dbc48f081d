"""Identification of one robot from recordings of the real one."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

from sysid_bench.commands.diagnose import check_contradictions
from sysid_bench.commands.identify import Identify
from sysid_bench.commands.identify_result import (
    estimate_fields,
    failure_of,
    open_warnings,
    warnings_of,
)
from sysid_bench.commands.recorded_result import RecordedResult, binding_errors
from sysid_bench.commands.result import file_text, interval_text
from sysid_bench.commands.task_terms import check_term_names
from sysid_bench.commands.write_model import check_files, check_output_files
from sysid_bench.errors import EstimationError, ModelError, WriteError
from sysid_bench.evaluation.intervals import level_text
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
from sysid_bench.signals.log_description import LogDescription, find_description
from sysid_bench.signals.pipeline_choice import default_log_pipeline
from sysid_bench.types import Array, Estimate

DEVIATIONS: Final = 3.0
"""Standard deviations below zero from which a friction coefficient counts as negative."""

LEAST_GAIN_ERROR, LARGEST_DEVIATION = 0.05, 0.2
"""Least error of a torque scale that is reported, and the largest standard deviation (shares) with
which a joint decides it."""

PUSHING: Final = (
    "friction is negative on {}: the torque has the wrong sign there, or it is not the motor's."
)


def friction_warnings(joints: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a sentence for joints whose torque pushes with the motion; `joints` as in the result
    of `identify`."""
    names = [name for name, terms in joints.items() if _pushes(terms)]
    return [PUSHING.format(", ".join(names))] if names else []


def _pushes(terms: Mapping[str, Mapping[str, Any]]) -> bool:
    """Test whether the viscous and Coulomb friction of a joint, where identified, are negative."""
    friction = [terms[term] for term in ("viscous", "coulomb") if term in terms]
    return bool(friction) and all(_is_negative(term) for term in friction)


def _is_negative(term: Mapping[str, Any]) -> bool:
    """Test whether a coefficient is negative beyond its standard deviation, where that is known."""
    return term["value"] is not None and bool(term["value"] < -DEVIATIONS * (term["std"] or 0.0))


def finding_warnings(logs: Sequence[ProcessedLog]) -> list[str]:
    """Return the findings in recordings, each with its file."""
    return [
        f"{one.log.description.source.name}: {finding.text}"
        for one in logs
        for finding in one.log.findings
    ]


def repetition_warnings(replayed: Mapping[str, Mapping[str, float] | None]) -> list[str]:
    """Return sentences for tests on the training motion: they say nothing about other motions."""
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


def gain_warnings(payload: Mapping[str, Any] | None, stated: float) -> list[str]:
    """Return sentences for torques whose scale a known load contradicts; `payload` as in the result
    of `identify` on logs, `stated`: its mass (kg) in the log."""
    if payload is None or not stated > 0:
        return []
    if "by_joint" in payload:
        return _joint_gains(payload["by_joint"], stated)
    ends = payload["intervals"].get("mass")
    return [] if ends is None else _mass_gain(payload["mass"], ends[0], stated)


def _mass_gain(found: float, interval: Sequence[float], stated: float) -> list[str]:
    """A sentence on a mass that the torques of all joints give, where the stated one is beyond its
    interval."""
    low, high = interval
    if low <= stated <= high or abs(found / stated - 1) < LEAST_GAIN_ERROR:
        return []
    return [
        f"the log states a payload of {stated:.4g} kg, the torques give {found:.4g} kg "
        f"({level_text()} in {interval_text(low, high)}): if the statement is right, torques are "
        f"{found / stated:.3g} times the true ones, as with wrong drive gains"
    ]


def _joint_gains(masses: Mapping[str, Sequence[float]], stated: float) -> list[str]:
    """Sentence on the joints whose own torque gives another mass than the one stated."""
    wrong = [
        f"{name} {mass / stated:.3g} ± {std / stated:.1g}"
        for name, (mass, std) in masses.items()
        if abs(mass - stated) > max(DEVIATIONS * std, LEAST_GAIN_ERROR * stated)
        and std < LARGEST_DEVIATION * stated
    ]
    if not wrong:
        return []
    return [
        f"by the stated payload of {stated:.4g} kg, torques are these multiples of the true ones: "
        f"{', '.join(wrong)}; divide the gains of these joints by them, or correct the statement"
    ]


DENOMINATOR: Final = "RMS of the measured torque, filtered as described, over the same samples"
ESTIMATOR: Final = "wls"
_FIGURES: Final = (
    *("rank", "data_rank", "parameters", "rank_gap", "near_degenerate"),
    *("condition", "condition_unit"),
)
"""Figures of the data; the two conditions are absent where the data excite nothing."""
_ON_TESTS: Final = ("rmse_test", "torque_error", "torque_error_moving", "torque_error_weighted")
"""Errors on all test recordings together; None without one."""


def identify_recorded(request: Identify) -> RecordedResult:
    """Identify a robot from recordings.

    Raises UsageError for descriptions, files or names that cannot be used and for contradictions
    in the data that `accept` does not name, EstimationError where the method fails.
    """
    check_term_names(request.terms, features=True)
    training, tests = log_summary(request)
    method = build("estimator", _estimator(request))
    manifest = find_manifest(str(request.model), request.robots_dir)
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
    model_out, _, figure = request.files
    if figure is not None:
        # Measured and predicted torque of the first test log, or of the training one.
        found = predict_log(posed, estimate.beta)
        units = [kind.removeprefix("joint ") for kind in found.problem.kinds]
        rows = tuple(found.problem.rows)
        torque_figure.write(
            figure, StoredTorque("", found.t, found.measured, found.predicted, rows, tuple(units))
        )
    if model_out is None:
        return result
    return _with_model(result, model_out, request.complete, posed, estimate)


def _with_model(
    result: RecordedResult,
    file: Path,
    complete: str | None,
    posed: ExperimentData[RecordedSource],
    estimate: Estimate,
) -> RecordedResult:
    """The result with the written model; a WriteError holds it where the model is refused."""
    # Both engines, which read the file again, load for longer than a short recording is fitted.
    from sysid_bench.commands.recorded_model import write_recorded_model

    try:
        written = write_recorded_model(posed, estimate, file, complete)
    except (EstimationError, ModelError) as error:
        raise WriteError(str(error), result) from error
    return replace(result, model_out=written.file, written=asdict(written))


def _no_prior(posed: ExperimentData[RecordedSource]) -> str:
    """Sentence with the reason for the absence of a prior, for methods that need one."""
    reason = posed.source.prior.reason
    return f" The prior is absent: {reason}." if reason else ""


def _check_targets(request: Identify, manifest: Manifest, logs: Sequence[LogDescription]) -> None:
    """Raise UsageError, before anything runs, for files that cannot or must not be written."""
    model_out, json_out, _ = request.files
    if model_out is not None or json_out is not None:
        robot = load_robot(manifest)
        check_files(robot, request.task, model_out, json_out)
    beside = None if model_out is None else model_out.with_suffix(".toml")
    check_output_files(request.files, beside, read_files(logs))


def read_files(logs: Sequence[LogDescription]) -> list[Path]:
    """Return the descriptions of recordings and the files that they name."""
    return [file for log in logs for file in (log.source, *log.files)]


def log_summary(
    request: Identify,
) -> tuple[list[LogDescription], dict[str, LogDescription]]:
    """Return descriptions of the training recordings, and of the tests by label."""
    tests = zip(_labels(request.test), request.test, strict=True)
    training = [find_description(log) for log in request.log]
    return training, {label: find_description(log) for label, log in tests}


def _estimator(request: Identify) -> str:
    return request.estimator or ESTIMATOR


def _options(request: Identify) -> LogOptions:
    own_filter = {} if request.filter is None else {"filter": request.filter}
    return LogOptions(
        task=request.task,
        terms=request.given_terms,
        filter=request.filter,
        derivatives=request.derivatives,
        moving=request.moving,
        candidates=tuple(request.choose),
        position_given=request.position_given,
        accept=tuple(request.accept),
        pipeline=request.pipeline_with_default(default_log_pipeline(own_filter)),
        prior=MODEL if request.prior is None else request.prior,
        feasible=TERMS_TOO if request.feasible is None else request.feasible,
        sensor=request.sensor,
    )


def _result(
    request: Identify,
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
    request: Identify, posed: ExperimentData[RecordedSource]
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
    request: Identify,
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
