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
    Laws,
    data_hash,
    first_error,
    motion_of_kit,
    robot_of_kit,
    shape_error,
    without_error,
)
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.model_errors import PlantCoordinates
from sysid_bench.simulation.plant import plant_of
from sysid_bench.simulation.sensors import (
    EncoderStage,
    LossStage,
    SamplingStage,
    TorqueSignal,
    TorqueStage,
)
from sysid_bench.types import Array, Trajectory

APPLIED: Final = "gives a robot"

SEED: Final = 1


@dataclass(frozen=True, eq=False)
class _ModelErrorCase:
    """The robot of an identified model, and a motion of its joints."""

    name: str
    robot: RobotModel
    motion: Trajectory


@cache
def model_error_cases() -> tuple[_ModelErrorCase, ...]:
    """An arm with a payload, a random tree, and an arm with coupled joints."""
    named = (("ur5", "sphere-1kg"), ("random:7", "none"), ("random:mimic-gripper:3", "none"))
    cases = []
    for name, payload in named:
        robot = robot_of_kit(name, payload)
        cases.append(_ModelErrorCase(name, robot, motion_of_kit(robot, 50.0)))
    return tuple(cases)


def check_model_error(error: Any) -> list[Finding]:
    """Findings of all laws on `model_error_cases`."""
    return _MODEL_ERROR_KIT.findings(error, model_error_cases())


def _applied(error: Any, case: _ModelErrorCase) -> Any:
    return error.apply(case.robot, np.random.default_rng(SEED))


def _model_error_input(case: _ModelErrorCase) -> Any:
    robot, mj = case.robot, case.robot.mj
    arrays = (mj.body_pos, mj.body_quat, mj.body_mass, mj.body_inertia, mj.opt.gravity, mj.eq_data)
    frames = [link.R0 for link in robot.tree.links]
    return case.motion, robot.phi, robot.joint_terms, frames, arrays


def _torque(robot: RobotModel, case: _ModelErrorCase) -> Array:
    """Torque (N, n) of a plant's robot, as the model counts it."""
    joints = PlantCoordinates(case.robot, robot)
    motion = joints.to_plant(case.motion)
    no_error = np.zeros((len(motion), len(robot.torque_dofs)))
    oracle, _ = Inverse().run(plant_of(robot), motion, no_error)
    return joints.to_model(oracle).tau


def _is_a_robot(error: Any, case: _ModelErrorCase, robot: Any) -> str | None:
    return None if isinstance(robot, RobotModel) else f"it is a {type(robot).__name__}"


def _has_the_same_parts(error: Any, case: _ModelErrorCase, robot: RobotModel) -> str | None:
    """The same bodies and degrees of freedom, since parameters are compared by name."""
    if robot.body_names != case.robot.body_names:
        return "its bodies are not those of the model"
    same = robot.rows == case.robot.rows and robot.torque_rows == case.robot.torque_rows
    return None if same else "its degrees of freedom are not those of the model"


def _keeps_the_truth(error: Any, case: _ModelErrorCase, robot: RobotModel) -> str | None:
    terms = data_hash(robot.joint_terms) == data_hash(case.robot.joint_terms)
    if terms and np.array_equal(robot.phi, case.robot.phi):
        return None
    return "it changed link parameters or joint terms: these are the truth of both sides"


def _moves(error: Any, case: _ModelErrorCase, robot: RobotModel) -> str | None:
    tau = _torque(robot, case)
    return shape_error("its torque", tau, (len(case.motion), len(case.robot.torque_dofs)))


def _gives_one_robot(error: Any, case: _ModelErrorCase, robot: RobotModel) -> str | None:
    if np.array_equal(_torque(robot, case), _torque(_applied(error, case), case)):
        return None
    return "the same generator state gives another robot: draw from the given generator alone"


def _is_the_model_at_size_zero(error: Any, case: _ModelErrorCase, robot: RobotModel) -> str | None:
    without = _applied(without_error(error), case)
    if np.array_equal(_torque(without, case), _torque(case.robot, case)):
        return None
    return "with its sizes zero, torques are not bit for bit those of the model"


MODEL_ERROR_LAWS: Final[Laws] = {
    "has the model's bodies and joints": _has_the_same_parts,
    "keeps the true parameters": _keeps_the_truth,
    "moves along a motion of the model": _moves,
    "is deterministic": _gives_one_robot,
    "vanishes at size zero": _is_the_model_at_size_zero,
}

_MODEL_ERROR_KIT: Final = Kit(
    runs=APPLIED,
    run=_applied,
    laws=lambda case, robot: ({APPLIED: _is_a_robot}, MODEL_ERROR_LAWS),
    given=_model_error_input,
    changed="it changed the model's robot or the motion",
)


