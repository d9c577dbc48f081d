"""The verdict on coupled joints: Y_reduced between the engines, its torques against constrained
dynamics, G against differences of the closed positions, and whether these are closed at all."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.random.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.coupled import torque_regression
from sysid_bench.regressors.pinocchio import pinocchio_regressor, reduced_regressor
from sysid_bench.simulation.mujoco_inverse import constrained_torque
from sysid_bench.types import Array, Trajectory

REDUCED_GAP: Final = 1e-10
REDUCED_CLOSURE: Final = 1e-9
"""Tolerances; 1e-14 is measured where G is of order one, and G grows towards singular postures."""

JACOBIAN: Final = 1e-6
"""Of differences, whose rounding errors are about 1e-9."""

VIOLATION: Final = 1e-4
"""rad, m; rounded lengths in model files leave that much open, closed loops 1e-15."""

SEED: Final = 2
MOVE: Final = 2e-3
"""How far the fastest joint moves between two positions that are compared (rad, m)."""


@dataclass(frozen=True, eq=False)
class CouplingCheck:
    """`gap`: max |Y - Y_pin| / max |Y_pin| of the reduced regressors, each with its engine's G;
    `closure`: reduced torques against those of MuJoCo's constrained dynamics, relative; `jacobian`:
    G v and its derivative against differences of positions, relative to the largest; `violation`:
    worst constraint residual of a closed posture by MuJoCo (rad, m)."""

    gap: float
    closure: float
    jacobian: float
    violation: float

    @property
    def figures(self) -> list[tuple[str, float, float]]:
        """(name, value, tolerance) of each figure."""
        return [
            ("coupled gap", self.gap, REDUCED_GAP),
            ("coupled closure", self.closure, REDUCED_CLOSURE),
            ("coupled jacobian", self.jacobian, JACOBIAN),
            ("coupling's violation", self.violation, VIOLATION),
        ]


def check_coupling(robot: RobotModel, samples: int) -> CouplingCheck:
    """The coupling of a robot at random closed states."""
    coupling = robot.coupling
    assert coupling is not None
    motion = random_states(robot, samples, np.random.default_rng(SEED))
    Y = torque_regression(robot, robot.inertial_columns).dense(motion).Y
    witness = reduced_regressor(robot, motion, pinocchio_regressor(robot, motion)).Y
    constrained = constrained_torque(robot, motion)
    armature = coupling.reduced(motion.q, robot.joint_terms.armature * motion.a)
    return CouplingCheck(
        gap=relative_error(Y - witness, witness),
        closure=relative_error(Y @ robot.phi.ravel() + armature - constrained.tau, constrained.tau),
        jacobian=_against_differences(coupling, motion),
        violation=constrained.violation,
    )


def relative_error(difference: Array, reference: Array) -> float:
    """max |difference| / max |reference|; a robot whose reference is all zero has only its own."""
    largest = float(np.abs(reference).max(initial=0.0))
    return float(np.abs(difference).max(initial=0.0)) / (largest or 1.0)


def _against_differences(coupling: Coupling, motion: Trajectory) -> float:
    """v and a of the joints that follow against five-point differences of where they are while the
    others move on with v and a."""
    following = coupling.qadr[coupling.dependent]
    moving = coupling.independent[coupling.qadr[coupling.independent] >= 0]
    places, v, a = coupling.qadr[moving], motion.v[:, moving], motion.a[:, moving]
    fastest = np.maximum(np.abs(motion.v), np.sqrt(np.abs(motion.a))).max(axis=1, keepdims=True)
    moment = MOVE / np.maximum(fastest, 1.0)  # s, of each state

    def positions(step: int) -> Array:
        q, t = motion.q.copy(), step * moment
        q[:, places] += t * v + 0.5 * t**2 * a
        return coupling.completed(q, motion.v, motion.a)[0][:, following]

    q = np.stack([positions(step) for step in range(-2, 3)])
    rates = np.tensordot([1, -8, 0, 8, -1], q, axes=1) / (12 * moment)
    changes = np.tensordot([-1, 16, -30, 16, -1], q, axes=1) / (12 * moment**2)
    return max(
        relative_error(rates - motion.v[:, coupling.dependent], motion.v),
        relative_error(changes - motion.a[:, coupling.dependent], motion.a),
    )
