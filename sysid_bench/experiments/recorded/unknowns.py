"""Unknown parameters of recorded experiments, and the rows that were measured."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Final

import numpy as np

from sysid_bench.errors import UnsupportedError, UsageError
from sysid_bench.experiments.recorded.extra_columns import (
    ExtraColumns,
    columns_of_features,
    extra_columns,
    plugin_folder,
)
from sysid_bench.experiments.recorded.process_log import ProcessedLog
from sysid_bench.experiments.tasks.task import (
    Task,
    TaskDefinition,
    columns_of,
    find_task,
    unknown_bodies,
    words_of_features,
)
from sysid_bench.identifiability.base_map import base_map, structural_factor
from sysid_bench.models.load import load_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import Instruments, SensorSubtree, instruments_of
from sysid_bench.numerics import qr_factor
from sysid_bench.plugin_names import known
from sysid_bench.types import Array, BaseMap, Body, Trajectory

MASS: Final = "payload.m"
"""Mass of the payload where that is its only unknown."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """`inertial` parameters of the robot and its joint `terms`, those of the payload where
    `loaded` carries an unknown one, and `extra` columns of `features`; `rows`: the recorded
    joints."""

    robot: RobotModel
    loaded: RobotModel | None
    inertial: tuple[str, ...]
    terms: tuple[str, ...]
    rows: tuple[str, ...]
    features: ExtraColumns | None = None
    words: tuple[str, ...] = ()  # features and terms of motors that were named, not selected
    extra: tuple[str, ...] = ()
    given: bool = False  # the payload's position, so that its mass is one of the extra columns
    sub_tree: Task | None = None  # behind a force/torque sensor, whose wrench is all that is used

    def rows_of(self, name: str) -> tuple[str, ...]:
        """The recorded joints that have a column of a term or feature."""
        if self.features is not None and name in self.extra:
            return self.features.rows_of(name)
        return (name.partition(".")[0],)

    @property
    def robot_parameters(self) -> tuple[str, ...]:
        """Parameters of the robot itself."""
        return self.inertial + self.terms

    @property
    def _payload(self) -> tuple[Body, ...]:
        """The payload if its ten parameters are unknown, else nothing."""
        if self.loaded is None or self.loaded.payload_body is None or self.given:
            return ()
        return (self.loaded.bodies[self.loaded.payload_body],)

    @property
    def payload_parameters(self) -> tuple[str, ...]:
        """Names of the payload's ten parameters, or none."""
        return columns_of(self._payload)

    def rigid_bodies(self, log: ProcessedLog) -> tuple[RobotModel, tuple[str, ...]]:
        """The robot of a log, with those unknowns that its regressor has columns for."""
        if not log.payload:
            return self.robot, self.robot_parameters
        robot = self.robot if self.loaded is None else log.robot
        return robot, self.robot_parameters + self.payload_parameters

    @property
    def _motor_names(self) -> tuple[str, ...]:
        """Terms of motors: linear in the state like those of joints, they are part of the base."""
        known = () if self.features is None else self.features.motor_terms
        return tuple(name for name in self.extra if name in known)

    @property
    def _extra_parameters(self) -> tuple[str, ...]:
        """Features, and a mass: each is a base parameter of its own."""
        return tuple(name for name in self.extra if name not in self._motor_names)

    @property
    def parameters(self) -> tuple[str, ...]:
        """All unknowns (p,)."""
        return self._rigid_parameters + self._extra_parameters

    @property
    def _rigid_parameters(self) -> tuple[str, ...]:
        return self.robot_parameters + self.payload_parameters + self._motor_names

    def base(self) -> BaseMap:
        """The base parameters."""
        base = base_map(self._structural_factor(), self._rigid_parameters)
        if not self._extra_parameters:
            return base
        r, p, k = base.rank, len(base.parameters), len(self._extra_parameters)
        # [[K, 0], [0, I]]: each extra parameter is independent of the rigid bodies.
        K = np.zeros((r + k, p + k))
        K[:r, :p], K[r:, p:] = base.K, np.eye(k)
        pivots = np.append(base.pivots, np.arange(p, p + k))
        return replace(
            base, K=K, pivots=pivots, parameters=self.parameters, row_space=None, dropped=None
        )

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Bodies whose ten numbers are unknown."""
        if self.sub_tree is not None:
            return self.sub_tree.bodies
        return (*unknown_bodies(self.robot), *self._payload)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kind of each row: "joint N m" or "joint N"."""
        instruments = self.instruments(self.robot)
        return tuple(instruments.kinds[instruments.measured.index(row)] for row in self.rows)

    @property
    def term_values(self) -> Array:
        """Values of the `terms` in the model file; constants of sensors, which no file has, are
        zero."""
        if self.sub_tree is not None:
            return np.zeros(len(self.terms))
        return self.robot.term_values(self.terms)

    def instruments(self, robot: RobotModel) -> Instruments:
        """The measured rows of the robot of a log."""
        return instruments_of(robot, () if self.sub_tree is None else self.sub_tree.cuts)

    def _structural_factor(self) -> Array:
        """Triangular factor R (m, p) of the regressor over random states with and, where there is
        one, without the payload."""
        robot, load = self.robot_parameters, self.payload_parameters
        if self.sub_tree is not None:
            return structural_factor(self.robot, robot, self.rows, self.sub_tree.cuts)

        def motors(model: RobotModel) -> Callable[[Trajectory], Array] | None:
            if not self._motor_names or self.features is None:
                return None
            return partial(self.features.on_rows, model, self.rows, self._motor_names)

        R = structural_factor(self.robot, robot, self.rows, appended=motors(self.robot))
        if self.loaded is None:
            return R
        appended = motors(self.loaded)
        R_loaded = structural_factor(self.loaded, robot + load, self.rows, appended=appended)
        # Both robots together: the payload is what makes the difference between their rows.
        m, zeros = len(robot), np.zeros((len(R), len(load)))
        return qr_factor([np.hstack([R[:, :m], zeros, R[:, m:]]), R_loaded])


