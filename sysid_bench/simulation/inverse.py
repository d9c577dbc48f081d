"""Inverse dynamics simulation: the exact torque along a given motion."""

from dataclasses import dataclass

import mujoco
import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.models.model_checks import recorded_warnings
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.compiled_steps import compiled_torque
from sysid_bench.simulation.plant import Plant, StateLaw, check_finite, contact_free
from sysid_bench.types import Array, Controller, Oracle, Trajectory

CHUNK = 512
"""Samples whose mass matrices are held at a time."""

PLAYBACK_STEP = 2.5e-4
"""Step (s) of the internal states of force laws along a given motion, about."""


@dataclass(frozen=True)
class Inverse:
    """Simulation in which the robot follows the motion exactly.

    tau = M a + bias + joint terms + effects; internal states of effects advance along the motion;
    for coupled joints tau_ind = G^T tau on the independent ones.
    """

    def design_rate(self, recording: float) -> float:
        """Return the rate (Hz) at which the motion has to be sampled for a recording rate."""
        return recording

    def run(
        self, plant: Plant, commanded: Trajectory, encoder: Array
    ) -> tuple[Oracle, Controller | None]:
        """Return the exact motion and torques; there is no controller, so that the encoder error
        (N, n) has no effect on them. Raises UnsupportedError for elastic joints."""
        if plant.transmission is not None:
            raise UnsupportedError(
                f"{plant.robot.name} has elastic joints, whose links cannot follow a motion "
                "exactly; use simulation = 'closed-loop'."
            )
        t, v, terms = commanded.t, commanded.v, plant.terms
        q = joint_positions(plant.robot, commanded)
        rigid = rigid_torque(plant.contact_free_model, commanded)
        passive = terms.viscous * v + terms.coulomb * np.sign(v) + terms.offset
        # Springs belong to hinges and slides alone: those of other joints are zero.
        passive = passive + terms.spring * (q - terms.spring_reference)
        effects: Array = np.zeros_like(v)
        for law in plant.laws:
            if not isinstance(law, StateLaw):
                effects = np.asarray(effects + law(t, commanded.q, v))
        remembering = [law for law in plant.laws if isinstance(law, StateLaw)]
        if remembering:
            load = rigid - terms.armature * commanded.a
            each = max(1, round(float(t[1] - t[0]) / PLAYBACK_STEP))
            effects = effects + compiled_torque(remembering, t, q, v, load, each)
        tau = plant.robot.reduced(commanded.q, rigid + passive + effects)
        return Oracle(commanded, check_finite(plant.robot.name, tau, "torque")), None


def rigid_torque(mj: mujoco.MjModel, motion: Trajectory) -> Array:
    """Return M(q) a + bias(q, v) (N, nv) by MuJoCo; M contains the armature (rotor inertia)."""
    data, tau = mujoco.MjData(mj), np.empty_like(motion.v)
    bias, M = np.empty_like(tau), np.empty((CHUNK, mj.nv, mj.nv))
    for start in range(0, len(motion), CHUNK):
        part = range(start, min(start + CHUNK, len(motion)))
        for k in part:
            # M and the bias depend on positions and velocities alone; a is multiplied below.
            data.qpos[:], data.qvel[:] = motion.q[k], motion.v[k]
            mujoco.mj_fwdPosition(mj, data)
            mujoco.mj_fwdVelocity(mj, data)
            bias[k] = data.qfrc_bias
            mujoco.mj_fullM(mj, data, M[k - start])
        chunk = slice(part.start, part.stop)
        tau[chunk] = np.einsum("nij,nj->ni", M[: len(part)], motion.a[chunk]) + bias[chunk]
    return tau


def joint_positions(robot: RobotModel, motion: Trajectory) -> Array:
    """Return the positions (N, nv) of hinges and slides (rad, m), by degree of freedom; zero for
    other joints."""
    q = np.zeros_like(motion.v)
    for joint in robot.joints:
        if joint.kind in ("hinge", "slide"):
            q[:, joint.vadr] = motion.q[:, joint.qadr]
    return q


def inverse_torque(robot: RobotModel, motion: Trajectory) -> Array:
    """Return M a + bias (N, nv) by `mj_inverse`, without passive and constraint forces."""
    with recorded_warnings():
        mj = contact_free(robot.spec.copy().compile())
    # Passive forces are disabled, not subtracted: the damping of 1e11 that some models use to fix a
    # joint would cancel all digits.
    bits = mujoco.mjtDisableBit
    for bit in (bits.mjDSBL_SPRING, bits.mjDSBL_DAMPER, bits.mjDSBL_FRICTIONLOSS):
        mj.opt.disableflags |= int(bit)
    data = mujoco.MjData(mj)
    tau = np.empty_like(motion.v)
    for k in range(len(motion)):
        data.qpos[:], data.qvel[:], data.qacc[:] = motion.q[k], motion.v[k], motion.a[k]
        mujoco.mj_inverse(mj, data)
        tau[k] = data.qfrc_inverse + data.qfrc_passive + data.qfrc_constraint
    return tau


def independent_rows(robot: RobotModel, motion: Trajectory, tree: Array) -> tuple[Array, float]:
    """Return the rows (N, n, ...) of a motion of closed chains that the independent joints alone
    drive, from those of the tree (N, nv, ...): M a + bias - J^T f from torques; and the largest
    violation of a constraint (rad, m).

    The constraint forces f follow from zero torque on the dependent joints, with MuJoCo's
    constraint Jacobian J.
    """
    coupling = robot.coupling
    assert coupling is not None
    with recorded_warnings():
        mj = contact_free(robot.spec.copy().compile())
    mj.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EQUALITY)
    mj.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
    data = mujoco.MjData(mj)
    rows, violation = tree[:, coupling.independent], 0.0
    for k in range(len(motion)):
        data.qpos[:] = motion.q[k]
        mujoco.mj_fwdPosition(mj, data)
        equality = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        J = data.efc_J.reshape(data.nefc, mj.nv)[equality]
        violation = max(violation, float(np.abs(data.efc_pos[equality]).max(initial=0.0)))
        force = np.linalg.lstsq(J[:, coupling.dependent].T, tree[k, coupling.dependent])[0]
        rows[k] -= J[:, coupling.independent].T @ force
    return rows, violation
