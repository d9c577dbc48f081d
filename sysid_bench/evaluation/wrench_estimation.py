"""Joint torques and contact wrenches from a force/torque sensor: reordered Newton-Euler equations.

The base is the link beta on which an unknown external wrench acts; the wrench f_b of the sensor and
the parameters phi of the sub-tree are known (Traversaro et al. 2015, section III):

    f_beta = X (Y_n phi - f_b)                    external wrench on beta
    tau_j  = Y_c(b)_j phi - [beta distal to j] J_j (Y_n phi - f_b)
           = Y_c(beta)_j phi + [beta distal to j] J_j f_b

Behind coupled joints tau are the torques of the drives: rows of Y_c and J are mapped by G(q)^T.

Torques are those of rigid bodies, as measured between gear and link: without friction and rotor
inertia. The torque of a joint proximal to the sensor, tau_j = J_j f_b + Y_j phi_upstream, also
needs the parameters of the links between the joint and the sensor, which this sensor cannot
identify.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sysid_bench.evaluation.torque_errors import rms
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorSubtree
from sysid_bench.regressors.wrench import (
    SubtreeDrives,
    SubtreeRegressor,
    subtree_drives,
    subtree_regressor,
)
from sysid_bench.types import Array, Trajectory


@dataclass(frozen=True, eq=False)
class SensorNewtonEuler:
    """The equations along one motion, with an external wrench on the body `base`; None: no external
    wrench, so that the torques do not need the sensor.

    `tree`: the sub-tree, with its `drives`; X (N, 6, 6) transforms wrenches from the sensor to the
    base, J (N, k, 6) maps wrenches at the sensor to torques of the k drives between the sensor and
    the base, Y_c (N, k, p) are their torques with the base at the sensor.
    """

    tree: SubtreeRegressor
    drives: SubtreeDrives
    Y_c: Array
    base: str | None
    X: Array | None
    J: Array | None

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the parameters (p,) distal to the sensor."""
        return self.tree.columns

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the drives (k,) distal to the sensor: independent degrees of freedom."""
        return self.drives.rows

    @property
    def _is_force(self) -> Array:
        """Mask (k,) of the drives that are slides, in N."""
        return np.array([unit.endswith(" N") for unit in self.drives.units], dtype=bool)

    def contact_wrench(self, phi: Array, f_b: Array) -> Array:
        """Return f_beta (N, 6) [n; f] (N m, N) at the origin of the base, in its axes.

        phi (p,) are the parameters, f_b (N, 6) the measured wrench [n; f] in the sensor frame.
        """
        if self.X is None:
            return np.zeros_like(f_b)
        return np.asarray(np.einsum("nij,nj->ni", self.X, self.tree.Y_n @ phi - f_b))

    def joint_torque(self, phi: Array, f_b: Array) -> Array:
        """Return the torques tau (N, k) of the drives distal to the sensor; arguments as for
        `external_wrench`."""
        tau = self.Y_c @ phi
        if self.J is None:
            return np.asarray(tau)
        return np.asarray(tau - np.einsum("nkc,nc->nk", self.J, self.tree.Y_n @ phi - f_b))


def sensor_newton_euler(
    robot: RobotModel, cut: SensorSubtree, motion: Trajectory, base: str | None = None
) -> SensorNewtonEuler:
    """Return the equations along a motion, with the external wrench on the body `base` distal to
    the sensor (None: no external wrench); raises UsageError for any other body."""
    tree = subtree_regressor(robot, cut, motion)
    drives = subtree_drives(robot, cut, motion.q)
    Y_c = drives.reduced(tree.Y_c)
    if base is None:
        return SensorNewtonEuler(tree, drives, Y_c, None, None, None)
    J = drives.reduced(tree.jacobian(base))
    return SensorNewtonEuler(tree, drives, Y_c, base, tree.wrench_transform(base), J)


@dataclass(frozen=True)
class WrenchErrors:
    """RMS errors of one set of parameters.

    `torque`: hinges distal to the sensor, base at the contact (N m); `torque_alone`: the same from
    the parameters alone, without contact; `slide`, `slide_alone`: the same of slides (N);
    `force` (N) and `moment` (N m) of the contact wrench. NaN where there is no such drive.
    """

    torque: float
    torque_alone: float
    slide: float
    slide_alone: float
    force: float
    moment: float


def wrench_errors(
    method: SensorNewtonEuler, phis: Mapping[str, Array], f_b: Array, tau: Array, contact: Array
) -> dict[str, WrenchErrors]:
    """Return the errors of several parameter sets {name: phi (p,)} for a measured wrench f_b (N,
    6).

    `tau` (N, k) and `contact` (N, 6), the external wrench at the base, are the ground truth.
    """
    # Parameters alone cannot predict the torque of an unknown contact.
    free = ~contact.any(axis=1)
    out = {}
    for name, phi in phis.items():
        wrench = method.contact_wrench(phi, f_b) - contact
        alone = (method.Y_c @ phi - tau)[free]
        # Hinges and slides apart: N m and N have no common RMS.
        torque, slide = method.joint_torque(phi, f_b) - tau, method._is_force
        out[name] = WrenchErrors(
            torque=rms(torque[:, ~slide]),
            torque_alone=rms(alone[:, ~slide]),
            slide=rms(torque[:, slide]),
            slide_alone=rms(alone[:, slide]),
            force=rms(wrench[:, 3:]),
            moment=rms(wrench[:, :3]),
        )
    return out
