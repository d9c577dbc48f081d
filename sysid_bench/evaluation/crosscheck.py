"""Cross-check of a robot: our regressor against Pinocchio's, its torques against MuJoCo's."""

from collections.abc import Sequence
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
from sysid_bench.simulation.inverse import inverse_torque
from sysid_bench.types import Array

GAP: Final = 1e-12
CLOSURE: Final = 1e-11
"""Relative tolerances; both engines agree to 1e-14 on every model measured."""

SEED: Final = 1


@dataclass(frozen=True, eq=False)
class Crosscheck:
    """Agreement of a robot's regressor with the engines.

    `gap`: max |Y - Y_pin| / max |Y_pin|; `closure`: max |Y theta + armature a - tau_MuJoCo| /
    max |tau_MuJoCo|; `native_gap`: as `gap`, with the model read by Pinocchio's own URDF parser, or
    None with `native_reason`; `gap_map` (rows, p): largest |Y - Y_pin| over the samples.
    """

    gap: float
    closure: float
    native_gap: float | None
    native_reason: str
    gap_map: Array
    columns: tuple[str, ...]
    coupling: CouplingCheck | None = None

    def ok(self, tolerance: float = GAP) -> bool:
        """Return True if all errors are within their tolerances; NaN is not."""
        return not self.reason(tolerance)

    def reason(self, tolerance: float = GAP) -> str:
        """Return the errors above tolerance as text; empty if there are none."""
        tree, coupled = self._tree_reason(tolerance), self._coupling_reason()
        if coupled and not tree:
            coupled = (
                f"the engines agree on the tree, but not its closed chains or couplings: {coupled}"
            )
        return "; ".join(text for text in (tree, coupled) if text)

    def reason_text(self) -> str:
        """Return the reason with its cause: the engines, or the file's own couplings."""
        prefix = "the engines disagree: " if self._tree_reason(GAP) else ""
        return f"{prefix}{self.reason()}."

    def _tree_reason(self, tolerance: float) -> str:
        figures = [("gap", self.gap, tolerance), ("closure", self.closure, CLOSURE)]
        if self.native_gap is not None:
            figures.append(("native gap", self.native_gap, tolerance))
        return _above(figures)

    def _coupling_reason(self) -> str:
        if self.coupling is None:
            return ""
        above, note = _above(self.coupling.figures), self.coupling.note
        return f"{above}; {note}" if above and note else above


def _above(figures: Sequence[tuple[str, float, float]]) -> str:
    """Values above their tolerance as text."""
    return "; ".join(
        f"{name} {value:.2g} is above {limit:.2g}"
        for name, value, limit in figures
        if not value <= limit  # true for NaN as well
    )


def crosscheck(robot: RobotModel, samples: int = 50, native: bool = True) -> Crosscheck:
    """Compare a robot's regressor between the engines at `samples` random states.

    `native` also compares with Pinocchio's own URDF parser. For a robot with coupled joints, the
    errors are those of the tree without couplings, and `coupling` has those of the coupling.
    """
    if robot.coupling is not None:
        tree = crosscheck(robot.without_coupling, samples, native)
        return replace(tree, coupling=check_coupling(robot, samples))
    motion = random_states(robot, samples, np.random.default_rng(SEED))
    Y = regression(robot, robot.inertial_columns).dense(motion).Y
    reference = pinocchio_regressor(robot, motion).Y
    tau = inverse_torque(robot, motion)
    # MuJoCo adds the rotor inertia to the diagonal of M; it has no column among the inertial ones.
    predicted = Y @ robot.phi.ravel() + robot.joint_terms.armature * motion.a
    native_gap, reason = None, ""
    if native:
        try:
            parsed = urdf_regressor(robot, motion).Y
            native_gap = relative_error(Y - parsed, parsed)
        except UnsupportedError as error:
            reason = str(error)
    return Crosscheck(
        gap=relative_error(Y - reference, reference),
        closure=relative_error(predicted - tau, tau),
        native_gap=native_gap,
        native_reason=reason,
        gap_map=np.abs(Y - reference).max(axis=0),
        columns=robot.inertial_columns,
    )