def unknowns_of(
    task: str,
    terms: tuple[str, ...],
    training: Sequence[ProcessedLog],
    position_given: bool,
    sensor: str | None = None,
) -> Unknowns:
    """The unknowns of a task on training logs, before any term is selected; `sensor`: the one that
    is used alone, by default the only one of the logs.

    Raises UnsupportedError for a task that recordings do not support, UsageError where the logs do
    not fit the task.
    """
    definition = _task_of_recordings(task)
    if position_given and not definition.identifies_payload:
        raise UsageError("A given position needs a task that identifies the payload: 'payload'.")
    if definition.measures_sensor_only:
        return _sensor_unknowns(definition, terms, training, sensor)
    if sensor is not None:
        raise UsageError(
            f"The task {task!r} of a recording uses the torques of joints; the sensor {sensor!r} "
            "needs --task wrench."
        )
    # Raise UsageError for a log without torques
    for log in training:
        if not log.log.description.has_torque:
            raise UsageError(
                f"{log.log.description.source} has no torques, which the task {definition.name!r} "
                "needs: write tau = { columns = [...] }, or identify what is distal to the sensor "
                "with --task wrench."
            )
    robot, loaded = _robots(definition, training)
    rows, words = training[0].log.joints, words_of_features(terms, robot)
    inertial = columns_of(unknown_bodies(robot))
    columns = robot.term_columns(tuple(term for term in terms if term not in words))
    extra: tuple[str, ...] = (MASS,) if position_given else ()
    features = None
    if words:  # features, and terms of motors
        features = extra_columns(robot, rows, words, training)
        of_motors = () if features.motors is None else features.motors.columns
        extra += (*columns_of_features(words, rows, plugin_folder(robot)), *of_motors)
    return Unknowns(
        robot, loaded, inertial, columns, rows,
        features=features, words=words, extra=extra, given=position_given,
    )  # fmt: skip


def _task_of_recordings(task: str) -> TaskDefinition:
    """The task of this name; raises UnsupportedError for one that recordings do not support."""
    definition = find_task(task)
    if not definition.supports_recordings:
        served = [name for name in known("task") if find_task(name).supports_recordings]
        raise UnsupportedError(
            f"The task {definition.name!r} needs a robot with known parameters; recordings support "
            f"{' and '.join(map(repr, served))}."
        )
    return definition


def _sensor_unknowns(
    task: TaskDefinition,
    terms: tuple[str, ...],
    training: Sequence[ProcessedLog],
    sensor: str | None,
) -> Unknowns:
    """The unknowns distal to a force/torque sensor; raises UsageError where its wrench, or that of
    a sensor that ends its sub-tree, is not recorded."""
    first = training[0]
    robot = load_robot(first.robot.manifest)
    recorded = [part.sensor for part in first.log.description.wrench]
    if sensor is None and len(recorded) == 1:
        sensor = recorded[0]
    posed = task.unknowns(robot, terms, sensor, None)
    check_wrench(training, posed.cuts)
    return Unknowns(
        robot,
        None,
        columns_of(posed.bodies),
        posed.parameters[10 * len(posed.bodies) :],
        posed.rows or (),
        sub_tree=posed,
    )


def check_wrench(logs: Iterable[ProcessedLog], cuts: Sequence[SensorSubtree]) -> None:
    """Raise UsageError where a log lacks the wrench of one of the sensors."""
    for log, cut in product(logs, cuts):
        recorded = [part.sensor for part in log.log.description.wrench]
        if cut.name not in recorded:
            raise UsageError(
                f"{log.log.description.source} has no wrench of the sensor {cut.name!r} (it has "
                f"{', '.join(recorded) or 'none'}): write wrench = {{ columns = [...], sensor = "
                f"{cut.name!r} }}."
            )


def _robots(
    task: TaskDefinition, training: Sequence[ProcessedLog]
) -> tuple[RobotModel, RobotModel | None]:
    """The robot without a payload and, where a payload is unknown, the first log's that carries it.

    Raises UsageError where the task compares both and the logs have only one of them.
    """
    unloaded, loaded = (
        next((log.robot for log in training if bool(log.payload) is payload), None)
        for payload in (False, True)
    )
    if not task.identifies_payload:
        return unloaded or load_robot(training[0].robot.manifest), None
    if unloaded is None or loaded is None:
        raise UsageError(
            f"The task {task.name!r} compares recordings with and without the payload: give one "
            "--log of each, and state in the description of the loaded one what was mounted, as in "
            'payload = { use = "box-2kg" }.'
        )
    return unloaded, loaded
