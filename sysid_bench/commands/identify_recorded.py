"""Identification of one robot from recordings of the real one: one cell of a suite with one
[[log]]."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.commands.diagnose import check_contradictions
from sysid_bench.commands.identify import WORSE, Identify
from sysid_bench.commands.identify_result import (
    OF_CELLS,
    IdentifyResult,
    base_lines,
    cell_fields,
    feasible_entry,
    joint_lines,
    solved,
    std_lines,
    warnings_of,
)
from sysid_bench.commands.payload_text import payload_lines
from sysid_bench.commands.result import file_text, interval_text, short_names, value_text
from sysid_bench.commands.write_model import DEVIATIONS, check_files, check_output_files
from sysid_bench.errors import SHOWN, EstimationError, ModelError, UnsupportedError, WriteError
from sysid_bench.evaluation.binding_constraints import GROUPS, binding_errors
from sysid_bench.evaluation.intervals import confidence_level, level_text
from sysid_bench.evaluation.score import joint_errors
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.recorded.model_prior import MODEL
from sysid_bench.experiments.recorded.payload import payload_mass, recorded_payload
from sysid_bench.experiments.recorded.prepare import TERMS_TOO, recorded_data
from sysid_bench.experiments.recorded.process_log import ProcessedLog
from sysid_bench.experiments.recorded.source import RecordedSource, predict_log, repetition_error
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.experiments.tasks.task import find_task
from sysid_bench.identification.linear.least_squares import RMS_TORQUE
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.plugin_names import build
from sysid_bench.reporting.signal_figures import StoredTorque, torque_figure
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.signals.pipeline_choice import default_log_pipeline
from sysid_bench.types import Array, Estimate

ESTIMATOR: Final = "wls-guarded"
RECORDED: Final[Mapping[str, Any]] = {"use": "recorded"}
"""In place of the plant, excitation and simulation of a simulated experiment."""
DENOMINATOR: Final = "RMS of the measured torque, filtered as described, over the same samples"
RIGID: Final = (
    "a rigid load; friction, offsets and gains of the joints are the same with and without it"
)
LEAST_GAIN_ERROR, LARGEST_DEVIATION = 0.05, 0.2
"""Least error of a torque scale that is reported, and the largest standard deviation (shares) with
which a joint decides it."""

Prepared = ExperimentData[RecordedSource]


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class RecordedResult(IdentifyResult):
    """Identification from recordings. `training` and `tests`: {joint: rmse, rms, relative} of the
    predicted torques; `replayed`: errors of the training torque itself where a test repeats the
    training motion; `logs`: the samples used of each file, with what was found in them;
    `selection`: terms that cross-validation has added; `constraints`: those that bind, with their
    cost; `locked`: positions of joints that no log lists."""

    locked: dict[str, float]
    signals: dict[str, Any]
    denominator: str
    selection: dict[str, Any] | None
    training: dict[str, dict[str, float]]
    tests: dict[str, dict[str, dict[str, float]]]
    replayed: dict[str, Any]
    logs: list[dict[str, Any]]
    prior: dict[str, str]
    constraints: list[dict[str, Any]] | None

    def summary(self) -> str:
        """Errors and terms of the joints, base parameters, payload, model files, warnings."""
        seconds = sum(log["seconds"] for log in self.logs if log["use"] == "train")
        reason, spreads = self.prior["reason"], self.prior["spreads"]
        lines = [
            *self._opening_lines(),
            *(payload_lines(self.payload) if self.payload else ()),
            self._headline(way_on=self._way_on()),
            f"  task {self.task}, {self.estimator}: rank {self.rank} "
            f"of {self.parameters}, condition {value_text(self.condition)}",
            f"  {seconds:.1f} s of training, pipeline {self.signals['pipeline']!r}, "
            f"filter {self.signals['filter']!r}, derivatives {self.signals['derivatives']!r}; "
            f"errors in % of the {self.denominator}",
            f"  no prior: {reason}"
            if reason
            else f"  prior for methods that use one: the model file's links, {spreads}",
        ]
        if self.selection is not None:
            names = ", ".join(step["parameter"] for step in self.selection["added"]) or "nothing"
            before, after = (100 * self.selection[f"error_{key}"] for key in ("before", "after"))
            lines.append(
                f"  chosen on {self.selection['left_out']}: {names} (mean error there "
                f"{before:.1f} -> {after:.1f} %)"
            )
        lines += self._error_lines()
        lines += joint_lines(self._of_level(self.joints))
        base = self._of_level(dict(enumerate(self.base))).values()
        lines += [*base_lines([*base]), *std_lines(self.std_from, self.std_limit, self.reach)]
        lines += _constraint_lines(self.constraints) if self.constraints else ()
        lines += _written_lines(self.written) if self.written else ()
        return "\n".join(lines + self._closing_lines())

    def _way_on(self) -> str:
        """Next step: judge the answer on another motion, or write its model."""
        if not self.tests:
            errors = [one["relative"] for one in self.training.values()]
            size = np.sqrt(np.mean([error**2 for error in errors if error is not None]))
            return (
                f"Torques of the training itself err by {100 * size:.3g} %, which judges nothing: "
                "give another motion as --test"
            )
        writes = find_task(self.task).writes_model and self.model_out is None
        return "--model-out arm.urdf (or .xml) writes the model" if writes else ""

    def _judged_on(self) -> str:
        again = sum(errors is not None for errors in self.replayed.values())
        if again == 0:
            return super()._judged_on()
        if again < len(self.replayed):
            return (
                f"the tests, of which {again} of {len(self.replayed)} repeat the training motion,"
            )
        used: dict[str, set[Any]] = {"train": set(), "test": set()}
        for log in self.logs:
            used[log["use"]].add((log["log"], tuple(log["rows"] or ())))
        if used["test"] <= used["train"]:
            return "the training itself, since --test is the same recording as --log,"
        return "the training motion, which --test repeats, not of other motions,"

    def _error_lines(self) -> Iterator[str]:
        """A line for each joint, with its error on the first test, and one for each other test."""
        test = next(iter(self.tests.values()), None)
        names, left_out = short_names(self.training)
        width = max(len(f"joint{left_out}"), *map(len, names.values()))
        yield f"  joint{left_out:{width - 5}}      RMS     train" + (
            "          test" if test else ""
        )
        for joint, train in self.training.items():
            line = f"  {names[joint]:{width}} {train['rms']:8.4g}  {_error_text(train)}"
            yield line + (f"  {_error_text(test[joint])}" if test else "")
        for label, errors in list(self.tests.items())[1:]:
            yield f"  {label}: {', '.join(_error_text(joint).strip() for joint in errors.values())}"


# --- The cell -----------------------------------------------------------------------------------


def identify_recorded(request: Identify) -> RecordedResult:
    """Identify a robot from recordings.

    Raises UsageError for descriptions, files or names that cannot be used and for contradictions
    in the data that `accept` does not name, EstimationError where the method fails.
    """
    training, tests = request.recordings()
    name = request.estimator or ESTIMATOR
    method = build("estimator", name)
    manifest = find_manifest(str(request.model), request.robots_dir)
    model_out, json_out, figure = request.files
    if model_out is not None or json_out is not None:
        check_files(load_robot(manifest), request.task, model_out, json_out)
    beside = None if model_out is None else model_out.with_suffix(".toml")
    check_output_files(request.files, beside, [*training, *tests.values()])
    prepared = recorded_data(_specification(request, training, tests), manifest, Path())
    source = prepared.source
    if not isinstance(source, RecordedSource):
        raise UnsupportedError(
            f"The task {request.task!r} has a way of its own to recordings; use it in a suite."
        )
    contradictions = check_contradictions(source.recordings, request.findings)
    reason = source.prior.reason
    hint = f"The prior is absent: {reason}." if reason else ""
    estimate = solved(prepared, method, f"{name} on {manifest.name}", hint)
    assert estimate.beta is not None
    fields = cell_fields(prepared, method, estimate, OF_CELLS)
    # Costs of the constraints that bind, for the estimator `lmi` and for written models.
    is_feasible = model_out is not None or name == "lmi"
    payload = _payload(request, prepared, method, estimate, fields["bodies"])
    if payload is not None and "constraint" in payload:
        name = list(fields["bodies"])[-1]
        fields["bodies"][name] = {key: payload[key] for key in fields["bodies"][name]}
    if WORSE in request.accept:
        fields["failure"] = None
    fields |= _recorded_fields(prepared, estimate) | {
        "model": manifest.name, "file": str(manifest.path), "task": request.task,
        "estimator": name, "figure": file_text(figure),
        "payload": payload,
        "constraints": binding_errors(prepared.problem, prepared.held_out) if is_feasible else None,
    }  # fmt: skip
    warnings = [*fields.pop("warnings"), *_warnings(prepared, estimate, fields), *contradictions]
    result = RecordedResult(**fields, warnings=list(dict.fromkeys(warnings)))
    if figure is not None:
        _write_figure(figure, prepared, estimate.beta)
    if model_out is not None:
        result = _with_model(result, request, prepared, estimate, model_out)
    return result


def _write_figure(figure: Path, prepared: ExperimentData[RecordedSource], beta: Array) -> None:
    """Measured and predicted torque of the first test log, or of the training one."""
    found = predict_log(prepared, beta)
    units = tuple(kind.removeprefix("joint ") for kind in found.problem.kinds)
    rows = tuple(found.problem.rows)
    torque_figure.write(
        figure, StoredTorque("", found.t, found.measured, found.predicted, rows, units)
    )


def _specification(
    request: Identify, training: list[LogDescription], tests: dict[str, LogDescription]
) -> ExperimentSpec:
    """Experiment as a suite with one [[log]] would have it."""
    written = {"filter": request.filter, "derivatives": request.derivatives}
    signals = {key: value for key, value in written.items() if value is not None}
    return request.specification(
        plant=RECORDED, excitation=RECORDED, simulation=RECORDED, held_out=(), rate=0.0,
        prior=MODEL if request.prior is None else request.prior,
        signals=signals,
        pipeline=request.pipeline_with_default(default_log_pipeline(signals)),
        log={
            "train": training, "test": tests, "moving": request.moving, "choose": request.choose,
            "position_given": request.position_given, "accept": request.findings,
            "feasible": request.feasible or TERMS_TOO,
        },
    )  # fmt: skip


def _with_model(
    result: RecordedResult, request: Identify, prepared: Prepared, estimate: Estimate, file: Path
) -> RecordedResult:
    """The result with the written model; a WriteError holds it where the model is refused."""
    # Both engines, which read the file again, load for longer than a short recording is fitted.
    from sysid_bench.commands.recorded_model import write_recorded_model

    try:
        written = write_recorded_model(prepared, estimate, file, request.complete)
    except (EstimationError, ModelError) as error:
        raise WriteError(str(error), result) from error
    return replace(result, model_out=written.file, written=asdict(written))


# --- Fields -------------------------------------------------------------------------------------


def _recorded_fields(prepared: Prepared, estimate: Estimate) -> dict[str, Any]:
    """Fields of the logs and their processing, and errors joint by joint."""
    problem, source, beta = prepared.problem, prepared.source, estimate.beta
    assert beta is not None
    used, selection = source.builder.preprocessing, source.selection
    logs = [("train", log) for log in source.training]
    logs += [("test", log) for log in source.tests.values()]
    return {
        "terms": list(source.terms),
        "locked": dict(source.training[0].robot.manifest.locked),
        "signals": {
            "filter": used.filter, "derivatives": used.derivatives, "torque": "filtered",
            "moving": used.moving, "pipeline": used.name,
        },
        "denominator": DENOMINATOR,
        "selection": None if selection is None else {
            "added": [{"parameter": name, "error": error} for name, error in selection.added],
            "error_before": selection.error_before,
            "error_after": selection.error_after,
            "left_out": selection.parts,
        },
        "training": joint_errors(problem, beta),
        "tests": {label: joint_errors(test, beta) for label, test in prepared.held_out.items()},
        "replayed": {
            label: repetition_error(source.training, test, problem.rows)
            for label, test in source.tests.items()
        },
        "logs": [_log_fields(use, log) for use, log in logs],
        "prior": {"spreads": source.prior.text, "reason": source.prior.reason},
    }  # fmt: skip


def _log_fields(use: str, processed: ProcessedLog) -> dict[str, Any]:
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


def _payload(
    request: Identify,
    prepared: Prepared,
    method: Any,
    estimate: Estimate,
    bodies: Mapping[str, dict[str, Any]],
) -> dict[str, Any] | None:
    """Identified payload, or its mass alone where its position is given; None for other tasks."""
    if not find_task(request.task).identifies_payload:
        return None
    source, beta, problem = prepared.source, estimate.beta, prepared.problem
    assert beta is not None
    words = method, problem, source.builder, source.training, beta
    loaded = next(log for log in source.training if log.payload)
    if request.position_given:
        return asdict(payload_mass(*words)) | {"assumed": _stated_load(loaded)}
    found = recorded_payload(*words)
    (body,) = (b for b in problem.bodies if b.columns == source.builder.unknowns.payload_parameters)
    return {
        **feasible_entry(bodies[body.name], problem, body, found.feasible),
        "intervals": found.intervals,
        "confidence": confidence_level(),
        "by_joint": found.by_joint,
        "gain_std": {"from": found.scale.source or None, "std": dict(found.scale.std)},
        "assumed": RIGID,
    }


def _stated_load(log: ProcessedLog) -> str:
    """Assumed position and shape of a load of unknown mass."""
    payload, robot, written = log.payload, log.robot, log.log.description.payload
    frame = robot.manifest.tool or robot.body_names[robot.tool_body]
    keys = written if isinstance(written, Mapping) and "use" not in written else None
    place = f"at ({', '.join(f'{x:.4g}' for x in payload.com)}) m from the frame {frame}"
    if keys is not None and "com" not in keys:
        place = f"at the origin of the frame {frame}, since the log states no com"
    shape = (
        "a solid with the stated inertia for its mass" if any(payload.inertia) else "a point mass"
    )
    if keys is not None and "inertia" not in keys:
        shape = "a point mass, since the log states no inertia"
    return f"{shape}, {place}"


# --- Warnings -----------------------------------------------------------------------------------


def _warnings(prepared: Prepared, estimate: Estimate, fields: Mapping[str, Any]) -> Iterator[str]:
    """Repairs of the model, findings in the logs, doubtful torques, repeated motions, verdicts, and
    gains that a known load contradicts."""
    source = prepared.source
    yield from source.training[0].robot.repairs
    for one in source.recordings:
        yield from (f"{one.log.description.source.name}: {f.text}" for f in one.log.findings)
    yield from friction_warnings(fields["joints"])
    for label, errors in fields["replayed"].items():
        if errors is not None:
            shares = " ".join(f"{100 * error:.1f}" for error in errors.values())
            yield (
                f"{label} repeats the training motion: its errors show how well the same motion is "
                "predicted again, not how well others are; the training torque itself, played "
                f"again, errs by {shares} %"
            )
    yield from warnings_of(estimate, prepared.problem)
    stated = max(log.payload.mass for log in source.training)
    if fields["payload"] is not None and stated > 0:
        yield from _gain_warnings(fields["payload"], stated)


def friction_warnings(joints: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a sentence for joints whose torque pushes with the motion: viscous and Coulomb
    friction, where identified, are negative beyond their standard deviation, where that is known;
    `joints` as in the result."""
    pushing = []
    for name, terms in joints.items():
        friction = [terms[term] for term in ("viscous", "coulomb") if term in terms]
        if friction and all(
            term["value"] is not None and term["value"] < -DEVIATIONS * (term["std"] or 0.0)
            for term in friction
        ):
            pushing.append(name)
    if not pushing:
        return []
    return [
        f"friction is negative on {', '.join(pushing)}: the torque has the wrong sign there, or it "
        "is not the motor's."
    ]


