"""Identifiable subspaces of a sub-tree distal to a force/torque sensor, and their excitation.

I_Y is the orthogonal complement of the parameter changes that never affect Y (Traversaro et al.
2015, eq. 6). Lemma 1: I_Yn is the same for every base link. Proposition 1: I_Yc, on which the joint
torques depend, is a subspace of it, whatever the base. Both hold over all motions. One data set may
excite less; then the torques of joints that did not move, or that carry those, are unpredictable.

Proposition 1 assumes that the joints behind the sensor move independently. Where they are coupled,
the torque of a drive is a row of G(q)^T Y_c, which need not be in I_Yn (`sensor_certificate`).
"""

from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.identifiability.base_map import NARROWEST, RANK_TOLERANCE
from sysid_bench.models.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import COMPONENTS, SensorSubtree, floating_subtree
from sysid_bench.numerics import qr_factor
from sysid_bench.regressors.wrench import (
    SubtreeDrives,
    SubtreeRegressor,
    floating_subtree_regressor,
    subtree_drives,
)
from sysid_bench.spatial import skew
from sysid_bench.types import Array, Trajectory

SEED: Final = 0
"""Seed of the random states; fixed, as for the ranks of joint torques."""

UNPREDICTABLE: Final = 1e-3
"""Sine of the angle between a joint's subspace and that of the data above which its torque is
unpredictable. Exact geometry causes 1e-12, noisy rates of a moving joint 1e-6."""


@dataclass(frozen=True, eq=False)
class Subspaces:
    """Orthonormal bases of identifiable subspaces in the space of the p parameters `columns`.

    `wrench` (p, r): I_Yn at the sensor; `wrenches` and `torques`: I_Yn and I_Yc by base link;
    `joints`: by drive (an independent degree of freedom), the parameters on which its torque
    depends, with the base at the sensor or distal to the joints that it moves; `components`: by
    component of the wrench in the sensor frame. `partial`: drives that also move joints proximal to
    the sensor.
    """

    columns: tuple[str, ...]
    wrench: Array
    wrenches: Mapping[str, Array]
    torques: Mapping[str, Array]
    joints: Mapping[str, Array]
    components: Mapping[str, Array]
    singular_values: Array
    partial: tuple[str, ...] = ()

    @property
    def rank(self) -> int:
        """Number r of base parameters of the wrench."""
        return int(self.wrench.shape[1])


def structural_subspaces(
    robot: RobotModel, cut: SensorSubtree, bases: tuple[str, ...] | None = None
) -> Subspaces:
    """Return the identifiable subspaces over all motions, for the base at every body that a joint
    moves (or only at `bases`).

    They are computed from random poses, twists and accelerations of the sensor's link and random
    joint states.
    """
    subtree = floating_subtree_states(robot, cut)
    # All subspaces lie in the joint row space of Y_n and Y_c: computing there saves columns.
    basis, _ = row_space(np.concatenate([subtree.Y_n, subtree.Y_c], axis=1))
    Y_n = subtree.Y_n @ basis
    wrench, values = row_space(Y_n)[0], row_space(subtree.Y_n)[1]
    factors = _DriveFactors(subtree, Y_n, subtree.Y_c @ basis)
    wrenches, torques = {}, {}
    for base in _moved_bodies(robot, cut) if bases is None else bases:
        wrenches[base] = basis @ row_space(subtree.wrench_transform(base) @ Y_n)[0]
        # Degrees of freedom between the world and the base.
        link = int(robot.tree.carrier[robot.body_names.index(base)])
        proximal = set() if link < 0 else set(robot.tree.links[link].dofs.tolist())
        torques[base] = basis @ factors.span(proximal)
    joints = {row: basis @ factors.span_of_drive(i) for i, row in enumerate(factors.drives.rows)}
    # Components of the wrench are those in the sensor frame, not at the root.
    # Transform (6, 6) of wrenches from the frame of the sensor's body to that of the sensor
    X = np.zeros((6, 6))
    X[:3, :3] = X[3:, 3:] = cut.R.T
    X[:3, 3:] = -cut.R.T @ skew(cut.p)
    components = X @ subtree.wrench_transform(robot.body_names[cut.body]) @ Y_n
    return Subspaces(
        columns=subtree.columns,
        wrench=basis @ wrench,
        wrenches=wrenches,
        torques=torques,
        joints=joints,
        components={
            name: basis @ row_space(components[:, i])[0] for i, name in enumerate(COMPONENTS)
        },
        singular_values=values,
        partial=factors.drives.partial,
    )


