"""Recorded experiments: read logs, preprocess them, build the problems; for `identify --log` and
for suites."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.errors import UnsupportedError, UsageError, first_names, unknown_name
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.recorded.left_out_parts import TermSelection, select_terms
from sysid_bench.experiments.recorded.model_prior import MODEL, file_theta, model_prior
from sysid_bench.experiments.recorded.problem import LogProblemBuilder, regressor_blocks
from sysid_bench.experiments.recorded.process_log import (
    LogProcessing,
    ProcessedLog,
    lock_manifest,
    process_log,
)
from sysid_bench.experiments.recorded.source import RecordedSource, floor_error
from sysid_bench.experiments.recorded.unknowns import Unknowns, check_wrench, unknowns_of
from sysid_bench.experiments.simulated.problem import SimulatedModel
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.experiments.tasks.task import find_task
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import DRIVE_TERMS, Manifest
from sysid_bench.models.robot import SUFFIX
from sysid_bench.plugin_names import resolve_files
from sysid_bench.signals.log_checks import check_findings
from sysid_bench.signals.log_description import (
    LogDescription,
    log_description,
    name_of,
    with_controller,
)
from sysid_bench.signals.pipeline_choice import PLAIN, pipeline_of
from sysid_bench.signals.processing import processing_of
from sysid_bench.signals.row_processing import MOVING
from sysid_bench.simulation.candidate import Candidate, KnownModel, kinematics_of
from sysid_bench.simulation.forward_steps import ForwardModel
from sysid_bench.types import Array, Experiment, Problem, Recording, Trajectory
from sysid_bench.units import quantity

if TYPE_CHECKING:
    from sysid_bench.experiments.loaded_robot import LoadedRobot  # loads the engines


FILTER: Final = "butter 4 10 Hz zero-phase"
"""Robots move below it: on a UR10e, cut-offs of 3 to 20 Hz changed the error by less than 0.3 of
7.5 % (measured)."""

SLOW: Final = 30.0
"""Hz; at lower rates that filter would distort the motion itself, and is left out."""

TERMS_TOO, BODIES_ALONE = "terms", "bodies"
"""Constraints of feasible fits: friction and rotor inertia as well, or bodies alone."""


@dataclass(frozen=True)
class LogOptions:
    """`terms` None: the robot's own. `filter` None: FILTER, or none at low rates. `derivatives`
    None: from v where every log has v. `moving`: rows slower than this (rad/s, m/s) are left out.
    `pipeline` {use, settings} of the training logs, its file below `folder`; None: plain filtering.
    `candidates`, `position_given`: see `build_problems`. `prior`: "model" (the file's inertias
    where they are plausible), "none", or spreads. `accept`: contradictions that may pass.
    `feasible`: "terms", friction and rotor inertia are not negative in feasible fits, or "bodies"
    alone. `true_mass`: kg, of the payload on a scale. `sensor`: the one whose wrench is used alone;
    None: the only one of the logs."""

    task: str = "robot"
    terms: tuple[str, ...] | None = None
    filter: str | None = None
    derivatives: str | None = None
    moving: float = 0.0
    candidates: tuple[str, ...] = ()
    position_given: bool = False
    accept: tuple[str, ...] = ()
    true_mass: float | None = None
    pipeline: Mapping[str, Any] | None = None
    folder: Path | None = None
    prior: str | Mapping[str, Any] = MODEL
    feasible: str = TERMS_TOO
    sensor: str | None = None


def prepare_recorded(spec: ExperimentSpec, loaded: "LoadedRobot") -> ExperimentData[Any]:
    """The recorded experiment of a specification; files are found from the suite's folder.

    Raises UnsupportedError or UsageError where there is none, with the reason.
    """
    return recorded_data(spec, loaded.robot.manifest, loaded.folder or Path())


def recorded_data(spec: ExperimentSpec, manifest: Manifest, folder: Path) -> ExperimentData[Any]:
    """The same of a robot that is not loaded; logs may be descriptions of numbers in memory, and
    tests a mapping by name."""
    assert spec.log is not None
    mass = spec.log.get("true_mass")
    options = LogOptions(
        task=str(resolve_files({"use": spec.task}, folder)["use"]),
        terms=spec.terms,
        filter=spec.signals.get("filter"),
        derivatives=spec.signals.get("derivatives"),
        moving=float(spec.log["moving"]),
        candidates=tuple(spec.log["choose"]),
        position_given=bool(spec.log["position_given"]),
        accept=tuple(spec.log["accept"]),
        true_mass=None if mass is None else quantity(mass, "kg"),
        pipeline=spec.pipeline,
        prior=spec.prior,
        feasible=str(spec.log.get("feasible", TERMS_TOO)),
        folder=folder,
        sensor=spec.sensor,
    )
    given = spec.log.get("controller")
    training = [
        with_controller(log_description(written, folder), given) for written in spec.log["train"]
    ]
    written = spec.log["test"]
    if isinstance(written, Mapping):
        tests = {name: log_description(one, folder) for name, one in written.items()}
    else:  # names that occur more than once are numbered
        names = [name_of(one) for one in written]
        tests = {
            name if names.count(name) == 1 else f"{name} {k + 1}": log_description(one, folder)
            for k, (name, one) in enumerate(zip(names, written, strict=True))
        }
    prepared = find_task(options.task).prepare_recordings(
        manifest, training, tests, options.accept, options.prior
    )
    return prepared or prepare_recordings(manifest, training, tests, options)


def prepare_recordings(
    manifest: Manifest,
    training: Sequence[LogDescription],
    tests: Mapping[str, LogDescription],
    options: LogOptions,
) -> ExperimentData[RecordedSource]:
    """The problems of training and test logs, with those joints locked that no log lists.

    Raises UsageError for invalid files or names, and for contradictions in the data that
    `options.accept` does not name.
    """
    descriptions = [*training, *tests.values()]
    manifest = lock_manifest(manifest, load_robot(manifest), descriptions)
    preprocessing = _preprocessing(descriptions, options)
    fits = [process_log(log, manifest, preprocessing, training=True) for log in training]
    judged = [process_log(log, manifest, preprocessing, training=False) for log in tests.values()]
    logs = [*fits, *judged]
    for log in logs:
        check_findings(log.log.findings, options.accept, str(log.log.description.source))
    return build_problems(fits, dict(zip(tests, judged, strict=True)), preprocessing, options)


def build_problems(
    training: Sequence[ProcessedLog],
    tests: Mapping[str, ProcessedLog],
    preprocessing: LogProcessing,
    options: LogOptions,
) -> ExperimentData[RecordedSource]:
    """The problem of all training logs together, and one of each test log.

    Task `robot`: links and terms, with the payloads that the logs state taken as known. `payload`:
    the same and ten more of the payload that some logs state and others do not carry. `terms`:
    joint terms, and those of motors ("motor.armature"). `candidates`: more of them, and features by
    name ("play", "motor.play"), of which cross-validation within the training logs selects.
    `position_given`: of the payload the mass alone is unknown; its centre of mass and its inertia
    per mass are known from the logs.
    """
    if options.feasible not in (TERMS_TOO, BODIES_ALONE):
        raise unknown_name("choice of feasibility", options.feasible, (TERMS_TOO, BODIES_ALONE))
    terms, unknowns, selection = _unknowns(training, tests, preprocessing, options)
    base = unknowns.base()
    builder = LogProblemBuilder(unknowns, base.names, preprocessing)
    built = builder.build(training, base)
    built = replace(built, file=file_theta(unknowns, built))
    prior = model_prior(options.prior, unknowns, built, training)
    problem = prior.apply(built)
    if options.feasible == BODIES_ALONE:
        problem = replace(problem, signed=())
    source = RecordedSource(
        builder=builder,
        training=tuple(training),
        tests=dict(tests),
        terms=terms,
        selection=selection,
        true_mass=options.true_mass,
        prior=prior,
    )
    held_out = {name: builder.build([test], base) for name, test in tests.items()}
    moving = {
        name: builder.build([replace(test, rows=MOVING)], base) for name, test in tests.items()
    }
    experiment = _experiment(problem, builder, training[0])
    return ExperimentData(
        unknowns.robot, problem, experiment, held_out, source, moving,
        floor=floor_error(training, tests, held_out),
    )  # fmt: skip


def _unknowns(
    training: Sequence[ProcessedLog],
    tests: Mapping[str, ProcessedLog],
    preprocessing: LogProcessing,
    options: LogOptions,
) -> tuple[tuple[str, ...], Unknowns, TermSelection | None]:
    """The terms, the unknowns with the selected candidates, and how these were selected."""
    terms = _terms(training[0], options)
    unknowns = unknowns_of(options.task, terms, training, options.position_given, options.sensor)
    check_wrench(tests.values(), () if unknowns.sub_tree is None else unknowns.sub_tree.cuts)
    if not options.candidates:
        return terms, unknowns, None
    return terms, *select_terms(unknowns, options.candidates, training, preprocessing)


def _experiment(problem: Problem, builder: LogProblemBuilder, first: ProcessedLog) -> Experiment:
    """The problem, and the functions that methods may call: the regressor, the known torque, and
    the closed loop where the log declares its controller."""
    unknowns, robot = builder.unknowns, first.robot
    simulate: Callable[..., Recording]
    forward: ForwardModel | None = None
    if first.log.recording.controller is not None and unknowns.extra:
        simulate = partial(_refuse, unknowns.extra)
    else:
        given = np.zeros_like(robot.phi)
        if robot.payload_body is not None and unknowns.loaded is None:
            given[robot.payload_body] = robot.phi[robot.payload_body]
        links, none = robot.tree.link_parameters(given), np.zeros((robot.nv, robot.nv))
        model = KnownModel(
            kinematics_of(robot), unknowns.parameters, unknowns.bodies, links, {}, none
        )
        simulate = SimulatedModel(model, first.log.recording, Candidate())
        forward = ForwardModel(model, problem.base.pivots)
    return Experiment(
        problem=problem,
        recording=first.recording,
        raw=first.log.recording,
        regress=partial(regressor_blocks, builder),
        simulate=simulate,
        known=partial(_known_torque, builder, first),
        filter_rows=builder.rows_along(first).processed,
        moving=builder.rows_along(replace(first, rows=MOVING)).weights > 0.0,
        forward=forward,
    )


def _known_torque(builder: LogProblemBuilder, first: ProcessedLog, motion: Trajectory) -> Array:
    """Torque (n, rows) of the payload of the first log along a motion, where it is known."""
    known, unknowns = builder.known(first, motion), builder.unknowns
    if known is None:
        return np.zeros((len(motion), len(unknowns.rows)))
    measured = unknowns.instruments(first.robot).measured
    return known[:, [measured.index(row) for row in unknowns.rows]]


def _refuse(features: tuple[str, ...], *_: Any) -> Recording:
    """Raise UnsupportedError: simulated joints have the terms in SUFFIX alone."""
    raise UnsupportedError(
        f"The closed loop cannot be simulated with {first_names(features)}: give --terms of joints "
        f"alone ({', '.join(SUFFIX)})."
    )


def log_files(log: Mapping[str, Any], folder: Path) -> list[Path]:
    """Descriptions and recordings that an experiment reads; of a description that cannot be read
    only the path where it should be."""
    found: list[Path] = []
    for written in (*log["train"], *log["test"]):
        try:
            description = log_description(written, folder)
            found += [description.source, *description.files]
        except UsageError:  # reported when the cell runs
            use = written if isinstance(written, str) else str(written.get("use", "log"))
            found.append(folder / use)
    return found


def _preprocessing(logs: Sequence[LogDescription], options: LogOptions) -> LogProcessing:
    slowest = min((log.rate for log in logs if log.rate is not None), default=np.inf)
    filters = options.filter or (FILTER if slowest > SLOW else "none")
    # With measured velocities q is differentiated once less.
    derivatives = options.derivatives or (
        "from v" if all(log.v is not None for log in logs) else "from q"
    )
    signals = {"filter": filters, "derivatives": derivatives}
    pipeline = pipeline_of(options.pipeline, signals, options.folder)
    return LogProcessing(
        processing_of(signals), pipeline, options.moving, filters, derivatives,
        PLAIN if options.pipeline is None else str(options.pipeline["use"]),
    )  # fmt: skip


def _terms(log: ProcessedLog, options: LogOptions) -> tuple[str, ...]:
    """The terms of the options, else the manifest's without those of locked joints; where it names
    none, DRIVE_TERMS."""
    if options.terms is not None:
        return options.terms
    if find_task(options.task).measures_sensor_only:
        return ()
    of_joints = tuple(f"{row}." for row in log.robot.rows)
    terms = log.robot.manifest.terms
    return tuple(t for t in terms if "." not in t or t.startswith(of_joints)) or DRIVE_TERMS