def _gain_warnings(payload: Mapping[str, Any], stated: float) -> Iterator[str]:
    """Yield sentences on torques that give another mass than the log states (kg), those of single
    joints or those of all together."""
    if "by_joint" in payload:
        # Two joints with different gains disagree on the mass: each is compared by itself.
        wrong = [
            f"{name} {mass / stated:.3g} ± {std / stated:.1g}"
            for name, (mass, std) in payload["by_joint"].items()
            if abs(mass - stated) > max(DEVIATIONS * std, LEAST_GAIN_ERROR * stated)
            and std < LARGEST_DEVIATION * stated
        ]
        if wrong:
            yield (
                f"by the stated payload of {stated:.4g} kg, torques are these multiples of the "
                f"true ones: {', '.join(wrong)}; divide the gains of these joints by them, or "
                "correct the statement"
            )
    elif "mass" in payload["intervals"]:
        found, (low, high) = payload["mass"], payload["intervals"]["mass"][0]
        if not (low <= stated <= high or abs(found / stated - 1) < LEAST_GAIN_ERROR):
            yield (
                f"the log states a payload of {stated:.4g} kg, the torques give {found:.4g} kg "
                f"({level_text()} in {interval_text(low, high)}): if the statement is right, "
                f"torques are {found / stated:.3g} times the true ones, as with wrong drive gains"
            )


