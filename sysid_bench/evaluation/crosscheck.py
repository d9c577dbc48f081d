"""Cross-check of a robot: our regressor against the second engine's, Pinocchio where it is there,
its torques against MuJoCo's, and our steps of simulations against MuJoCo's.

Of coupled joints also the reduced regressor, the constrained dynamics, the Jacobian G and closure.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import mujoco
import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.evaluation.second_engine import (
    native_regressor,
    reduced_reference,
    reference_regressor,
    second_engine,
)
from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.coupled import torque_regression
from sysid_bench.regressors.regression import regression
from sysid_bench.simulation.elastic_drives import Drive
from sysid_bench.simulation.inverse import independent_rows, inverse_torque
from sysid_bench.simulation.plant import Plant
from sysid_bench.simulation.plant_batch import PlantBatch, uncovered
from sysid_bench.types import Array, Trajectory

REDUCED_GAP: Final = 1e-10
REDUCED_CLOSURE: Final = 1e-9
"""Relative tolerances. Measured: 1e-14 where G is of order one; G grows near singular postures."""

JACOBIAN: Final = 1e-6
"""Relative tolerance of finite differences, whose rounding errors are about 1e-9."""

VIOLATION: Final = 1e-4
"""rad, m: closure error that rounded lengths in model files cause; exact loops close to 1e-15."""

SLACK: Final = 10.0
"""Relative error of G and of its derivative, per relative error of the closure: redundant rows that
contradict each other define G to no more than that (measured: 0.1 to 3)."""

MOST_SLACK: Final = 1e-3
"""Largest addition to the tolerances: a file that contradicts itself by more is refused."""

CLOSES: Final = 1e-10
"""Relative error of the closure above which a file is said to contradict itself."""

_COUPLING_SEED: Final = 2
MOVE: Final = 2e-3
"""rad, m: step of the finite differences, for the fastest joint."""


@dataclass(frozen=True, eq=False)
class CouplingCheck:
    """Errors of a coupled robot's model.

    `gap`: max |Y - Y_pin| / max |Y_pin| of the reduced regressors, each with its own G; `closure`:
    relative error of reduced torques against MuJoCo's constrained dynamics; `jacobian`: relative
    error of G v and its derivative against finite differences; `violation`: largest constraint
    residual of a closed posture in MuJoCo (rad, m); `inconsistency`: relative error of the
    closure that redundant equations of the file leave, which the tolerances follow.
    """

    gap: float
    closure: float
    jacobian: float
    violation: float
    inconsistency: float = 0.0

    @property
    def note(self) -> str:
        """Statement that the file's own loops do not close exactly; empty where they do."""
        if self.inconsistency <= CLOSES:
            return ""
        return (
            f"redundant equations of the file's loops contradict each other: they close to "
            f"{self.violation:.1e} (m, rad) only, as with rounded positions; torques agree to that "
            "accuracy"
        )

    @property
    def figures(self) -> list[tuple[str, float, float]]:
        """(name, value, tolerance) of each error."""
        slack = min(SLACK * self.inconsistency, MOST_SLACK)
        return [
            ("coupled gap", self.gap, REDUCED_GAP + slack),
            ("coupled closure", self.closure, REDUCED_CLOSURE + slack),
            ("coupled jacobian", self.jacobian, JACOBIAN + slack),
            ("coupling's violation", self.violation, VIOLATION),
        ]


def check_coupling(robot: RobotModel, samples: int) -> CouplingCheck:
    """Check the joint coupling of a robot at `samples` random closed states."""
    coupling = robot.coupling
    assert coupling is not None
    motion = random_states(robot, samples, np.random.default_rng(_COUPLING_SEED))
    Y = torque_regression(robot, robot.inertial_columns).dense(motion).Y
    reference = reduced_reference(robot, motion)
    tau, violation = independent_rows(robot, motion, inverse_torque(robot, motion))
    # Rotors of dependent joints turn as well, and act on the drives through G.
    armature = coupling.reduced(motion.q, robot.joint_terms.armature * motion.a)
    return CouplingCheck(
        gap=relative_error(Y - reference, reference),
        closure=relative_error(Y @ robot.phi.ravel() + armature - tau, tau),
        jacobian=_against_differences(coupling, motion),
        violation=violation,
        inconsistency=coupling.closure_error(motion.q),
    )