def _moved_bodies(robot: RobotModel, cut: SensorSubtree) -> tuple[str, ...]:
    """Bodies that joints move, the sensor's first; welded ones add no information."""
    moving = {cut.body, *(link.body for link in robot.tree.links)}
    return tuple(robot.body_names[b] for b in cut.bodies if b in moving)


def floating_subtree_states(robot: RobotModel, cut: SensorSubtree) -> SubtreeRegressor:
    """Return the regressors of the sub-tree alone at random admissible states: coupled joints
    close, the sensor's link has a random pose, twist and acceleration."""
    alone = floating_subtree(robot, cut)
    count = 40 + 2 * len(cut.bodies)
    rng = np.random.default_rng(SEED)
    states = random_states(robot, count, rng, NARROWEST)
    # A normalised Gaussian is uniform on the sphere: uniform orientations.
    quaternion = rng.normal(size=(count, 4))
    position = rng.normal(size=(count, 3))
    free = np.hstack([position, quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)])
    rates = rng.normal(size=(2, count, 6))
    motion = Trajectory(
        states.t,
        np.hstack([states.q, free]),
        np.hstack([states.v, rates[0]]),
        np.hstack([states.a, rates[1]]),
        "random states of a sub-tree",
    )
    return floating_subtree_regressor(robot, alone, motion)


class _DriveFactors:
    """R factors of the torque of each drive, for any base; Y_n (N, 6, r) and Y_c (N, k, r)."""

    def __init__(self, subtree: SubtreeRegressor, Y_n: Array, Y_c: Array) -> None:
        self._subtree, self._Y_n = subtree, Y_n
        self.drives: SubtreeDrives = subtree_drives(subtree.robot, subtree.cut, subtree.motion.q)
        self._torques = self.drives.reduced(Y_c)
        self._found: dict[tuple[int, tuple[int, ...]], Array] = {}

    def span(self, proximal: AbstractSet[int]) -> Array:
        """Subspace on which the torques of all drives depend, with a base to which the degrees of
        freedom `proximal` are proximal."""
        return self._span(self._factor(i, proximal) for i in range(len(self.drives.rows)))

    def span_of_drive(self, drive: int) -> Array:
        """Subspace of one drive, with the base at the sensor, or distal to any of its joints."""
        moved = self.drives.joints(drive)
        sides = [set(), *({self._subtree.dofs[i]} for i in moved)]
        return self._span(self._factor(drive, side) for side in sides)

    def _factor(self, drive: int, proximal: AbstractSet[int]) -> Array:
        """R factor of g_k - sum_i G_ik J_i Y_n over the joints i of the drive in `proximal`: with
        the base distal to a joint, its torque balances all that is proximal."""
        reversed_joints = tuple(
            i for i in self.drives.joints(drive) if self._subtree.dofs[i] in proximal
        )
        key = drive, reversed_joints
        if key not in self._found:
            rows = self._torques[:, drive]
            for i in reversed_joints:
                # J_i Y_n of a joint is the same whichever of the links distal to it is the base.
                dof, links = self._subtree.dofs[i], self._subtree.tree.links
                link = next(k for k, link in enumerate(links) if dof in link.dofs)
                balance: Array = (self._subtree.link_jacobian(link, (dof,)) @ self._Y_n)[:, 0]
                rows = rows - self.drives.G[:, i, drive, None] * balance
            self._found[key] = qr_factor([rows])
        return self._found[key]

    def _span(self, factors: Iterable[Array]) -> Array:
        return row_space(np.concatenate([np.zeros((1, self._Y_n.shape[-1])), *factors]))[0]


