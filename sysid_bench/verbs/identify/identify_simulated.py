"""Identification of one robot from its own simulation: excite, simulate, estimate, export."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from sysid_bench.commands.result import OMIT_NONE, file_text, value_text
from sysid_bench.commands.task_terms import check_terms
from sysid_bench.errors import EstimationError, ModelError, WriteError
from sysid_bench.evaluation.open_directions import open_directions
from sysid_bench.evaluation.score import score
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.loaded_robot import LoadedRobot, loaded_robot
from sysid_bench.experiments.simulated.composed_plant import ENCODERS, has_exact_positions
from sysid_bench.experiments.simulated.noise_free import unknown_terms
from sysid_bench.experiments.simulated.prepare import prepare_simulated
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.experiments.spec import ExperimentSpec, normal_noise, normal_payload
from sysid_bench.experiments.tasks.task import find_task
from sysid_bench.identification.feasibility.completion import completed_estimate
from sysid_bench.identification.identify import identify as estimate_parameters
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.models.payload import parse_payload
from sysid_bench.plugin_names import build
from sysid_bench.signals.pipeline_choice import default_pipeline, signals_of_pipeline
from sysid_bench.types import Estimate
from sysid_bench.verbs.identify.estimate_fields import (
    completion_warnings,
    estimate_fields,
    failure_of,
    open_warnings,
    warnings_of,
)
from sysid_bench.verbs.identify.exact_values import (
    exact_base,
    exact_bodies,
    exact_joints,
    exact_share,
)
from sysid_bench.verbs.identify.identify_request import IdentifyRequest, check_seed
from sysid_bench.verbs.identify.identify_result import (
    IdentifyResult,
    base_lines,
    body_lines,
    joint_line,
    std_lines,
)
from sysid_bench.verbs.identify.sensor_summary import (
    estimation_fields,
    excitation_fields,
    sensor_lines,
)
from sysid_bench.verbs.identify.write_model import check_files, write_model

HELD_OUT: Final = ({"use": "fourier-other"}, {"use": "ptp"})
FROM_ENCODERS: Final = {"filter": "butter 4 20 Hz zero-phase", "derivatives": "from q"}
IDEAL: Final = {"filter": "none", "derivatives": "exact"}
"""Signals of `plain`: rates are differentiated from the encoders once these are noisy."""
_SCORES: Final = (
    *("rank", "data_rank", "parameters", "condition", "condition_unit", "rmse_train", "rmse_test"),
    *("torque_error", "torque_error_moving", "torque_error_weighted", "feasible", "plausible"),
)
"""Scores that the result reports."""


@dataclass(frozen=True, kw_only=True)
class SimulatedRequest(IdentifyRequest):
    """Identification from simulated data: a suite's experiment with defaults elsewhere.

    `payload` (a name or a table) and `noise` ({"q": "1e-4 rad", "tau": "0.5 %"}) as in a suite;
    `free_base` overrides the robot's manifest; `contacts`: periods left out ("10 s to 25 s"), or
    "detect".
    """

    payload: str | Mapping[str, Any] = "none"
    noise: Mapping[str, Any] | None = None
    seed: int = 0
    sensor: str | None = None
    free_base: bool | None = None
    contacts: Sequence[str] | str | None = None


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedResult(IdentifyResult):
    """Identification from simulated data. `left_out`: share of the samples taken for contacts;
    `standstill`: share of the rows left out of the fit; `gap`: of the cross-check; `sensor`:
    excitation and errors behind a force/torque sensor; `exact`: where no noise is declared, power
    of ten above the largest error over the largest base parameter, if that is rounding."""

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
    torque_error_moving: float | None
    torque_error_weighted: float | None
    standstill: float
    left_out: float
    gap: float
    converged: bool | None
    iterations: int | None
    simulations: int | None
    stop: str
    std_from: str | None
    std_limit: str | None
    base: list[dict[str, Any]]
    bodies: dict[str, dict[str, Any]]
    joints: dict[str, dict[str, dict[str, Any]]]
    payload: dict[str, Any] | None
    completed: str | None
    feasible: bool | None
    plausible: bool | None
    warnings: list[str]
    sensor: dict[str, Any] | None = field(default=None, metadata=OMIT_NONE)
    model_out: str | None = field(default=None, metadata=OMIT_NONE)
    open_directions: int = 0
    failure: str | None = field(default=None, metadata=OMIT_NONE)
    exact: float | None = field(default=None, metadata=OMIT_NONE)

    def __post_init__(self) -> None:
        self._make_plain()

    def summary(self) -> str:
        """Errors, then bodies and joints with standard deviations (none where they are exact), then
        warnings."""
        lines = [
            *self._opening_lines(),
            f"{self.model}, task {self.task}, {self.estimator}: "
            f"rank {self.rank} of {self.parameters}, condition {value_text(self.condition)}",
            f"  RMSE {value_text(self.rmse_train)} in training, {value_text(self.rmse_test)} on "
            f"other motions, torque error {value_text(self.torque_error)}",
        ]
        if self.left_out:
            lines.append(f"  {self.left_out:.1%} of the samples left out as contacts")
        if self.sensor is not None:
            lines += sensor_lines(self.sensor)
        return "\n".join([*lines, *self._value_lines(), *self._closing_lines()])

    def _value_lines(self) -> list[str]:
        bodies, joints, base = self.bodies, self.joints, self.base
        meaning = std_lines(self.std_from, self.std_limit)
        if self.exact is not None:
            smallest = self.exact * max(abs(entry["value"]) for entry in base)
            bodies, joints = exact_bodies(bodies, smallest), exact_joints(joints, smallest)
            base = exact_base(base, smallest)
            meaning = [f"  exact to {self.exact:g} of the largest base parameter (no noise)"]
        terms = [joint_line(name, terms) for name, terms in joints.items()]
        return [*body_lines(bodies), *terms, *base_lines(base), *meaning, *self._completed_lines()]

    def _completed_lines(self) -> list[str]:
        """What the data did not determine of completed bodies."""
        if self.completed is None or self.parameters is None or self.rank is None:
            return []
        open_directions = self.parameters - self.rank
        if open_directions == 0:
            return []
        return [
            f"  the data determine {self.rank} of {self.parameters} directions of the parameters; "
            f"the other {open_directions} are those of the bodies nearest to the prior "
            f"({self.completed})"
        ]


def identify_simulated(request: SimulatedRequest) -> SimulatedResult:
    """Identify a robot from its own simulation.

    Raises UsageError for unknown names, ModelError for a model that cannot be used or values that
    must not be written, EstimationError where the method fails.
    """
    check_terms(request.task, request.terms)
    check_seed(request.seed)
    name = _estimator(request)
    method = build("estimator", name)
    spec = _spec(request)
    manifest = find_manifest(request.model, request.robots_dir)
    spec = replace(spec, content=manifest.content)
    robot = _checked_robot(request, spec, manifest)
    ready = prepare_simulated(spec, robot)
    estimate = estimate_parameters(method, ready.problem, ready.experiment)
    sensor = excitation_fields(ready) if ready.source.task.definition.identifies_sub_tree else None
    _check_status(estimate, f"{name} on {robot.robot.name}", _sensor_warnings(sensor))
    whole = request.complete is not None
    if request.complete is not None:
        estimate = completed_estimate(estimate, ready.problem, request.complete)
    if sensor is not None:
        sensor |= {"estimation": estimation_fields(ready, estimate)}
    result = _result(request, robot, ready, estimate, sensor)
    if request.model_out is not None:
        write = partial(write_model, robot.robot, request.task, estimate, ready.problem)
        _write(write, request.model_out, whole, result)
    return result


def _write(
    write: Callable[[Path, bool], None], file: Path, whole: bool, result: SimulatedResult
) -> None:
    """Write a model; a WriteError holds the result where it is refused."""
    try:
        write(file, whole)
    except ModelError as error:
        raise WriteError(str(error), replace(result, model_out=None)) from error


def _checked_robot(
    request: SimulatedRequest, spec: ExperimentSpec, manifest: Manifest
) -> LoadedRobot:
    """Load the robot; raise before anything runs for files or a model that cannot be used."""
    robot = _robot(request, spec, manifest)
    check_files(robot.robot, request.task, request.model_out, request.json_out)
    if not robot.check.ok():
        raise ModelError(f"{robot.robot.name}: {robot.check.reason_text()}")
    return robot


def _robot(request: SimulatedRequest, spec: ExperimentSpec, manifest: Manifest) -> LoadedRobot:
    """The robot; a named one is kept for the next call. A path may mean another file by then, in
    another working folder or after a change."""
    if manifest.content is not None:
        return LoadedRobot(load_robot(manifest, parse_payload(spec.payload), request.free_base))
    folder = file_text(request.robots_dir)
    return loaded_robot(spec.robot, spec.payload, folder, None, request.free_base)


def _check_status(estimate: Estimate, what: str, warnings: Sequence[str]) -> None:
    """Raise EstimationError with the reason of a failure, and what may have caused it."""
    if estimate.status != "ok":
        raise EstimationError(" ".join([f"{what}: {estimate.reason}", *warnings]))


def _sensor_warnings(sensor: Mapping[str, Any] | None) -> list[str]:
    """Warning about what the data behind a force/torque sensor do not excite, if any."""
    return [sensor["warning"]] if sensor and sensor["warning"] else []


def _result(
    request: SimulatedRequest,
    loaded: LoadedRobot,
    ready: ExperimentData[SimulatedSource],
    estimate: Estimate,
    sensor: dict[str, Any] | None,
) -> SimulatedResult:
    problem, source = ready.problem, ready.source
    definition = source.task.definition
    scores = score(
        estimate, problem, ready.held_out, source.truth, source.extents,
        moving=ready.held_out_moving,
    )  # fmt: skip
    fields = estimate_fields(estimate, problem, build("estimator", _estimator(request)))
    open_ones, failure = open_directions(problem), failure_of(scores.torque_error)
    first_body = next(iter(fields["bodies"].values()), None)
    return SimulatedResult(
        model=loaded.robot.name,
        file=str(loaded.robot.manifest.path),
        task=request.task,
        terms=list(unknown_terms(_spec(request), loaded.robot, definition)),
        rows=list(problem.rows),
        estimator=_estimator(request),
        **{name: getattr(scores, name) for name in _SCORES},
        **fields,
        left_out=source.left_out,
        standstill=source.standstill,
        gap=loaded.check.gap,
        payload=first_body if definition.identifies_payload else None,
        completed=request.complete,
        open_directions=open_ones.count,
        failure=failure,
        warnings=[
            *open_warnings(open_ones),
            *([failure] if failure else []),
            *loaded.robot.repairs,
            *warnings_of(estimate, problem),
            *completion_warnings(estimate, problem),
            *_sensor_warnings(sensor),
        ],
        sensor=sensor,
        model_out=file_text(request.model_out),
        exact=_exact(request, ready, estimate),
    )


def _exact(
    request: SimulatedRequest, ready: ExperimentData[SimulatedSource], estimate: Estimate
) -> float | None:
    """How exact the base parameters are; None for an estimate from noisy data."""
    if normal_noise(request.noise or {}) or estimate.beta is None:
        return None
    return exact_share(estimate.beta, ready.problem.base.K @ ready.source.truth.theta)


def _estimator(request: SimulatedRequest) -> str:
    return request.estimator or find_task(request.task).default_estimator


def _signals(noise: Mapping[str, float], contacts: Sequence[str] | str | None) -> dict[str, Any]:
    """Signal processing of `plain` that suits the noise, with the samples left out for contacts."""
    signals: dict[str, Any] = dict(FROM_ENCODERS if {*ENCODERS} & set(noise) else IDEAL)
    return signals if contacts is None else signals | {"contacts": contacts}


def _spec(request: SimulatedRequest) -> ExperimentSpec:
    """Experiment as a suite with nothing but defaults would have it."""
    noise = normal_noise(request.noise or {})
    spec = ExperimentSpec(
        seed=request.seed,
        robot=request.model,
        payload=normal_payload(request.payload),
        task=request.task,
        terms=request.terms,
        plant={"use": "matched"},
        prior={"mass": 0.2, "com": 0.015, "inertia": 0.3, "terms": 0.3},
        excitation={"use": "fourier"},
        held_out=HELD_OUT,
        simulation={"use": "inverse"},
        rate=200.0,
        noise=noise,
        signals={},
        repeat=0,
        sensor=request.sensor,
        free_base=request.free_base,
    )
    pipeline = request.pipeline_with_default(default_pipeline({}, has_exact_positions(spec)))
    signals = signals_of_pipeline(_signals(noise, request.contacts), pipeline)
    return replace(spec, signals=signals, pipeline=pipeline)
