"""Identifiable subspaces of a sub-tree distal to a force/torque sensor, and their excitation.

I_Y is the orthogonal complement of the parameter changes that never affect Y (Traversaro et al.
2015, eq. 6). Lemma 1: I_Yn is the same for every base link. Proposition 1: I_Yc, on which the joint
torques depend, is a subspace of it, whatever the base. Both hold over all motions. One data set may
excite less; then the torques of joints that did not move, or that carry those, are unpredictable.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.identifiability.base_map import RANK_TOLERANCE
from sysid_bench.identifiability.structural import NARROWEST
from sysid_bench.models.random.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import FloatingSubtree, SensorCut, floating_subtree
from sysid_bench.qr_factor import upper_factor
from sysid_bench.regressors.wrench import SubtreeRegressor, floating_subtree_regressor
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
    `joints`: by degree of freedom, the parameters on which its torque depends, with the base at the
    sensor or distal to the joint.
    """

    columns: tuple[str, ...]
    wrench: Array
    wrenches: Mapping[str, Array]
    torques: Mapping[str, Array]
    joints: Mapping[str, Array]
    singular_values: Array

    @property
    def rank(self) -> int:
        """Number r of base parameters of the wrench."""
        return int(self.wrench.shape[1])


def structural_subspaces(
    robot: RobotModel, cut: SensorCut, bases: tuple[str, ...] | None = None
) -> Subspaces:
    """Return the identifiable subspaces over all motions, for the base at every body that a joint
    moves (or only at `bases`).

    They are computed from random poses, twists and accelerations of the sensor's link and random
    joint states.
    """
    alone = floating_subtree(robot, cut)
    p = 10 * len(cut.bodies)
    motion = _floating_states(robot, alone, 40 + p // 5, np.random.default_rng(SEED))
    subtree = floating_subtree_regressor(robot, alone, motion)
    # All subspaces lie in the joint row space of Y_n and Y_c: computing there saves columns.
    basis, _ = row_space(np.concatenate([subtree.Y_n, subtree.Y_c], axis=1))
    Y_n, Y_c = subtree.Y_n @ basis, subtree.Y_c @ basis
    wrench, values = row_space(Y_n)[0], row_space(subtree.Y_n)[1]
    factors = _joint_factors(subtree, Y_n, Y_c)
    chosen = _moving_bodies(robot, cut) if bases is None else bases
    wrenches, torques = {}, {}
    for base in chosen:
        wrenches[base] = basis @ row_space(subtree.wrench_transform(base) @ Y_n)[0]
        proximal = _proximal_dofs(robot, base)
        parts = [factor[dof in proximal] for dof, factor in zip(subtree.dofs, factors, strict=True)]
        torques[base] = basis @ _span_of(parts, Y_n.shape[-1])
    joints = {
        row: basis @ _span_of(factor, Y_n.shape[-1])
        for row, factor in zip(subtree.rows, factors, strict=True)
    }
    return Subspaces(subtree.columns, basis @ wrench, wrenches, torques, joints, values)


def _joint_factors(subtree: SubtreeRegressor, Y_n: Array, Y_c: Array) -> list[tuple[Array, Array]]:
    """R factors of the row of Y_c of each degree of freedom, with the base proximal and distal to
    it; which of the distal links is the base does not matter."""
    factors = []
    for i, dof in enumerate(subtree.dofs):
        link = next(k for k, link in enumerate(subtree.tree.links) if dof in link.dofs)
        J = subtree.link_jacobian(link, (dof,))
        # With the base distal to the joint, its torque balances all that is proximal.
        rows = Y_c[:, i], Y_c[:, i] - (J @ Y_n)[:, 0]
        factors.append((upper_factor([rows[0]]), upper_factor([rows[1]])))
    return factors


def _proximal_dofs(robot: RobotModel, base: str) -> set[int]:
    """Degrees of freedom between the world and the body `base`."""
    body = robot.body_names.index(base)
    link = int(robot.tree.carrier[body])
    return set() if link < 0 else set(robot.tree.links[link].dofs.tolist())


def _span_of(factors: Sequence[Array], size: int) -> Array:
    return row_space(np.concatenate([np.zeros((1, size)), *factors]))[0]


def _floating_states(
    robot: RobotModel, alone: FloatingSubtree, count: int, rng: np.random.Generator
) -> Trajectory:
    """Random states of an isolated sub-tree with a free base: joints within their limits, but at
    least over `NARROWEST`."""
    states = random_states(robot, count, rng, NARROWEST)
    # A normalised Gaussian is uniform on the sphere: uniform orientations.
    quaternion = rng.normal(size=(count, 4))
    position = rng.normal(size=(count, 3))
    free = np.hstack([position, quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)])
    rates = rng.normal(size=(2, count, 6))
    return Trajectory(
        states.t,
        np.hstack([states.q, free]),
        np.hstack([states.v, rates[0]]),
        np.hstack([states.a, rates[1]]),
        "random states of a sub-tree",
    )


def _moving_bodies(robot: RobotModel, cut: SensorCut) -> tuple[str, ...]:
    """Bodies of a sub-tree that joints move, the sensor's first; welded ones add no information."""
    moving = {link.body for link in robot.tree.links}
    return tuple(robot.body_names[b] for b in cut.bodies if b == cut.body or b in moving)


def row_space(Y: Array) -> tuple[Array, Array]:
    """Return an orthonormal basis (p, r) of the row space of Y (..., p), and the singular values.

    The rank r counts singular values above `RANK_TOLERANCE` times the largest, in SI units.
    """
    p = Y.shape[-1]
    R = upper_factor([np.zeros((1, p)), Y.reshape(-1, p)])
    _, values, Vt = np.linalg.svd(R, full_matrices=False)
    rank = int((values > RANK_TOLERANCE * values.max(initial=0.0)).sum())
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

    `missing`: by degree of freedom, the sine of the angle between the subspace on which its torque
    depends and the one that the data excite.
    """

    rank: int
    structural: int
    missing: Mapping[str, float]

    @property
    def _is_complete(self) -> bool:
        """True if the data excite all base parameters of the wrench."""
        return self.rank == self.structural

    @property
    def unpredictable(self) -> tuple[str, ...]:
        """Degrees of freedom whose torque in other motions these data do not determine."""
        return tuple(name for name, share in self.missing.items() if not share <= UNPREDICTABLE)

    @property
    def warning(self) -> str:
        """Warning to print; empty if all base parameters are excited."""
        if self._is_complete:
            return ""
        names = ", ".join(self.unpredictable)
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
    return Excitation(excited.shape[1], subspaces.rank, missing)