def relative_error(difference: Array, reference: Array) -> float:
    """Return max |difference| / max |reference|, or max |difference| if the reference is zero."""
    largest = float(np.abs(reference).max(initial=0.0))
    return float(np.abs(difference).max(initial=0.0)) / (largest or 1.0)


def _against_differences(coupling: Coupling, motion: Trajectory) -> float:
    """Relative error of v and a of coupled joints against five-point differences of their
    positions, while the independent coordinates move with constant acceleration."""
    coordinates, moving = coupling.coordinates, coupling.independent
    x = coordinates.read(motion.q)
    dx, ddx = coordinates.rates(x, motion.v, motion.a)
    # In the time h the fastest joint moves by about MOVE, by its velocity or by its acceleration:
    # larger steps have errors of O(h^4), smaller ones rounding errors over h^2.
    fastest = np.maximum(np.abs(dx), np.sqrt(np.abs(ddx))).max(axis=1, keepdims=True)
    h = MOVE / np.maximum(fastest, 1.0)  # time step (s) of each state

    def positions(step: int) -> Array:
        ahead, q, t = x.copy(), motion.q.copy(), step * h
        ahead[:, moving] += t * dx[:, moving] + 0.5 * t**2 * ddx[:, moving]
        coordinates.write(ahead, q)
        closed, _, _ = coupling.completed(q, motion.v, motion.a)
        return coordinates.read(closed)

    moved = np.stack([positions(step) for step in range(-2, 3)])
    # Central five-point stencils of the first and second derivative, error O(h^4).
    rates = np.tensordot([1, -8, 0, 8, -1], moved, axes=1) / (12 * h)
    accelerations = np.tensordot([-1, 16, -30, 16, -1], moved, axes=1) / (12 * h**2)
    coupled = np.concatenate([group.dofs for group in coupling.groups])
    v, a = coordinates.velocity(x, rates, accelerations)
    return max(
        relative_error(v[:, coupled] - motion.v[:, coupled], motion.v),
        relative_error(a[:, coupled] - motion.a[:, coupled], motion.a),
    )


GAP: Final = 1e-12
CLOSURE: Final = 1e-11
"""Relative tolerances; both engines agree to 1e-14 on every model measured."""

SIMULATION_GAP: Final = 1e-9
"""rad, m: of positions after FALL steps. Light links and fast states amplify rounding errors;
measured: 1e-15 to 1e-13."""

FALL: Final = 100
"""Steps of 1 ms in which a robot falls from a random state; later, its motion may be chaotic."""

SEED: Final = 1