def row_space(Y: Array, tolerance: float = RANK_TOLERANCE) -> tuple[Array, Array]:
    """Return an orthonormal basis (p, r) of the row space of Y (..., p), and the singular values.

    The rank r counts singular values above `tolerance` times the largest, in SI units.
    """
    p = Y.shape[-1]
    R = qr_factor([np.zeros((1, p)), Y.reshape(-1, p)])
    _, values, Vt = np.linalg.svd(R, full_matrices=False)
    rank = int((values > tolerance * values.max(initial=0.0)).sum())
    return Vt[:rank].T, values


def basis_residual(basis: Array, other: Array) -> float:
    """Return the norm of (I - B B^T) `other`, B = `basis` (p, r): the sine of the largest angle of
    a vector in span(`other`) (p, k) to span(`basis`); both bases are orthonormal."""
    if other.shape[1] == 0:
        return 0.0
    # The residual has small sines to full accuracy; cosines near one would lose half the digits.
    rest = other - basis @ (basis.T @ other)
    return float(np.linalg.norm(rest, 2))


@dataclass(frozen=True, eq=False)
class Excitation:
    """Excitation of a sub-tree by one data set: `rank` of `structural` base parameters.

    `missing` and `missing_wrench`: by drive and by component of the wrench, the sine of the angle
    between the subspace on which its torque, or the component, depends and the one that the data
    excite. `partial`: drives that also move joints proximal to the sensor, whose torques it never
    predicts.
    """

    rank: int
    structural: int
    missing: Mapping[str, float]
    missing_wrench: Mapping[str, float] = field(default_factory=dict)
    partial: tuple[str, ...] = ()

    @property
    def _is_complete(self) -> bool:
        """True if the data excite all base parameters of the wrench."""
        return self.rank == self.structural

    @property
    def predictable(self) -> tuple[str, ...]:
        """Drives whose torque in other motions these data determine."""
        return tuple(name for name, share in self.missing.items() if share <= UNPREDICTABLE)

    @property
    def unpredictable(self) -> tuple[str, ...]:
        """Drives whose torque in other motions these data do not determine."""
        lost = tuple(name for name in self.missing if name not in self.predictable)
        return lost + self.partial

    @property
    def unpredictable_wrench(self) -> tuple[str, ...]:
        """Components of the wrench, and so of a contact, that these data do not determine."""
        missing = self.missing_wrench.items()
        return tuple(name for name, share in missing if not share <= UNPREDICTABLE)

    @property
    def warning(self) -> str:
        """Warning to print; empty if all torques can be predicted and all base parameters of the
        wrench are excited."""
        names = ", ".join(self.unpredictable)
        if self._is_complete:
            return names and (
                f"The wrench of the sensor does not determine the torques of {names}, whatever the "
                "motion: the joints behind it are coupled; measure these torques, too."
            )
        torques = f"the torques of {names} are unpredictable" if names else "no torque is affected"
        return (
            f"These data excite {self.rank} of {self.structural} base parameters of the sub-tree: "
            f"{torques} in other motions; move all joints distal to the sensor, and the sensor "
            "itself."
        )


def excitation_of(data: SubtreeRegressor | Array, subspaces: Subspaces) -> Excitation:
    """Return the excitation by a data set, given as its regressors or as rows (..., p) of Y_n.

    Raises UsageError if the number of columns is not that of the sub-tree.
    """
    rows = data.Y_n if isinstance(data, SubtreeRegressor) else data
    if rows.shape[-1] != len(subspaces.columns):
        raise UsageError(
            f"The data have {rows.shape[-1]} columns, but the sub-tree {len(subspaces.columns)} "
            "parameters."
        )
    excited, _ = row_space(rows)
    missing = {joint: basis_residual(excited, basis) for joint, basis in subspaces.joints.items()}
    wrench = {name: basis_residual(excited, B) for name, B in subspaces.components.items()}
    return Excitation(excited.shape[1], subspaces.rank, missing, wrench, subspaces.partial)
