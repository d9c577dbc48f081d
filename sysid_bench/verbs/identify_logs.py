"""One robot, one method, recordings of the real thing."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.errors import EstimationError

if TYPE_CHECKING:
    from sysid_bench.experiments.recorded.prepared_logs import PreparedLogs
    from sysid_bench.experiments.recorded.preprocess import Preprocessing, ProcessedLog
    from sysid_bench.experiments.recorded.term_selection import TermSelection

DENOMINATOR: Final = "RMS of the measured torque, filtered as told, over the same samples"


def identify_logs(
    model: str | Path,
    logs: Sequence[str | Path],
    tests: Sequence[str | Path] = (),
    task: str = "robot",
    terms: Sequence[str] | None = None,
    estimator: str | None = None,
    filter: str | None = None,
    derivatives: str | None = None,
    moving: float = 0.0,
    candidates: Sequence[str] = (),
    position_given: bool = False,
    accept: Sequence[str] = (),
    model_out: str | Path | None = None,
    figure: str | Path | None = None,
    robots_dir: Path | None = None,
) -> dict[str, Any]:
    """Identifies a robot from recordings; the answer as `identify --log --json` prints it.

    `candidates`: joint terms and features ("play", "tanh", "poly", or one of your own) of which
    cross-validation inside of the training recordings takes what helps. `position_given`: with the
    task `payload`, its mass is the only unknown of it.
    `derivatives`: "from q", or "from v" (the default where every log has v). Raises UsageError for
    descriptions, files or words that cannot be, and for contradictions in the data that `accept`
    does not name; EstimationError where the method fails.
    """
    from sysid_bench.canonical_json import plain
    from sysid_bench.evaluation.covariance import standard_errors
    from sysid_bench.evaluation.recorded_score import eigenvalues, pooled_error, torque_error
    from sysid_bench.experiments.recorded.payload_mass import payload_mass
    from sysid_bench.experiments.recorded.prepare import LogOptions, prepare_logs
    from sysid_bench.experiments.recorded.repeatability import repeatability_error
    from sysid_bench.identification.identify import identify as solve
    from sysid_bench.models.load import load_robot
    from sysid_bench.models.manifest import find_manifest
    from sysid_bench.naming import build
    from sysid_bench.signals.log_description import read_description
    from sysid_bench.tasks.task import named_task
    from sysid_bench.verbs.log_warnings import log_warnings
    from sysid_bench.verbs.result import base_of, bodies_of, joints_of, std_from, warnings_of
    from sysid_bench.verbs.write_model import check_target, write_model

    descriptions = [read_description(Path(log)) for log in (*logs, *tests)]
    name = estimator or "wls"
    method = build("estimator", name)
    manifest = find_manifest(str(model), robots_dir)
    if model_out is not None:
        check_target(load_robot(manifest), task, Path(model_out))
    asked = LogOptions(
        task, None if terms is None else tuple(terms), filter, derivatives, moving,
        tuple(candidates), position_given, tuple(accept),
    )  # fmt: skip
    named = dict(zip(_labels(tests), descriptions[len(logs) :], strict=True))
    posed = prepare_logs(manifest, descriptions[: len(logs)], named, asked)
    training, testing = posed.training, posed.testing
    read = (*training, *testing.values())
    robot, treatment = training[0].robot, posed.builder.preprocessing
    estimate = solve(method, posed.problem, posed.experiment)
    if estimate.status != "ok" or estimate.beta is None:
        raise EstimationError(f"{name} on {manifest.name}: {estimate.reason}")
    beta = estimate.beta
    again = {
        label: repeatability_error(training, test, posed.problem.rows)
        for label, test in testing.items()
    }
    sure = standard_errors(posed.problem, estimate)
    bodies = bodies_of(estimate, posed.problem, sure)
    told, terms_told = _joint_table(posed.problem, beta), joints_of(estimate, posed.problem, sure)
    answer = {
        "model": manifest.name,
        "file": str(manifest.path),
        "task": task,
        "terms": list(posed.terms),
        "rows": list(posed.problem.rows),
        "locked": dict(robot.manifest.locked),
        "estimator": name,
        "signals": _told(treatment),
        "denominator": DENOMINATOR,
        "selection": None if posed.selection is None else _selection(posed.selection),
        **_data_figures(posed.problem),
        "rmse_train": pooled_error(posed.problem, beta),
        "rmse_test": _mean([pooled_error(test, beta) for test in posed.tests.values()]),
        "torque_error": torque_error(posed.tests, beta),
        "training": told,
        "tests": {label: _joint_table(test, beta) for label, test in posed.tests.items()},
        "replayed": again,
        "logs": [_segment(one, one in training) for one in read],
        "std_from": std_from(sure),
        "base": base_of(estimate, posed.problem, sure),
        "bodies": bodies,
        "joints": terms_told,
        "payload": None
        if not named_task(task).identifies_payload
        else asdict(payload_mass(method, posed, beta))
        if position_given
        else list(bodies.values())[-1],
        "feasible": eigenvalues(estimate, posed.problem).get("feasible"),
        "warnings": [
            *robot.repairs,
            *_findings(read),
            *log_warnings(told, terms_told),
            *_repeated(again),
            *warnings_of(estimate, posed.problem),
        ],
    }
    if figure is not None:
        _draw(Path(figure), posed, beta)
        answer["figure"] = str(figure)
    if model_out is not None:
        write_model(robot, task, estimate, posed.problem, Path(model_out))
        answer["model_out"] = str(model_out)
    return dict(plain(answer))


def summary(answer: Mapping[str, Any]) -> list[str]:
    """What `identify --log` tells: a table of the joints, then what to know about it."""
    test = next(iter(answer["tests"].values()), None)
    lines = [
        f"{answer['model']}, task {answer['task']}, {answer['estimator']}: rank {answer['rank']} "
        f"of {answer['parameters']}, condition {_number(answer['condition'])}",
        f"  {_signals_line(answer)}",
        *_selection_lines(answer["selection"]),
        "  joint                  RMS     train          test" if test else
        "  joint                  RMS     train",
    ]  # fmt: skip
    for joint, train in answer["training"].items():
        line = f"  {joint:18} {train['rms']:8.4g}  {_error(train)}"
        lines.append(line + (f"  {_error(test[joint])}" if test else ""))
    for label, table in list(answer["tests"].items())[1:]:
        lines.append(f"  {label}: " + ", ".join(_error(told).strip() for told in table.values()))
    if answer["payload"] is not None:
        lines.append(f"  payload: {_payload_line(answer['payload'])}")
    lines += [f"  warning: {warning}" for warning in answer["warnings"]]
    if answer.get("figure"):
        lines.append(f"  figure: {answer['figure']}")
    if answer.get("model_out"):
        lines.append(f"  model: {answer['model_out']}")
    return lines


def _selection(selection: "TermSelection") -> dict[str, Any]:
    return {
        "added": [{"parameter": name, "error": error} for name, error in selection.added],
        "error_before": selection.error_before,
        "error_after": selection.error_after,
        "left_out": selection.parts,
    }


def _selection_lines(told: Mapping[str, Any] | None) -> list[str]:
    if told is None:
        return []
    names = ", ".join(step["parameter"] for step in told["added"]) or "nothing"
    return [
        f"  chosen on {told['left_out']}: {names} (mean error there "
        f"{100 * told['error_before']:.1f} -> {100 * told['error_after']:.1f} %)"
    ]


def _draw(path: Path, posed: "PreparedLogs", beta: Any) -> None:
    """Measured and predicted torque of the first test log, or of the training one."""
    from sysid_bench.experiments.recorded.rows import predict_test
    from sysid_bench.reporting.torque_figure import torque_figure

    t, measured, found, problem = predict_test(posed, beta, None)
    units = [kind.removeprefix("joint ") for kind in problem.kinds]
    torque_figure(path, t, problem.rows, measured, found, units)


def _signals_line(answer: Mapping[str, Any]) -> str:
    told = answer["signals"]
    seconds = sum(log["seconds"] for log in answer["logs"] if log["use"] == "train")
    return (
        f"{seconds:.1f} s of training, filter {told['filter']!r}, derivatives "
        f"{told['derivatives']!r}; errors in % of the {answer['denominator']}"
    )


def _error(told: Mapping[str, Any]) -> str:
    relative = told["relative"]
    share = "     -" if relative is None else f"{100 * relative:5.1f}%"
    return f"{told['rmse']:8.3g} {share}"


def _payload_line(payload: Mapping[str, Any]) -> str:
    if "interval" in payload:
        low, high = payload["interval"]
        return (
            f"mass {payload['mass']:.4g} kg, {100 * payload['confidence']:.0f} % in [{low:.4g}, "
            f"{high:.4g}] by leaving parts of the motion out"
        )
    sure = [key for key, verdict in payload["identifiable"].items() if verdict == "identifiable"]
    units = {"m": "kg", "h": "kg m", "I": "kg m^2"}
    told = [f"{key} {_number(payload['parameters'][key])} {units[key[0]]}" for key in sure]
    return ", ".join(told) or "nothing of it is identifiable on its own"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _told(treatment: "Preprocessing") -> dict[str, Any]:
    return {
        "filter": treatment.filter,
        "derivatives": treatment.derivatives,
        "torque": "filtered",
        "moving": treatment.moving,
    }


def _labels(tests: Sequence[str | Path]) -> list[str]:
    """A test recording is known by its file, by its whole path where two are called the same."""
    stems = [Path(test).stem for test in tests]
    return [
        stem if stems.count(stem) == 1 else str(test)
        for stem, test in zip(stems, tests, strict=True)
    ]


def _data_figures(problem: Any) -> dict[str, Any]:
    from sysid_bench.evaluation.score import data_figures

    return data_figures(problem, {})


def _joint_table(problem: Any, beta: Any) -> dict[str, Any]:
    from sysid_bench.evaluation.recorded_score import joint_errors

    return joint_errors(problem, beta)


def _mean(values: Sequence[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def _segment(one: "ProcessedLog", trains: bool) -> dict[str, Any]:
    """Which part of which file was used, and what was found in it."""
    log, used = one.log, one.recording
    return {
        "use": "train" if trains else "test",
        "log": str(log.description.source),
        "samples": log.samples,
        "rows": None if log.description.rows is None else list(log.description.rows),
        "rate": used.rate,
        "measured_rate": log.measured_rate,
        "used_samples": len(used),
        "used_from": float(used.t[0]),
        "seconds": float(used.t[-1] - used.t[0]),
        "payload": one.payload.name,
        "findings": [
            {"name": f.name, "count": f.count, "text": f.text, "contradiction": f.contradiction}
            for f in log.findings
        ],
    }


def _findings(read: "Sequence[ProcessedLog]") -> list[str]:
    return [
        f"{one.log.description.source.name}: {finding.text}"
        for one in read
        for finding in one.log.findings
    ]


def _repeated(again: Mapping[str, Mapping[str, float] | None]) -> list[str]:
    """Tests that go where the training went tell nothing about other motions."""
    told = []
    for label, errors in again.items():
        if errors is not None:
            shares = " ".join(f"{100 * error:.1f}" for error in errors.values())
            told.append(
                f"{label} repeats the training motion: its errors tell how well the same motion is "
                "predicted again, and nothing about other motions; the training torque itself, "
                f"played again, errs by {shares} %"
            )
    return told
