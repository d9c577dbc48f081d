"""Identification tasks: which parameters of a robot are unknown, and which are given."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from sysid_bench import plugin_names
from sysid_bench.errors import UsageError
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import SensorSubtree
from sysid_bench.plugin_names import known
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.spatial import inertia_transform, matrix_of_quaternion
from sysid_bench.types import Array, Body, Truth
from sysid_bench.words import MOTOR


def words_of_features(words: Sequence[str], robot: RobotModel) -> tuple[str, ...]:
    """Return those words that name features: of all joints ("tanh"), of one joint ("j2.poly",
    "j2.file:mine.py:Spring") or of motors ("motor.play"), not joint terms ("viscous", "j2.k")."""
    found = []
    for word in words:
        joint = joint_of(word, robot.rows)
        name = word.removeprefix(f"{joint}.") if joint else word
        is_term = word in SUFFIX or word in robot.term_names
        if word.startswith(f"{MOTOR}.") or (not is_term and (":" in name or name in known("term"))):
            found.append(word)
    return tuple(found)


def joint_of(word: str, rows: Sequence[str]) -> str:
    """Return the joint that a word begins with, empty where there is none; the longest, since names
    may contain dots."""
    return max((row for row in rows if word.startswith(f"{row}.")), key=len, default="")


Terms = tuple[str, ...]
"""Words of joint terms, as "viscous", "j2.k", "offset"."""

SensorOffset = Callable[[int], Array]
"""Number of force/torque sensors n -> their true constants (6 n,) in N m and N."""


@runtime_checkable
class TaskDefinition(Protocol):
    """Base class of tasks: attributes that declare what a task supports, and its unknowns.

    A subclass is a frozen dataclass; the first line of its docstring is its title. Registered in
    `plugin_names.BUILTIN`, by an entry point of the group `sysid_bench.tasks`, or named directly as
    "module:Class" or "file:mine.py:Class".
    """

    name: ClassVar[str] = ""
    """Name in messages; the class name where it is empty."""
    accepts_terms: ClassVar[bool] = False
    """Joint terms, or constants of sensors, can be unknown. Otherwise all of them are given."""
    default_estimator: ClassVar[str] = "ols"
    """Estimator of the command `identify` where none is named."""
    identifies_whole_robot: ClassVar[bool] = False
    """All bodies are unknown, with the joint terms of the robot's manifest by default."""
    identifies_payload: ClassVar[bool] = False
    """The payload is unknown; its parameters are those of the last body."""
    identifies_sub_tree: ClassVar[bool] = False
    """All bodies distal to one force/torque sensor are unknown: the excitation of that sub-tree,
    contact estimation and on-line curves are reported."""
    commands: ClassVar[Mapping[str, str]] = {}
    """By verb (identify with recordings, excite, diagnose) the "module:function" that runs in its
    place, where an application has its own way to this task."""
    lumps_welded_bodies: ClassVar[bool] = False
    """The one unknown body stands for all bodies that are welded to it."""
    measures_sensor_only: ClassVar[bool] = False
    """The data are the wrench of a force/torque sensor, without joint torques."""
    writes_model: ClassVar[bool] = True
    """Estimates can be written into the model file of the robot."""
    supports_runs_without_payload: ClassVar[bool] = False
    """Recordings without the payload (`signals.runs` with A) reveal the unknowns."""
    supports_recordings: ClassVar[bool] = False
    """Recordings of a real robot can be used: with all bodies unknown, and the payload besides
    where `identifies_payload`; with the wrench of a sensor, where `measures_sensor_only`."""

    def default_terms(self, robot: RobotModel) -> tuple[str, ...]:
        """Terms that are unknown where the user names none; features, which only recordings have,
        are left out."""
        if not self.identifies_whole_robot:
            return ()
        features = words_of_features(robot.manifest.terms, robot)
        return tuple(term for term in robot.manifest.terms if term not in features)

    def unknowns(
        self, robot: RobotModel, terms: Terms, sensor: str | None, offset: SensorOffset | None
    ) -> "Task":
        """Pose the task for a robot; `terms`, `sensor` and `offset` as in `task_of`. Raises
        UnsupportedError for a robot without such unknowns."""
        ...

    def prepare_recordings(
        self,
        manifest: Manifest,
        training: Sequence[LogDescription],
        tests: Mapping[str, LogDescription],
        accept: Sequence[str],
        prior: str | Mapping[str, Any],
    ) -> ExperimentData[Any] | None:
        """Return the problems of recordings where the task has its own way to them and its own
        scores; None: rigid bodies and joint terms, as `recorded/prepare.py` builds them.

        `tests` by name; `accept`: findings in the logs that may pass; `prior` as the suite states
        it. Raises UsageError for files, names and contradictions in the data.
        """
        return None


