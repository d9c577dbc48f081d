"""The verdict on a robot: does our Y agree with Pinocchio's, and do its torques close MuJoCo's?"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.evaluation.coupling_check import CouplingCheck, check_coupling, relative_error
from sysid_bench.models.random.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.pinocchio import pinocchio_regressor
from sysid_bench.regressors.pinocchio_urdf import urdf_regressor
from sysid_bench.regressors.regression import regression
from sysid_bench.simulation.mujoco_inverse import inverse_torque
from sysid_bench.types import Array

GAP: Final = 1e-12
CLOSURE: Final = 1e-11
"""Tolerances; both engines agree to 1e-14 on every model that has been measured."""

SEED: Final = 1


@dataclass(frozen=True, eq=False)
class CrossCheck:
    """`gap`: max |Y - Y_pin| / max |Y_pin|; `closure`: max |Y theta + armature a - tau_MuJoCo| /
    max |tau_MuJoCo|; `native_gap` as `gap` against Pinocchio's own parser, None with a reason;
    `gap_map` (rows, p): the largest |Y - Y_pin| over the samples."""

    gap: float
    closure: float
    native_gap: float | None
    native_reason: str
    gap_map: Array
    columns: tuple[str, ...]
    coupling: CouplingCheck | None = None

    def ok(self, tolerance: float = GAP) -> bool:
        """Whether every figure holds; a figure that is not a number does not."""
        return not self.reason(tolerance)

    def reason(self, tolerance: float = GAP) -> str:
        """Which figure fails, in words; empty where all hold."""
        figures = [("gap", self.gap, tolerance), ("closure", self.closure, CLOSURE)]
        if self.native_gap is not None:
            figures.append(("native gap", self.native_gap, tolerance))
        if self.coupling is not None:
            figures += self.coupling.figures
        return "; ".join(
            f"{name} {value:.2g} is above {limit:.2g}"
            for name, value, limit in figures
            if not value <= limit
        )


def crosscheck(robot: RobotModel, samples: int = 50, native: bool = True) -> CrossCheck:
    """The robot in both engines at random states; `native` asks Pinocchio's own parser as well.

    Coupled joints move on their own for the figures of the tree; `coupling` has the rest.
    """
    if robot.coupling is not None:
        tree = crosscheck(robot.uncoupled, samples, native)
        return replace(tree, coupling=check_coupling(robot, samples))
    motion = random_states(robot, samples, np.random.default_rng(SEED))
    Y = regression(robot, robot.inertial_columns).dense(motion).Y
    witness = pinocchio_regressor(robot, motion).Y
    tau = inverse_torque(robot, motion)
    predicted = Y @ robot.phi.ravel() + robot.joint_terms.armature * motion.a
    native_gap, why = None, ""
    if native:
        try:
            native_gap = relative_error(Y - (theirs := urdf_regressor(robot, motion).Y), theirs)
        except UnsupportedError as error:
            why = str(error)
    return CrossCheck(
        gap=relative_error(Y - witness, witness),
        closure=relative_error(predicted - tau, tau),
        native_gap=native_gap,
        native_reason=why,
        gap_map=np.abs(Y - witness).max(axis=0),
        columns=robot.inertial_columns,
    )
