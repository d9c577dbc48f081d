"""Conformance kits of model errors and sensor errors.

Their class attribute `sizes` names the settings that are zero without the error.

A model error has `apply(robot, rng)`, which gives the plant's robot; a sensor error
`prepare(robot, rng)`, which gives None or a stage of the sensor chain with one or several of the
methods `encoder_error`, `torque_reading`, `sampling_delay` and `stored` (simulation/sensors.py).
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.findings import (
    Finding,
    Kit,
    KitCase,
    Law,
    RobotMotion,
    data_hash,
    first_error,
    motion_of_kit,
    robot_of_kit,
    robots_in_motion,
    shape_error,
    without_error,
)
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation import sensors
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.model_errors import PlantCoordinates
from sysid_bench.simulation.plant import plant_of
from sysid_bench.types import Array

SEED: Final = 1


def model_error_cases() -> tuple[RobotMotion, ...]:
    """An arm with a payload, a random tree, and an arm with coupled joints."""
    return robots_in_motion(
        ("ur5", "sphere-1kg"), ("random:7", "none"), ("random:mimic-gripper:3", "none")
    )


def check_model_error(error: Any) -> list[Finding]:
    """Findings of all laws on `model_error_cases`."""
    return _ModelErrorKit.check(error, model_error_cases())


class _ModelErrorKit(Kit[RobotMotion]):
    runs = "gives a robot"
    changed = "it changed the model's robot or the motion"

    def run(self) -> Any:
        return self._applied(self.plugin)

    def _applied(self, error: Any) -> Any:
        # A new generator of one seed each time: a second draw from one would differ by right.
        return error.apply(self.case.robot, np.random.default_rng(SEED))

    def given(self) -> Any:
        robot, mj = self.case.robot, self.case.robot.mj
        bodies = (mj.body_pos, mj.body_quat, mj.body_mass, mj.body_inertia)
        frames = [link.R0 for link in robot.tree.links]
        more = (frames, mj.opt.gravity, mj.eq_data)
        return self.case.motion, robot.phi, robot.joint_terms, bodies, more

    def _torque(self, robot: RobotModel) -> Array:
        """Torque (N, n) of a plant's robot, as the model counts it."""
        joints = PlantCoordinates(self.case.robot, robot)
        motion = joints.to_plant(self.case.motion)
        no_error = np.zeros((len(motion), len(robot.torque_dofs)))
        oracle, _ = Inverse().run(plant_of(robot), motion, no_error)
        return joints.to_model(oracle).tau

    @Law(runs, first=True)
    def is_robot(self) -> str | None:
        name = type(self.result).__name__
        return None if isinstance(self.result, RobotModel) else f"it is a {name}"

    @Law("has the model's bodies and joints")
    def parts(self) -> str | None:
        """Parameters are compared by name."""
        robot, model = self.result, self.case.robot
        if robot.body_names != model.body_names:
            return "its bodies are not those of the model"
        same = robot.rows == model.rows and robot.torque_rows == model.torque_rows
        return None if same else "its degrees of freedom are not those of the model"

    @Law("keeps the true parameters")
    def truth(self) -> str | None:
        robot, model = self.result, self.case.robot
        terms = data_hash(robot.joint_terms) == data_hash(model.joint_terms)
        if terms and np.array_equal(robot.phi, model.phi):
            return None
        return "it changed link parameters or joint terms: these are the truth of both sides"

    @Law("moves along a motion of the model")
    def moves(self) -> str | None:
        shape = (len(self.case.motion), len(self.case.robot.torque_dofs))
        return shape_error("its torque", self._torque(self.result), shape)

    @Law("is deterministic")
    def repeats(self) -> str | None:
        if np.array_equal(self._torque(self.result), self._torque(self.run())):
            return None
        return "the same generator state gives another robot: draw from the given generator alone"

    @Law("vanishes at size zero")
    def size_zero(self) -> str | None:
        without = self._applied(without_error(self.plugin))
        if np.array_equal(self._torque(without), self._torque(self.case.robot)):
            return None
        return "with its sizes zero, torques are not bit for bit those of the model"


METHODS: Final = ("encoder_error", "torque_reading", "sampling_delay", "stored")


@dataclass(frozen=True, eq=False)
class _SensorErrorCase(KitCase):
    """A robot and the exact signals of its joints."""

    robot: RobotModel
    signal: sensors.TorqueSignal


