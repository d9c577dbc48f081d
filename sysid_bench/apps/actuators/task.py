"""The task `actuators`: joint terms of a robot with known links."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.tasks.task import (
    SensorOffset,
    Task,
    TaskDefinition,
    joint_torque_task,
    phi_without,
)
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log_description import LogDescription

ACTUATOR_TERMS: Final = ("armature", "viscous", "coulomb", "offset")


@dataclass(frozen=True)
class ActuatorsTask(TaskDefinition):
    """Armature, friction and torque offset of every joint, with all links given.

    Recordings of position-commanded robots need no torque; the delay of their commands is found.
    """

    name: ClassVar[str] = "actuators"
    accepts_terms: ClassVar[bool] = True
    commands: ClassVar[Mapping[str, str]] = {
        "identify": "sysid_bench.apps.actuators.commands.identify_actuators:identify_actuators",
        "excite": "sysid_bench.apps.actuators.commands.excite_actuators:commands_request",
        "diagnose": "sysid_bench.apps.actuators.commands.identify_actuators:command_delay",
    }
    supports_recordings: ClassVar[bool] = True

    def default_terms(self, robot: RobotModel) -> tuple[str, ...]:
        """All terms of actuators."""
        return ACTUATOR_TERMS

    def unknowns(
        self,
        robot: RobotModel,
        terms: tuple[str, ...],
        sensor: str | None,
        offset: SensorOffset | None,
    ) -> Task:
        """Pose the task; without `terms`, those of `default_terms` are unknown."""
        chosen = terms or self.default_terms(robot)
        return joint_torque_task(self, robot, (), robot.phi[:0], phi_without(robot, ()), chosen)

    def prepare_recordings(
        self,
        manifest: Manifest,
        training: Sequence[LogDescription],
        tests: Mapping[str, LogDescription],
        accept: Sequence[str],
        prior: str | Mapping[str, Any],
    ) -> ExperimentData[Any]:
        """Return the problem of armature and friction joint by joint at the delay that fits best;
        spreads as a `prior` have no meaning here, and are replaced by the model's values."""
        # Loads the simulation, which a list of tasks does not need.
        from sysid_bench.apps.actuators.drive_experiment import prepare_drives

        stated = prior if isinstance(prior, str) else "model"
        return prepare_drives(manifest, training, tests, accept, stated)
