"""Identification of one robot from its own simulation: one cell of a suite that leaves everything
else at its default."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final

import numpy as np

from sysid_bench.commands.identify import Identify
from sysid_bench.commands.identify_result import (
    OF_CELLS,
    IdentifyResult,
    base_lines,
    body_lines,
    cell_fields,
    feasible_entry,
    joint_lines,
    solved,
    std_lines,
    warnings_of,
)
from sysid_bench.commands.payload_text import constraint_lines
from sysid_bench.commands.result import OMIT_NONE, file_text, value_text
from sysid_bench.commands.sensor_certificate import certificate_fields, certificate_lines
from sysid_bench.commands.task_terms import check_terms
from sysid_bench.commands.values import check_seed
from sysid_bench.commands.write_model import check_files, check_output_files, format_of, write_model
from sysid_bench.errors import ModelError, WriteError, first_names
from sysid_bench.evaluation.feasible_body import feasible_body
from sysid_bench.evaluation.second_engine import WITHOUT
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.loaded_robot import LoadedRobot, loaded_robot
from sysid_bench.experiments.simulated.composed_plant import ENCODERS, has_exact_positions
from sysid_bench.experiments.simulated.noise_free import unknown_terms
from sysid_bench.experiments.simulated.prepare import prepare_simulated
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.experiments.tasks.task import find_task
from sysid_bench.identification.feasibility.completion import completed_estimate
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.model_record import seed_content
from sysid_bench.models.payload import parse_payload
from sysid_bench.models.robot import SUFFIX
from sysid_bench.plugin_names import build
from sysid_bench.signals.pipeline_choice import default_pipeline, signals_of_pipeline
from sysid_bench.types import Array, Estimate

FROM_ENCODERS: Final = {"filter": "butter 4 20 Hz zero-phase", "derivatives": "from q"}
IDEAL: Final = {"filter": "none", "derivatives": "exact"}
"""Signals of `plain`: rates are differentiated from the encoders once these are noisy."""
LARGEST: Final = 1e-9
"""Largest error, over the largest base parameter, that counts as rounding."""
SMALLEST: Final = 1e-15


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class SimulatedResult(IdentifyResult):
    """Identification from simulated data. `completed`: distance to the prior in which whole bodies
    were chosen; `sensor`: excitation and errors behind a force/torque sensor; `exact`: where no
    noise is declared, power of ten above the largest error over the largest base parameter, if
    that is rounding."""

    completed: str | None
    sensor: dict[str, Any] | None = field(default=None, metadata=OMIT_NONE)
    exact: float | None = field(default=None, metadata=OMIT_NONE)

    def summary(self) -> str:
        """Errors, then bodies and joints with standard deviations (none where they are exact), then
        warnings."""
        known = ""
        if self.exact is not None:
            known = f"all {self.rank} base parameters are exact to {self.exact:g} of the largest"
        lines = [
            *self._opening_lines(),
            self._headline(known),
            f"  task {self.task}, {self.estimator}: "
            f"rank {self.rank} of {self.parameters}, condition {value_text(self.condition)}; "
            f"RMSE {value_text(self.rmse_train)} in training, {value_text(self.rmse_test)} on "
            "other motions",
        ]
        if self.left_out:
            lines.append(f"  {self.left_out:.1%} of the samples left out as contacts")
        if self.sensor is not None:
            lines += _sensor_lines(self.sensor)
        bodies, joints = self._of_level(self.bodies), self._of_level(self.joints)
        base = list(self._of_level(dict(enumerate(self.base))).values())
        meaning = list(std_lines(self.std_from, self.std_limit, self.reach))
        if self.exact is not None:
            smallest = self.exact * max(abs(entry["value"]) for entry in base)
            bodies = {name: _exact_body(body, smallest) for name, body in bodies.items()}
            joints = {name: _exact(terms, smallest) for name, terms in joints.items()}
            base = list(_exact(dict(enumerate(base)), smallest).values())
            meaning = []
        lines += body_lines(bodies)
        lines += constraint_lines(self.payload["constraint"]) if self.payload else ()
        lines += joint_lines(joints)
        lines += [*base_lines(base), *meaning]
        if self.completed is not None and self.parameters > self.rank:
            lines.append(
                f"  the data determine {self.rank} of {self.parameters} directions of the "
                f"parameters; the other {self.parameters - self.rank} are those of the bodies "
                f"nearest to the prior ({self.completed})"
            )
        return "\n".join([*lines, *self._closing_lines()])


def _exact(entries: Mapping[Any, Any], smallest: float) -> dict[Any, Any]:
    """Base parameters or joint terms without deviations; values up to `smallest` are 0."""
    return {
        key: {**entry, "value": _zeroed(entry["value"], smallest), "std": None}
        for key, entry in entries.items()
    }


def _exact_body(body: Mapping[str, Any], smallest: float) -> dict[str, Any]:
    """The same of a body."""
    values = {key: _zeroed(value, smallest) for key, value in body["parameters"].items()}
    return {**body, "parameters": values, "std": dict.fromkeys(body["std"])}


def _zeroed(value: float | None, smallest: float) -> float | None:
    return 0.0 if value is not None and abs(value) <= smallest else value


# --- The cell -----------------------------------------------------------------------------------


def identify_simulated(request: Identify) -> SimulatedResult:
    """Identify a robot from its own simulation.

    Raises UsageError for unknown names, ModelError for a model that cannot be used or values that
    must not be written, EstimationError where the method fails.
    """
    check_terms(request.task, request.terms)
    check_seed(request.seed)
    name = _estimator(request)
    method = build("estimator", name)
    loaded, spec = _robot(request, _specification(request))
    robot, (model_out, json_out, _) = loaded.robot, request.files
    check_files(robot, request.task, model_out, json_out)
    other = model_out is not None and format_of(model_out) != robot.format
    beside = model_out.with_suffix(".toml") if model_out is not None and other else None
    check_output_files(request.files, beside, [])
    # As in a suite: a robot on which the engines differ makes no data.
    if not loaded.check.ok():
        raise ModelError(f"{robot.name}: {loaded.check.reason_text()}")
    prepared = prepare_simulated(spec, loaded)
    estimate = solved(prepared, method, f"{name} on {robot.name}", prepared.source.warning)
    if request.complete is not None:
        estimate = completed_estimate(estimate, prepared.problem, request.complete)
    result = _result(request, spec, loaded, prepared, estimate)
    if model_out is not None:
        whole = request.complete is not None
        std = {
            f"{joint}.{SUFFIX[term]}": entry["std"]
            for joint, terms in result.joints.items()
            for term, entry in terms.items()
            if term in SUFFIX
        }
        try:
            bound = write_model(
                robot, request.task, estimate, prepared.problem, model_out, whole=whole, std=std
            )
        except ModelError as error:
            raise WriteError(str(error), replace(result, model_out=None)) from error
    notes = []
    if model_out is not None and bound:
        notes.append(
            f"{model_out} has {first_names(bound)} as 0, the bound of friction and rotor inertia: "
            "within their deviations they are not negative"
        )
    if beside is not None:
        notes.append(
            f"{model_out} has bodies, joints and friction, without shapes and actuators; what its "
            f"format has no place for stands in {beside}, which is the file to load"
        )
    return replace(result, warnings=[*result.warnings, *notes]) if notes else result


def _estimator(request: Identify) -> str:
    return request.estimator or find_task(request.task).default_estimator


def _result(
    request: Identify,
    spec: ExperimentSpec,
    loaded: LoadedRobot,
    prepared: ExperimentData[SimulatedSource],
    estimate: Estimate,
) -> SimulatedResult:
    """The row of the cell, the estimate, and what a sensor sees."""
    robot, problem, source = loaded.robot, prepared.problem, prepared.source
    method = build("estimator", _estimator(request))
    reported = (*OF_CELLS, "left_out", "gap", "plausible")
    fields = cell_fields(prepared, method, estimate, reported, {"gap": loaded.check.gap})
    own = [*robot.repairs, *warnings_of(estimate, problem), *filter(None, [source.warning])]
    own += [] if loaded.check.engine == "pinocchio" else [WITHOUT]
    sensor = None
    if source.task.definition.identifies_sub_tree:
        test = source.contact_test
        errors = None if test is None else test.errors(problem, source.truth, estimate)
        # RMS errors with true, CAD and identified parameters on a held-out motion.
        found = None if errors is None else {key: asdict(one) for key, one in errors.items()}
        sensor = _sensor_fields(prepared) | {"estimation": found}
    is_payload = source.task.definition.identifies_payload
    warnings, payload = fields.pop("warnings"), None
    assert estimate.beta is not None
    if is_payload:
        body = problem.bodies[0]
        entry = fields["bodies"][body.name]
        feasible = feasible_body(problem, estimate.beta, body)
        payload = feasible_entry(entry, problem, body, feasible)
        fields["bodies"][body.name] = {key: payload[key] for key in entry}
    exact = _rounding(estimate.beta, problem.base.K @ source.truth.theta)
    if not spec.noise and exact is None:
        own = [*_inexact_text(fields["scores"], method), *own]
    return SimulatedResult(
        **fields,
        model=robot.name,
        file=str(robot.manifest.path),
        task=request.task,
        terms=list(unknown_terms(spec, robot, source.task.definition)),
        estimator=_estimator(request),
        payload=payload,
        completed=request.complete,
        warnings=[*warnings, *own],
        sensor=sensor,
        model_out=file_text(request.model_out),
        exact=None if spec.noise else exact,
    )


def _specification(request: Identify) -> ExperimentSpec:
    """Experiment as a suite with nothing but defaults would have it."""
    spec = request.specification(
        plant={"use": "matched"},
        prior={"mass": 0.2, "com": 0.015, "inertia": 0.3, "terms": 0.3},
        excitation={"use": "fourier"},
        held_out=({"use": "fourier-other"}, {"use": "ptp"}),
        simulation={"use": "inverse"},
        rate=200.0,
        signals={},
    )
    pipeline = request.pipeline_with_default(default_pipeline({}, has_exact_positions(spec)))
    signals: dict[str, Any] = dict(FROM_ENCODERS if {*ENCODERS} & set(spec.noise) else IDEAL)
    if request.contacts is not None:
        signals["contacts"] = request.contacts
    return replace(spec, signals=signals_of_pipeline(signals, pipeline), pipeline=pipeline)


def _robot(request: Identify, spec: ExperimentSpec) -> tuple[LoadedRobot, ExperimentSpec]:
    """The robot, and the specification whose seeds depend on its content. A named robot is kept for
    the next call; a path may mean another file by then, in another working folder or after a
    change."""
    manifest = find_manifest(str(request.model), request.robots_dir)
    if manifest.by_path:
        robot = load_robot(manifest, parse_payload(spec.payload), request.free_base)
        return LoadedRobot(robot), replace(spec, content=seed_content(manifest, request.free_base))
    folder = file_text(request.robots_dir)
    return loaded_robot(spec.robot, spec.payload, folder, None, request.free_base), spec


def _inexact_text(scores: Mapping[str, Any], method: Any) -> list[str]:
    """Reason for which an answer to exact data has a larger error than rounding; none where its
    torques do not show it."""
    error = scores["torque_error"]
    if error is None or error <= LARGEST:
        return []
    cause = f"the method: {bias}" if (bias := getattr(method, "bias", "")) else "rounding"
    if scores["near_degenerate"] and not bias:
        cause = "the directions that the rank rule drops are in the data and in no base parameter"
    elif scores["condition"] and not bias:
        cause = f"the condition number {scores['condition']:.1e} magnifies rounding"
    return [f"the data are exact, and the torque error is {error:.1e}: {cause}"]


def _rounding(beta: Array, beta_true: Array) -> float | None:
    """Power of ten above max |beta - beta*| / max |beta*|; None where that is not rounding."""
    scale = np.abs(beta_true).max(initial=0.0)
    share = float(np.abs(beta - beta_true).max(initial=0.0) / scale) if scale > 0 else math.inf
    if not share <= LARGEST:
        return None
    return float(f"1e{math.ceil(math.log10(max(share, SMALLEST)))}")


# --- Behind a force/torque sensor ---------------------------------------------------------------


def _sensor_fields(prepared: ExperimentData[SimulatedSource]) -> dict[str, Any]:
    """Sensor, bodies of its sub-tree, structural and excited rank, the drives whose torque can and
    cannot be predicted from its data, the same of components of the wrench, and the certificate."""
    cut, excitation = prepared.source.task.cuts[0], prepared.source.excitation
    assert excitation is not None
    return {
        "name": cut.name,
        "at": cut.at,
        "bodies": [prepared.robot.body_names[b] for b in cut.bodies],
        "ends_at": list(cut.end_sensors),
        "structural_rank": excitation.structural,
        "excited_rank": excitation.rank,
        "predictable": list(excitation.predictable),
        "unpredictable": list(excitation.unpredictable),
        "missing": dict(excitation.missing),
        "unpredictable_wrench": list(excitation.unpredictable_wrench),
        "missing_wrench": dict(excitation.missing_wrench),
        "certificate": certificate_fields(prepared.robot, cut),
        "warning": excitation.warning,
    }


def _sensor_lines(sensor: Mapping[str, Any]) -> Iterator[str]:
    """Ranks, certificate, what these data predict, and the errors of estimation (N m, N)."""
    yield (
        f"  sensor {sensor['name']} at {sensor['at']}: {len(sensor['bodies'])} bodies behind it, "
        f"{sensor['excited_rank']} of {sensor['structural_rank']} base parameters excited"
    )
    yield from certificate_lines(sensor["certificate"])
    groups = {
        "predictable from these data: torques of": sensor["predictable"],
        "not predictable from these data: torques of": sensor["unpredictable"],
        "not predictable from these data: components": sensor["unpredictable_wrench"],
    }
    for text, names in groups.items():
        yield f"    {text} {', '.join(names) or 'none'}"
    for name, errors in (sensor["estimation"] or {}).items():
        parts = [
            f"{label} {errors[key]:.3g} {unit} (without the sensor {errors[f'{key}_alone']:.3g})"
            for label, key, unit in (("torque", "torque", "N m"), ("slides", "slide", "N"))
            if errors[key] is not None
        ]
        parts.append(f"touch {errors['force']:.3g} N and {errors['moment']:.3g} N m")
        yield f"    {name}: {', '.join(parts)}"
