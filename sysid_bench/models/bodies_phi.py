"""True inertial parameters of the bodies of a compiled model."""

from typing import Final

import mujoco
import numpy as np

from sysid_bench.spatial import matrix_of_quaternion, phi_of
from sysid_bench.types import Array

SAME: Final = int(mujoco.mjtSameFrame.mjSAMEFRAME_BODY)
ALIGNED: Final = (SAME, int(mujoco.mjtSameFrame.mjSAMEFRAME_BODYROT))
"""Marks of an inertial frame that MuJoCo takes for the body's, as a whole or in its rotation."""


def bodies_phi(mj: mujoco.MjModel) -> Array:
    """Return phi (nb, 10) about each body's frame, of MuJoCo's principal moments about the com."""
    rows = []
    for b in range(1, mj.nbody):
        R, com = _inertial_frame(mj, b)
        about_com = R @ np.diag(mj.body_inertia[b]) @ R.T
        rows.append(phi_of(float(mj.body_mass[b]), com, about_com))
    return np.array(rows)


def _inertial_frame(mj: mujoco.MjModel, b: int) -> tuple[Array, Array]:
    """Rotation R (3, 3) and position (m) of the inertial frame in the body's, as MuJoCo moves it:
    one that is within 1e-6 of the body's frame is taken for that frame."""
    same = int(mj.body_sameframe[b])
    R = np.eye(3) if same in ALIGNED else matrix_of_quaternion(np.array(mj.body_iquat[b]))
    return R, np.zeros(3) if same == SAME else np.array(mj.body_ipos[b])
