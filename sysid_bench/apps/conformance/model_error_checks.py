"""Conformance kit of model errors: `apply(robot, rng)` gives the plant's robot.

The class attribute `sizes` names the settings that are zero without the error.
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
    shape_error,
)
from sysid_bench.apps.conformance.without_error import without_error
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import Fourier
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.model_errors import PlantCoordinates
from sysid_bench.simulation.plant import plant_of
from sysid_bench.types import Array, Trajectory

APPLIED: Final = "gives a robot"

SEED: Final = 1


@dataclass(frozen=True, eq=False)
class _ModelErrorCase:
    """The robot of an identified model, and a motion of its joints."""

    name: str
    robot: RobotModel
    motion: Trajectory


Law = Callable[[Any, _ModelErrorCase, RobotModel], str | None]
"""(error, case, the plant's robot) -> description of the violation, or None."""


@cache
def model_error_cases() -> tuple[_ModelErrorCase, ...]:
    """An arm with a payload, a random tree, and an arm with coupled joints."""
    named = (("ur5", "sphere-1kg"), ("random:7", "none"), ("random:mimic-gripper:3", "none"))
    cases = []
    for name, payload in named:
        robot = loaded_robot(name, payload, None, None).robot
        motion = Fourier(period=2.0, cycles=1).design(
            design_problem(robot, 50.0), np.random.default_rng(SEED)
        )
        cases.append(_ModelErrorCase(name, robot, motion))
    return tuple(cases)


def check_model_error(error: Any, cases: Sequence[_ModelErrorCase] | None = None) -> list[Finding]:
    """Findings of all laws on all cases (None: `model_error_cases`)."""
    findings = []
    for case in model_error_cases() if cases is None else cases:
        before = _state(case)
        findings += _findings_on(error, case)
        if _state(case) != before:
            message = "it changed the model's robot or the motion"
            findings.append(Finding(UNCHANGED, case.name, False, message))
    return findings


def _findings_on(error: Any, case: _ModelErrorCase) -> list[Finding]:
    try:
        robot = _applied(error, case)
    except Exception as raised:
        return [finding_of_error(raised, APPLIED, case.name)]
    if not isinstance(robot, RobotModel):
        return [Finding(APPLIED, case.name, False, f"it is a {type(robot).__name__}")]
    return [Finding(APPLIED, case.name, True), *findings_of(LAWS, case.name, error, case, robot)]


def _applied(error: Any, case: _ModelErrorCase) -> Any:
    return error.apply(case.robot, np.random.default_rng(SEED))


def _state(case: _ModelErrorCase) -> str:
    robot, mj = case.robot, case.robot.mj
    arrays = (mj.body_pos, mj.body_quat, mj.body_mass, mj.body_inertia, mj.opt.gravity, mj.eq_data)
    frames = [link.R0 for link in robot.tree.links]
    return data_hash((case.motion, robot.phi, robot.joint_terms, frames, *map(np.array, arrays)))


def _torque(robot: RobotModel, case: _ModelErrorCase) -> Array:
    """Torque (N, n) of a plant's robot, as the model counts it."""
    joints = PlantCoordinates(case.robot, robot)
    motion = joints.to_plant(case.motion)
    no_error = np.zeros((len(motion), len(robot.torque_dofs)))
    oracle, _ = Inverse().run(plant_of(robot), motion, no_error)
    return joints.to_model(oracle).tau


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


def _is_deterministic(error: Any, case: _ModelErrorCase, robot: RobotModel) -> str | None:
    if np.array_equal(_torque(robot, case), _torque(_applied(error, case), case)):
        return None
    return "the same generator state gives another robot: draw from the given generator alone"


def _vanishes_at_size_zero(error: Any, case: _ModelErrorCase, robot: RobotModel) -> str | None:
    without = _applied(without_error(error), case)
    if np.array_equal(_torque(without, case), _torque(case.robot, case)):
        return None
    return "with its sizes zero, torques are not bit for bit those of the model"


LAWS: Final[dict[str, Law]] = {
    "has the model's bodies and joints": _has_the_same_parts,
    "keeps the true parameters": _keeps_the_truth,
    "moves along a motion of the model": _moves,
    "is deterministic": _is_deterministic,
    "vanishes at size zero": _vanishes_at_size_zero,
}