PREPARED: Final = "prepares a stage"

METHODS: Final = ("encoder_error", "torque_reading", "sampling_delay", "stored")


@dataclass(frozen=True, eq=False)
class _SensorErrorCase:
    """A robot and the exact signals of its joints."""

    name: str
    robot: RobotModel
    signal: TorqueSignal


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
        cases.append(_SensorErrorCase(name, robot, TorqueSignal(motion.t, q, tau, rms)))
    return tuple(cases)


def check_sensor_error(error: Any) -> list[Finding]:
    """Findings of all laws on `sensor_error_cases`."""
    return _SENSOR_ERROR_KIT.findings(error, sensor_error_cases())


def _outputs(error: Any, case: _SensorErrorCase) -> dict[str, Array]:
    """Results of the stage of an error by name, one or two per method; {} where it has none."""
    stage = error.prepare(case.robot, np.random.default_rng(SEED))
    signal, outputs = case.signal, dict[str, Any]()
    if isinstance(stage, EncoderStage):
        outputs["encoder_error"] = stage.encoder_error(signal.q)
    if isinstance(stage, TorqueStage):
        outputs["torque_reading"] = stage.torque_reading(signal, np.random.default_rng(SEED))
    if isinstance(stage, SamplingStage):
        late = stage.sampling_delay(signal.t, np.random.default_rng(SEED))
        outputs |= dict(zip(("sampling delay of q", "sampling delay of tau"), late, strict=True))
    if isinstance(stage, LossStage):
        outputs["stored"] = stage.stored(len(signal.t), np.random.default_rng(SEED))
    return {name: np.asarray(value) for name, value in outputs.items()}


def _undisturbed(case: _SensorErrorCase) -> dict[str, Array]:
    """Results of a stage without an error, by name."""
    signal = case.signal
    zero = np.zeros_like(signal.q)
    return {
        "encoder_error": zero,
        "torque_reading": signal.tau,
        "sampling delay of q": zero,
        "sampling delay of tau": zero,
        "stored": np.arange(len(signal.t)),
    }


def _is_a_stage(error: Any, case: _SensorErrorCase, outputs: dict[str, Array]) -> str | None:
    if outputs:
        return None
    stage = error.prepare(case.robot, np.random.default_rng(SEED))
    methods = ", ".join(METHODS)
    return None if stage is None else f"it is a {type(stage).__name__} without {methods}"


def _gives_finite_signals(
    error: Any, case: _SensorErrorCase, outputs: dict[str, Array]
) -> str | None:
    """Finite values of the shapes of the signals."""
    expected = _undisturbed(case)
    return first_error(shape_error(name, x, expected[name].shape) for name, x in outputs.items())


def _stores_earlier_samples(
    error: Any, case: _SensorErrorCase, outputs: dict[str, Array]
) -> str | None:
    """Rows hold a sample that there was, or none (-1); the first and the last one are there."""
    stored = outputs.get("stored")
    if stored is None:
        return None
    if not np.issubdtype(stored.dtype, np.integer):
        return f"stored has the type {stored.dtype}: samples are whole numbers"
    if ((stored < -1) | (stored > np.arange(len(stored)))).any():
        return "a row holds a sample that was not taken yet"
    return None if min(stored[0], stored[-1]) >= 0 else "the first or the last row is missing"


def _gives_the_same_signals(
    error: Any, case: _SensorErrorCase, outputs: dict[str, Array]
) -> str | None:
    again = _outputs(error, case)
    if data_hash(list(again.values())) == data_hash(list(outputs.values())):
        return None
    return "the same generator states give other signals: draw from the given generators alone"


def _is_exact_at_size_zero(
    error: Any, case: _SensorErrorCase, outputs: dict[str, Array]
) -> str | None:
    expected = _undisturbed(case)
    found = _outputs(without_error(error), case)
    wrong = [name for name, x in found.items() if not np.array_equal(x, expected[name])]
    return f"with its sizes zero, {wrong[0]} is not exact" if wrong else None


SENSOR_ERROR_LAWS: Final[Laws] = {
    "gives finite signals": _gives_finite_signals,
    "stores samples that were taken": _stores_earlier_samples,
    "is deterministic": _gives_the_same_signals,
    "vanishes at size zero": _is_exact_at_size_zero,
}

_SENSOR_ERROR_KIT: Final = Kit(
    runs=PREPARED,
    run=_outputs,
    laws=lambda case, outputs: ({PREPARED: _is_a_stage}, SENSOR_ERROR_LAWS),
    given=lambda case: (case.signal, case.robot.phi, case.robot.joint_terms),
    changed="it changed the robot or a signal",
)
