"""Inverse dynamics simulation: the exact torque along a given motion."""

from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch

from sysid_bench.simulation.plant import Plant, check_finite
from sysid_bench.types import Array, Controller, Oracle, Trajectory

CHUNK = 512
"""Samples per MuJoCo batch."""


@dataclass(frozen=True)
class Inverse:
    """Simulation in which the robot follows the motion exactly.

    tau = M a + bias + joint terms + effects; for coupled joints tau_ind = G^T tau on the
    independent ones.
    """

    def design_rate(self, recording: float) -> float:
        """Return the rate (Hz) at which the motion has to be sampled for a recording rate."""
        return recording

    def run(
        self, plant: Plant, commanded: Trajectory, encoder: Array
    ) -> tuple[Oracle, Controller | None]:
        """Return the exact motion and torques; there is no controller, so that the encoder error
        (N, n) has no effect on them."""
        tree = rigid_torque(plant.contact_free_model, commanded) + _passive_torque(plant, commanded)
        tau = plant.robot.reduced(commanded.q, tree)
        return Oracle(commanded, check_finite(plant.robot.name, tau, "torque")), None


def rigid_torque(mj: mujoco.MjModel, motion: Trajectory) -> Array:
    """Return M(q) a + bias(q, v) (N, nv) by MuJoCo; M contains the armature (rotor inertia)."""
    rows, columns, indices = _entries_of_M(mj)
    tau = np.empty_like(motion.v)
    batch = Batch(mj, min(CHUNK, len(motion)), nthread=1)
    q, v, bias, M = (batch.bind(name) for name in ("qpos", "qvel", "qfrc_bias", "M"))
    for start in range(0, len(motion), batch.nsim):
        part = slice(start, min(start + batch.nsim, len(motion)))
        n = part.stop - part.start
        q[:n], v[:n] = motion.q[part], motion.v[part]
        # M and the bias depend on positions and velocities alone; a is multiplied below.
        batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
        dense = np.zeros((n, mj.nv, mj.nv))
        dense[:, rows, columns] = dense[:, columns, rows] = M[:n, indices]
        tau[part] = np.einsum("nij,nj->ni", dense, motion.a[part]) + bias[:n]
    return tau


def _passive_torque(plant: Plant, motion: Trajectory) -> Array:
    """Torque (N, nv) of friction, offset, springs and effects, which the motors supply besides
    M a + bias."""
    terms, robot = plant.terms, plant.robot
    tau = terms.viscous * motion.v + terms.coulomb * np.sign(motion.v) + terms.offset
    for joint in robot.joints:
        if joint.kind in ("hinge", "slide"):
            deflection = motion.q[:, joint.qadr] - terms.spring_reference[joint.vadr]
            tau[:, joint.vadr] += terms.spring[joint.vadr] * deflection
    return np.asarray(tau + plant.extra(motion.t, motion.q, motion.v))


def _entries_of_M(mj: mujoco.MjModel) -> tuple[Array, Array, Array]:
    """Rows, columns and indices of MuJoCo's sparse lower triangle of M."""
    rows = np.repeat(np.arange(mj.nv), mj.M_rownnz)
    indices = np.concatenate(
        [np.arange(a, a + n) for a, n in zip(mj.M_rowadr, mj.M_rownnz, strict=True)]
    )
    return rows, np.array(mj.M_colind)[indices], indices
