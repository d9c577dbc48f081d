"""Joint torques and contact wrenches from a force/torque sensor: the reordered Newton-Euler.

With the base at the link beta where an unknown wrench acts, and the wrench f_b of the sensor and
the parameters phi of the sub-tree known (Traversaro et al. 2015, section III):

    f_beta = X (Y_n phi - f_b)                    the external wrench on beta
    tau_j  = Y_c(b)_j phi - [beta behind j] M_j (Y_n phi - f_b)
           = Y_c(beta)_j phi + [beta behind j] M_j f_b

Torques are those of the rigid bodies, as a sensor between gear and link has them: no friction, no
rotor. A joint before the sensor needs the parameters of the links between it and the sensor too,
which this sensor does not tell: tau_j = M_j f_b + Y_j phi_upstream.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorCut, instruments_of
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.regressors.wrench import SubtreeRegressors, sub_tree, subtree_dofs
from sysid_bench.types import Array, Trajectory


@dataclass(frozen=True, eq=False)
class SensorNewtonEuler:
    """The method along one motion, with the contact at the body `base` (None: no contact, and the
    sensor's wrench is not needed behind it)."""

    tree: SubtreeRegressors
    base: str | None
    X: Array | None  # (N, 6, 6)
    M: Array | None  # (N, k, 6)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the parameters (p,) behind the sensor."""
        return self.tree.columns

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the degrees of freedom (k,) behind the sensor."""
        return self.tree.rows

    def external_wrench(self, phi: Array, f_b: Array) -> Array:
        """f_beta (N, 6) [n; f] at the origin of the base, in its axes; phi (p,), f_b (N, 6)."""
        if self.X is None:
            return np.zeros_like(f_b)
        return np.asarray(np.einsum("nij,nj->ni", self.X, self.tree.Y_n @ phi - f_b))

    def joint_torque(self, phi: Array, f_b: Array) -> Array:
        """tau (N, k) of the joints behind the sensor."""
        tau = self.tree.Y_c @ phi
        if self.M is None:
            return np.asarray(tau)
        return np.asarray(tau - np.einsum("nkc,nc->nk", self.M, self.tree.Y_n @ phi - f_b))


def sensor_newton_euler(
    robot: RobotModel, cut: SensorCut, motion: Trajectory, base: str | None = None
) -> SensorNewtonEuler:
    """The method with its base at the body `base` behind a sensor, along a motion."""
    tree = sub_tree(robot, cut, motion)
    if base is None:
        return SensorNewtonEuler(tree, None, None, None)
    return SensorNewtonEuler(tree, base, tree.wrench_transform(base), tree.jacobian(base))


def upstream_torque(
    robot: RobotModel, cut: SensorCut, motion: Trajectory, phi: Array, f_b: Array
) -> tuple[tuple[str, ...], Array]:
    """Names and torques tau (N, u) of the joints that carry the sensor: its wrench f_b (N, 6), and
    what the bodies before it weigh, phi (nb, 10) of the whole robot (those behind are not used)."""
    instruments = instruments_of(robot, (cut,))
    whole = instruments.motion(motion)
    link = int(instruments.tree.carrier[cut.body])
    behind = {*subtree_dofs(robot, cut), *instruments.root(cut)}
    dofs = [int(dof) for dof in instruments.tree.links[link].dofs if dof not in behind]
    before = phi.copy()
    for body in range(len(phi)):
        if body in _distal_bodies(robot, cut):
            before[body] = 0.0
    tau = newton_euler(instruments.tree, instruments.tree.composite_links(before), whole)[:, dofs]
    M = sub_tree(robot, cut, motion).link_jacobian(link, dofs)
    return tuple(robot.rows[dof] for dof in dofs), tau + np.einsum("nuc,nc->nu", M, f_b)


def _distal_bodies(robot: RobotModel, cut: SensorCut) -> set[int]:
    """Bodies behind a sensor, those behind further sensors too: their wrench is in its reading."""
    inside = {cut.body}
    for b in range(cut.body + 1, len(robot.body_names)):
        if int(robot.mj.body_parentid[b + 1]) - 1 in inside:
            inside.add(b)
    return inside


@dataclass(frozen=True)
class WrenchErrors:
    """RMS errors of one set of parameters: torque of the joints behind the sensor with the base at
    the contact (N m, N), the same from the parameters alone while nothing touches, and force (N)
    and moment (N m) of the contact."""

    torque: float
    torque_alone: float
    force: float
    moment: float


def wrench_errors(
    method: SensorNewtonEuler, phis: Mapping[str, Array], f_b: Array, tau: Array, contact: Array
) -> dict[str, WrenchErrors]:
    """The parameter sets side by side, on a measured wrench f_b (N, 6); `tau` (N, k) and `contact`
    (N, 6) at the base are what really happened."""
    free = ~contact.any(axis=1)
    out = {}
    for name, phi in phis.items():
        wrench = method.external_wrench(phi, f_b) - contact
        alone = (method.tree.Y_c @ phi - tau)[free]
        out[name] = WrenchErrors(
            torque=_rms(method.joint_torque(phi, f_b) - tau),
            torque_alone=_rms(alone),
            force=_rms(wrench[:, 3:]),
            moment=_rms(wrench[:, :3]),
        )
    return out


def _rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).mean())) if errors.size else float("nan")
