"""Identifiable subspaces of a sub-tree behind a force/torque sensor, and what data leave out.

I_Y is the orthogonal complement of all parameter changes that Y never shows (Traversaro et al.
2015, eq. 6). Lemma 1: I_Yn is the same for every base link. Proposition 1: what joint torques need,
I_Yc, lies inside of it, whatever the base. Both are about all motions: one data set may excite
less, and then the torques of joints that it never moved, or that carry those, cannot be foretold.
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
from sysid_bench.regressors.qr_accumulation import upper_factor
from sysid_bench.regressors.wrench import SubtreeRegressors, floating_subtree_regressors
from sysid_bench.types import Array, Trajectory

SEED: Final = 0
"""The same random states for everybody, as for the ranks of joint torques."""

UNPREDICTABLE: Final = 1e-3
"""A joint whose torque has a larger share of its parameters (sine of the angle) outside of what the
data tell cannot be foretold; exact geometry leaves 1e-12, noisy rates of a moving joint 1e-6."""


@dataclass(frozen=True, eq=False)
class Subspaces:
    """Orthonormal bases in the space of the p parameters `columns`: `wrench` (p, r) of I_Yn at the
    sensor; by base link, `wrenches` of I_Yn and `torques` of I_Yc; by degree of freedom, `joints`
    of what its torque needs with the base at the sensor or behind it."""

    columns: tuple[str, ...]
    wrench: Array
    wrenches: Mapping[str, Array]
    torques: Mapping[str, Array]
    joints: Mapping[str, Array]
    singular_values: Array

    @property
    def rank(self) -> int:
        """Base parameters of the wrench."""
        return self.wrench.shape[1]

    @property
    def sensor_subspace(self) -> float:
        """Lemma 1: the largest sine of an angle between I_Yn of two bases (1: of other size)."""
        return max(
            (subspace_sine(self.wrench, other) for other in self.wrenches.values()),
            default=0.0,
        )

    @property
    def joint_subspace(self) -> float:
        """Proposition 1: the largest part of a unit vector of I_Yc, any base, outside of I_Yn."""
        return max(
            (projection_residual(self.wrench, other) for other in self.torques.values()),
            default=0.0,
        )


def structural_subspaces(
    robot: RobotModel, cut: SensorCut, bases: tuple[str, ...] | None = None
) -> Subspaces:
    """The subspaces of all motions: random poses, twists and accelerations of the sensor's link and
    random joint states, for the base at every body that moves on its own (or only at `bases`)."""
    alone = floating_subtree(robot, cut)
    p = 10 * len(cut.bodies)
    motion = _floating_states(robot, alone, 40 + p // 5, np.random.default_rng(SEED))
    made = floating_subtree_regressors(robot, alone, motion)
    all_of_it, _ = row_space(np.concatenate([made.Y_n, made.Y_c], axis=1))
    Y_n, Y_c = made.Y_n @ all_of_it, made.Y_c @ all_of_it
    wrench, values = row_space(Y_n)[0], row_space(made.Y_n)[1]
    factors = _joint_factors(robot, made, Y_n, Y_c)
    chosen = _moving_bodies(robot, cut) if bases is None else bases
    wrenches, torques = {}, {}
    for base in chosen:
        wrenches[base] = all_of_it @ row_space(made.wrench_transform(base) @ Y_n)[0]
        behind = _dofs_before(robot, cut, base)
        parts = [factor[dof in behind] for dof, factor in zip(made.dofs, factors, strict=True)]
        torques[base] = all_of_it @ _span_of(parts, Y_n.shape[-1])
    joints = {
        row: all_of_it @ _span_of(factor, Y_n.shape[-1])
        for row, factor in zip(made.rows, factors, strict=True)
    }
    return Subspaces(made.columns, all_of_it @ wrench, wrenches, torques, joints, values)


def _joint_factors(
    robot: RobotModel, made: SubtreeRegressors, Y_n: Array, Y_c: Array
) -> list[tuple[Array, Array]]:
    """For each degree of freedom R of its row of Y_c with the base before it, and behind it: which
    link behind does not matter."""
    factors = []
    for i, dof in enumerate(made.dofs):
        link = next(k for k, link in enumerate(made.tree.links) if dof in link.dofs)
        M = made.link_jacobian(link, (dof,))
        rows = Y_c[:, i], Y_c[:, i] - (M @ Y_n)[:, 0]
        factors.append((upper_factor([rows[0]]), upper_factor([rows[1]])))
    return factors


def _dofs_before(robot: RobotModel, cut: SensorCut, base: str) -> set[int]:
    """Degrees of freedom between the world and a body of the sub-tree."""
    body = robot.body_names.index(base)
    link = int(robot.tree.carrier[body])
    return set() if link < 0 else set(robot.tree.links[link].dofs.tolist())


def _span_of(factors: Sequence[Array], size: int) -> Array:
    return row_space(np.concatenate([np.zeros((1, size)), *factors]))[0]


def _floating_states(
    robot: RobotModel, alone: FloatingSubtree, count: int, rng: np.random.Generator
) -> Trajectory:
    """Random states of a sub-tree on its own: joints within their limits (narrow ones beyond, as
    for the ranks of joint torques), any base motion."""
    states = random_states(robot, count, rng, NARROWEST)
    turn = rng.normal(size=(count, 4))
    place = rng.normal(size=(count, 3))
    free = np.hstack([place, turn / np.linalg.norm(turn, axis=1, keepdims=True)])
    rates = rng.normal(size=(2, count, 6))
    return Trajectory(
        states.t,
        np.hstack([states.q, free]),
        np.hstack([states.v, rates[0]]),
        np.hstack([states.a, rates[1]]),
        "random states of a sub-tree",
    )


def _moving_bodies(robot: RobotModel, cut: SensorCut) -> tuple[str, ...]:
    """The bodies of a sub-tree that joints move, the sensor's first: welded ones tell no more."""
    moving = {link.body for link in robot.tree.links}
    return tuple(robot.body_names[b] for b in cut.bodies if b == cut.body or b in moving)