@dataclass(frozen=True, eq=False)
class Task:
    """Unknowns and given parts of one robot. `truth` holds the p unknowns; `known_links`
    (n_links, 10), `known_terms` (by term, (nv,)) and `known_coupling` (nv, nv), the viscous one,
    are the parameters that methods are given, zero where a parameter is unknown."""

    definition: TaskDefinition
    bodies: tuple[Body, ...]
    truth: Truth
    known_links: Array
    known_terms: dict[str, Array]
    rows: tuple[str, ...] | None = None
    """Names of the degrees of freedom whose torque is measured, or of a sensor's six components;
    None: all degrees of freedom."""
    cuts: tuple[SensorSubtree, ...] = ()
    """The force/torque sensors in use. Where one is measured alone, the sensors that end its
    sub-tree follow it."""
    known_coupling: Array | None = None

    @property
    def name(self) -> str:
        """Name of the task in messages."""
        return self.definition.name or type(self.definition).__name__

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the unknowns (p,)."""
        return self.truth.parameters

    @property
    def end_sensors(self) -> tuple[SensorSubtree, ...]:
        """The sensors whose wrench is subtracted from that of the first."""
        return self.cuts[1:] if self.definition.measures_sensor_only else ()

    @property
    def has_known_part(self) -> bool:
        """True if the torque of given parameters has to be subtracted from the measured one."""
        terms = (*self.known_terms.values(), self.known_coupling)
        return bool(self.known_links.any() or any(v is not None and v.any() for v in terms))


def find_task(name: str, folder: Path | None = None) -> TaskDefinition:
    """Return the task of a name: built in, "module:Class" or "file:mine.py:Class"; relative files
    are found from `folder`, else from the working directory. Raises UsageError with the names."""
    definition = plugin_names.build("task", plugin_names.resolve_files({"use": name}, folder))
    if not isinstance(definition, TaskDefinition):
        raise UsageError(
            f"{name!r} is not a task: derive the class from "
            f"{TaskDefinition.__module__}.{TaskDefinition.__name__}; built in are "
            f"{', '.join(plugin_names.known('task'))}."
        )
    return definition


def task_names_with_terms() -> tuple[str, ...]:
    """Return the names of the built-in tasks that accept terms."""
    return tuple(name for name in plugin_names.BUILTIN["task"] if find_task(name).accepts_terms)


def task_of(
    robot: RobotModel,
    name: str,
    terms: Terms,
    sensor: str | None = None,
    offset: SensorOffset | None = None,
) -> Task:
    """Pose the task `name` for a robot.

    `terms`: joint terms that are unknown besides the bodies; for sensors "offset" alone, whose
    true values `offset` gives. `sensor`: a name of the manifest or a place to cut at; several:
    "left, right". Raises UsageError for an unknown name, UnsupportedError for a robot without such
    unknowns.
    """
    return find_task(name).unknowns(robot, terms, sensor, offset)


def joint_torque_task(
    definition: TaskDefinition,
    robot: RobotModel,
    bodies: tuple[Body, ...],
    phi: Array,
    given: Array,
    terms: Terms = (),
    rows: tuple[str, ...] | None = None,
) -> Task:
    """Build a task on joint torques: `bodies` with true parameters `phi` (n, 10) and the joint
    `terms` are unknown; `given` (nb, 10), zero for unknown bodies, and all other joint terms are
    known."""
    columns = robot.term_columns(terms)
    parameters = columns_of(bodies) + columns
    theta = np.concatenate([phi.ravel(), robot.term_values(columns)])
    known_terms = {term: getattr(robot.joint_terms, term).copy() for term in SUFFIX}
    coupling = robot.joint_terms.viscous_coupling.copy()
    for name in columns:
        term, dof, other = robot.resolve_term(name)
        # Friction between two joints is an entry of a matrix, all other terms are diagonal.
        if other is None:
            known_terms[term][dof] = 0.0
        else:
            coupling[dof, other] = 0.0
    truth, known_links = Truth(parameters, theta), robot.tree.link_parameters(given)
    return Task(
        definition, bodies, truth, known_links, known_terms, rows=rows, known_coupling=coupling
    )


def columns_of(bodies: Iterable[Body]) -> tuple[str, ...]:
    """Return the names of the inertial parameters of bodies, ten each."""
    return tuple(column for body in bodies for column in body.columns)


def unknown_bodies(robot: RobotModel) -> tuple[Body, ...]:
    """Return the bodies of the robot itself, without the payload and without those that the
    manifest calls massless, whose parameters are those of the model file."""
    payload = None if robot.payload_body is None else robot.body_names[robot.payload_body]
    known = {payload, *robot.manifest.massless}
    return tuple(body for body in robot.bodies if body.name not in known)


def phi_with_payload(robot: RobotModel) -> Array:
    """Return phi (nb, 10) with the payload added to the body that carries it, in that body's
    frame; the payload's own row remains."""
    phi = robot.phi.copy()
    if robot.payload_body is not None:
        b = robot.payload_body + 1  # MuJoCo counts the world as body 0
        R = matrix_of_quaternion(np.array(robot.mj.body_quat[b]))
        phi[robot.tool_body] += (
            inertia_transform(R, np.array(robot.mj.body_pos[b])) @ phi[robot.payload_body]
        )
    return phi


def phi_without(robot: RobotModel, unknown: tuple[Body, ...]) -> Array:
    """Return phi (nb, 10) of the robot, zero for the unknown bodies."""
    names = {body.name for body in unknown}
    given = robot.phi.copy()
    # A zero row adds no torque, since torques are linear in phi.
    given[[name in names for name in robot.body_names]] = 0.0
    return given