# --- Text ---------------------------------------------------------------------------------------


def _error_text(joint: Mapping[str, Any]) -> str:
    relative = joint["relative"]
    share = "     -" if relative is None else f"{100 * relative:5.1f}%"
    return f"{joint['rmse']:8.3g} {share}"


def _constraint_lines(constraints: Sequence[Mapping[str, Any]]) -> list[str]:
    """The constraints of the feasible fit that bind, with what each adds to the error."""
    texts = {c["constraint"]: f"{c['constraint']} {100 * c['cost']:+.2g}" for c in constraints}
    together = [texts.pop(name) for name in GROUPS if name in texts]
    groups = f"; together: {', '.join(together)}" if together else ""
    more = f", and {len(texts) - SHOWN} more (--json)" if len(texts) > SHOWN else ""
    listed = f"{', '.join(list(texts.values())[:SHOWN])}{more}"
    return [f"  constraints that bind, with what each adds to the error in %: {listed}{groups}"]


def _written_lines(written: Mapping[str, Any]) -> Iterator[str]:
    """Lines of the written model and of its errors when it is read again."""
    if written["refitted"]:
        origin = "a feasible fit, since no feasible bodies have exactly these base parameters"
        if written["weights"] == RMS_TORQUE:
            origin += (
                "; its rows count relative to the torque of their joint, since weights of the "
                "noise would have cost more"
            )
    elif written["completed"] is None:
        origin = "bodies of the estimator itself"
    else:
        origin = f"whole bodies nearest to the prior ({written['completed']})"
    label, errors = next(iter(written["tests"].items()), ("the training", written["training"]))
    shares = " ".join("-" if e is None else f"{100 * e:.1f}" for e in errors.values())
    ratio = written["ratio"]
    cost = "" if ratio is None else f", {ratio:.2f} x those of the estimate"
    yield f"  model: {written['file']}, its joint terms in {written['manifest']}; {origin}"
    yield (
        f"    read again in both engines (gap {written['gap']:.1e}), it predicts {label} with "
        f"errors of {shares} %{cost}"
    )
    if written["left_out"]:
        yield f"    in neither file: {', '.join(written['left_out'])}"