@dataclass(frozen=True, eq=False)
class Crosscheck:
    """Agreement of a robot's regressor with the engines.

    `gap`: max |Y - Y_pin| / max |Y_pin|; `closure`: max |Y theta + armature a - tau_MuJoCo| /
    max |tau_MuJoCo|; `native_gap`: as `gap`, with the model read by Pinocchio's own URDF parser, or
    None with `native_reason`; `gap_map` (rows, p): largest |Y - Y_pin| over the samples.
    `simulation_gap`: largest difference (rad, m) of positions that our steps and MuJoCo's simulate,
    or None with `simulation_reason`, for which MuJoCo alone simulates the robot.
    """

    gap: float
    closure: float
    native_gap: float | None
    native_reason: str
    gap_map: Array
    columns: tuple[str, ...]
    coupling: CouplingCheck | None = None
    engine: str = "pinocchio"  # the second one, Y_pin above
    simulation_gap: float | None = None
    simulation_reason: str = ""

    def ok(self, tolerance: float = GAP) -> bool:
        """Return True if all errors are within their tolerances; NaN is not."""
        return not self.reason(tolerance)

    def reason(self, tolerance: float = GAP) -> str:
        """Return the errors above tolerance as text; empty if there are none."""
        tree, coupled = self._tree_reason(tolerance), ""
        if self.coupling is not None and (coupled := _above(self.coupling.figures)):
            coupled += f"; {self.coupling.note}" if self.coupling.note else ""
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
        if self.simulation_gap is not None:
            figures.append(("simulation gap", self.simulation_gap, SIMULATION_GAP))
        return _above(figures)


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
        coupled = "coupled joints: gap of the tree, MuJoCo simulates the robot"
        reason = tree.simulation_reason or coupled
        return replace(tree, coupling=check_coupling(robot, samples), simulation_reason=reason)
    motion = random_states(robot, samples, np.random.default_rng(SEED))
    Y = regression(robot, robot.inertial_columns).dense(motion).Y
    reference = reference_regressor(robot, motion).Y
    tau = inverse_torque(robot, motion)
    # MuJoCo adds the rotor inertia to the diagonal of M; it has no column among the inertial ones.
    predicted = Y @ robot.phi.ravel() + robot.joint_terms.armature * motion.a
    native_gap, reason = None, ""
    if native:
        try:
            parsed = native_regressor(robot, motion)
            native_gap = relative_error(Y - parsed, parsed)
        except UnsupportedError as error:
            reason = str(error)
    fall, uncovered_reason = simulation_gap(robot)
    return Crosscheck(
        gap=relative_error(Y - reference, reference),
        closure=relative_error(predicted - tau, tau),
        native_gap=native_gap,
        native_reason=reason,
        gap_map=np.abs(Y - reference).max(axis=0),
        columns=robot.inertial_columns,
        engine=second_engine(),
        simulation_gap=fall,
        simulation_reason=uncovered_reason,
    )


def simulation_gap(robot: RobotModel) -> tuple[float | None, str]:
    """Return the largest difference (rad, m) of the positions of a robot that falls from random
    states, by lanes.c and by MuJoCo; or None with the reason why lanes.c does not simulate it.

    Without Coulomb friction, whose sticking MuJoCo's solver leaves inexact by 1e-8.
    """
    none = np.zeros(robot.nv)
    plant = Plant(robot, replace(robot.joint_terms, coulomb=none, offset=none))
    mj = plant.contact_free_model
    mj.opt.integrator, mj.opt.timestep = int(mujoco.mjtIntegrator.mjINT_EULER), 1e-3
    mj.dof_frictionloss[:] = 0.0
    if reason := uncovered(plant, mj):
        return None, reason
    mj.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)  # motors of the file
    states = random_states(robot, 2, np.random.default_rng(SEED))
    empty = np.zeros(0)
    motors = Drive(empty.astype(int), empty, empty, empty, held=False, smooth=False)
    t, control = 1e-3 * np.arange(FALL), np.zeros((FALL, 0))
    ours = PlantBatch(
        mj, [plant] * 2, motors, t=t, control=control, q=states.q, v=states.v, each=1
    ).run()
    gaps = []
    for k, q in enumerate(ours.q):
        data = mujoco.MjData(mj)
        data.qpos[:], data.qvel[:] = states.q[k], states.v[k]
        theirs = [states.q[k]]
        for _ in range(FALL - 1):
            mujoco.mj_step(mj, data)
            theirs.append(np.array(data.qpos))
        if not np.isfinite(theirs).all():
            return None, "MuJoCo's steps of 1 ms diverge"
        gaps.append(float(np.abs(q - theirs).max()))
    # NaN stays NaN, which is above every tolerance.
    return float(np.max(gaps)), ""