@cache
def sensor_error_cases() -> tuple[_SensorErrorCase, ...]:
    """An arm and a random tree, along Fourier series at 1 kHz."""
    cases = []
    for name in ("ur5", "random:7"):
        robot = robot_of_kit(name)
        motion = motion_of_kit(robot, 1000.0, period=1.0)
        no_error = np.zeros((len(motion), len(robot.torque_dofs)))
        tau = Inverse().run(plant_of(robot), motion, no_error)[0].tau
        q = np.zeros_like(tau)
        for joint in robot.joints:
            if joint.kind in ("hinge", "slide"):
                q[:, joint.vadr] = motion.q[:, joint.qadr]
        rms = np.sqrt((tau**2).mean(axis=0))
        cases.append(_SensorErrorCase(name, robot, sensors.TorqueSignal(motion.t, q, tau, rms)))
    return tuple(cases)


def check_sensor_error(error: Any) -> list[Finding]:
    """Findings of all laws on `sensor_error_cases`."""
    return _SensorErrorKit.check(error, sensor_error_cases())


class _SensorErrorKit(Kit[_SensorErrorCase]):
    """`result`: outputs of the stage of an error by name, one or two per method; {} without one."""

    runs = "prepares a stage"
    changed = "it changed the robot or a signal"

    def run(self) -> dict[str, Array]:
        return self._outputs(self.plugin)

    def _outputs(self, error: Any) -> dict[str, Array]:
        def rng() -> np.random.Generator:
            return np.random.default_rng(SEED)

        stage = error.prepare(self.case.robot, rng())
        signal, outputs = self.case.signal, dict[str, Any]()
        if isinstance(stage, sensors.EncoderStage):
            outputs["encoder_error"] = stage.encoder_error(signal.q)
        if isinstance(stage, sensors.TorqueStage):
            outputs["torque_reading"] = stage.torque_reading(signal, rng())
        if isinstance(stage, sensors.SamplingStage):
            late = stage.sampling_delay(signal.t, rng())
            names = ("sampling delay of q", "sampling delay of tau")
            outputs |= dict(zip(names, late, strict=True))
        if isinstance(stage, sensors.LossStage):
            outputs["stored"] = stage.stored(len(signal.t), rng())
        return {name: np.asarray(value) for name, value in outputs.items()}

    def _undisturbed(self) -> dict[str, Array]:
        """Outputs of a stage without an error, by name."""
        signal = self.case.signal
        zero = np.zeros_like(signal.q)
        return {
            "encoder_error": zero,
            "torque_reading": signal.tau,
            "sampling delay of q": zero,
            "sampling delay of tau": zero,
            "stored": np.arange(len(signal.t)),
        }

    def given(self) -> Any:
        return self.case.signal, self.case.robot.phi, self.case.robot.joint_terms

    @Law(runs, first=True)
    def is_stage(self) -> str | None:
        if self.result:
            return None
        stage = self.plugin.prepare(self.case.robot, np.random.default_rng(SEED))
        methods = ", ".join(METHODS)
        return None if stage is None else f"it is a {type(stage).__name__} without {methods}"

    @Law("gives finite signals")
    def finite(self) -> str | None:
        """Finite values of the shapes of the signals."""
        given, expected = self.result.items(), self._undisturbed()
        return first_error(shape_error(name, x, expected[name].shape) for name, x in given)

    @Law("stores samples that were taken")
    def stored(self) -> str | None:
        """Rows hold a sample that there was, or none (-1); the first and the last one are there."""
        stored = self.result.get("stored")
        if stored is None:
            return None
        if not np.issubdtype(stored.dtype, np.integer):
            return f"stored has the type {stored.dtype}: samples are whole numbers"
        if ((stored < -1) | (stored > np.arange(len(stored)))).any():
            return "a row holds a sample that was not taken yet"
        return None if min(stored[0], stored[-1]) >= 0 else "the first or the last row is missing"

    @Law("is deterministic")
    def repeats(self) -> str | None:
        if data_hash(list(self.run().values())) == data_hash(list(self.result.values())):
            return None
        return "the same generator states give other signals: draw from the given generators alone"

    @Law("vanishes at size zero")
    def size_zero(self) -> str | None:
        expected, found = self._undisturbed(), self._outputs(without_error(self.plugin))
        wrong = [name for name, x in found.items() if not np.array_equal(x, expected[name])]
        return f"with its sizes zero, {wrong[0]} is not exact" if wrong else None
