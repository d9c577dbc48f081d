"""Conformance kit of sensor errors: `prepare(robot, rng)` gives a stage of the sensor chain or
None.

A stage has one or several of the methods `encoder_error`, `torque_reading`, `sampling_delay` and
`stored` (simulation/sensors.py). The class attribute `sizes` names the settings that are zero
without the error.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.findings import (
    UNCHANGED,
    Finding,
    data_hash,
    finding_of_error,
    findings_of,
    first_error,
    shape_error,
)
from sysid_bench.apps.conformance.without_error import without_error
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import Fourier
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.plant import plant_of
from sysid_bench.simulation.sensors import (
    EncoderStage,
    LossStage,
    SamplingStage,
    TorqueSignal,
    TorqueStage,
)
from sysid_bench.types import Array

PREPARED: Final = "prepares a stage"

METHODS: Final = ("encoder_error", "torque_reading", "sampling_delay", "stored")

SEED: Final = 1


@dataclass(frozen=True, eq=False)
class _SensorErrorCase:
    """A robot and the exact signals of its joints."""

    name: str
    robot: RobotModel
    signal: TorqueSignal


Law = Callable[[Any, _SensorErrorCase, dict[str, Array]], str | None]
"""(error, case, its outputs by name) -> description of the violation, or None."""


@cache
def sensor_error_cases() -> tuple[_SensorErrorCase, ...]:
    """An arm and a random tree, along Fourier series at 1 kHz."""
    return tuple(_case(name) for name in ("ur5", "random:7"))


def _case(name: str) -> _SensorErrorCase:
    robot = loaded_robot(name, "none", None, None).robot
    motion = Fourier(period=1.0, cycles=1).design(
        design_problem(robot, 1000.0), np.random.default_rng(SEED)
    )
    no_error = np.zeros((len(motion), len(robot.torque_dofs)))
    tau = Inverse().run(plant_of(robot), motion, no_error)[0].tau
    q = np.zeros_like(tau)
    for joint in robot.joints:
        if joint.kind in ("hinge", "slide"):
            q[:, joint.vadr] = motion.q[:, joint.qadr]
    rms = np.sqrt((tau**2).mean(axis=0))
    return _SensorErrorCase(name, robot, TorqueSignal(motion.t, q, tau, rms))


def check_sensor_error(
    error: Any, cases: Sequence[_SensorErrorCase] | None = None
) -> list[Finding]:
    """Findings of all laws on all cases (None: `sensor_error_cases`)."""
    findings = []
    for case in sensor_error_cases() if cases is None else cases:
        before = data_hash((case.signal, case.robot.phi, case.robot.joint_terms))
        findings += _findings_on(error, case)
        if data_hash((case.signal, case.robot.phi, case.robot.joint_terms)) != before:
            message = "it changed the robot or a signal"
            findings.append(Finding(UNCHANGED, case.name, False, message))
    return findings


def _findings_on(error: Any, case: _SensorErrorCase) -> list[Finding]:
    try:
        stage = error.prepare(case.robot, np.random.default_rng(SEED))
        outputs = _outputs(stage, case)
    except Exception as raised:
        return [finding_of_error(raised, PREPARED, case.name)]
    if stage is not None and not outputs:
        message = f"it is a {type(stage).__name__} without {', '.join(METHODS)}"
        return [Finding(PREPARED, case.name, False, message)]
    return [Finding(PREPARED, case.name, True), *findings_of(LAWS, case.name, error, case, outputs)]


def _prepared_outputs(error: Any, case: _SensorErrorCase) -> dict[str, Array]:
    return _outputs(error.prepare(case.robot, np.random.default_rng(SEED)), case)


def _outputs(stage: Any, case: _SensorErrorCase) -> dict[str, Array]:
    """Results of a stage by name, one or two per method; {} for None."""
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


def _has_shapes(error: Any, case: _SensorErrorCase, outputs: dict[str, Array]) -> str | None:
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


def _is_deterministic(error: Any, case: _SensorErrorCase, outputs: dict[str, Array]) -> str | None:
    again = _prepared_outputs(error, case)
    if data_hash(list(again.values())) == data_hash(list(outputs.values())):
        return None
    return "the same generator states give other signals: draw from the given generators alone"


def _vanishes_at_size_zero(
    error: Any, case: _SensorErrorCase, outputs: dict[str, Array]
) -> str | None:
    expected = _undisturbed(case)
    found = _prepared_outputs(without_error(error), case)
    wrong = [name for name, x in found.items() if not np.array_equal(x, expected[name])]
    return f"with its sizes zero, {wrong[0]} is not exact" if wrong else None


LAWS: Final[dict[str, Law]] = {
    "gives finite signals": _has_shapes,
    "stores samples that were taken": _stores_earlier_samples,
    "is deterministic": _is_deterministic,
    "vanishes at size zero": _vanishes_at_size_zero,
}