def row_space(Y: Array) -> tuple[Array, Array]:
    """An orthonormal basis (p, r) of the row space of Y (..., p), and the singular values (SI
    columns, relative to the largest: see `RANK_TOLERANCE`)."""
    p = Y.shape[-1]
    R = upper_factor([np.zeros((1, p)), Y.reshape(-1, p)])
    _, values, Vt = np.linalg.svd(R, full_matrices=False)
    rank = int((values > RANK_TOLERANCE * values.max(initial=0.0)).sum())
    return Vt[:rank].T, values


def projection_residual(basis: Array, other: Array) -> float:
    """The largest part of a unit vector of `other` (p, k) that lies outside of `basis` (p, r)."""
    if other.shape[1] == 0:
        return 0.0
    rest = other - basis @ (basis.T @ other)
    return float(np.linalg.norm(rest, 2))


def subspace_sine(left: Array, right: Array) -> float:
    """The sine of the largest principal angle of two subspaces; 1 where their sizes differ."""
    if left.shape != right.shape:
        return 1.0
    return max(projection_residual(left, right), projection_residual(right, left))


@dataclass(frozen=True, eq=False)
class Excitation:
    """What one data set tells of a sub-tree: `rank` of the `structural` directions, and for each
    degree of freedom the share of what its torque needs that lies outside of the data."""

    rank: int
    structural: int
    missing: Mapping[str, float]

    @property
    def complete(self) -> bool:
        """Whether the data tell all that any motion can."""
        return self.rank == self.structural

    @property
    def unpredictable(self) -> tuple[str, ...]:
        """Degrees of freedom whose torque these data cannot foretell in other motions."""
        return tuple(name for name, share in self.missing.items() if not share <= UNPREDICTABLE)

    @property
    def warning(self) -> str:
        """One sentence for people; empty where nothing is missing."""
        if self.complete:
            return ""
        names = ", ".join(self.unpredictable)
        torques = f"the torques of {names} cannot be foretold" if names else "no torque suffers"
        return (
            f"These data excite {self.rank} of {self.structural} base parameters of the sub-tree: "
            f"{torques} in other motions; move all joints behind the sensor, and the sensor itself."
        )


def excitation_of(data: SubtreeRegressors | Array, subspaces: Subspaces) -> Excitation:
    """What a data set (its sub-tree, or rows (..., p) of its Y_n) leaves out of the structure."""
    rows = data.Y_n if isinstance(data, SubtreeRegressors) else data
    if rows.shape[-1] != len(subspaces.columns):
        raise UsageError(
            f"The data have {rows.shape[-1]} columns; the sub-tree has {len(subspaces.columns)}."
        )
    told, _ = row_space(rows)
    missing = {joint: projection_residual(told, basis) for joint, basis in subspaces.joints.items()}
    return Excitation(told.shape[1], subspaces.rank, missing)
