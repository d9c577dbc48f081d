"""The structural nullspace of the inertial parameters, without sampling any motion.

After the recursive parameter nullspace algorithm of Wensing, Niemeyer and Slotine ("A geometric
characterization of observability in inertial parameter identification", IJRR 2024). No motion can
tell parameters apart iff they leave kinetic energy and gravity potential as they are, up to a
constant, and every such change is a sum of *transfers* of inertia from a link to its parent across
one joint. Which transfers go unnoticed depends on two subspaces that are carried down the tree:

- L, the twists that the link can have;
- F, the functionals of phi (10,) that energy and potential of the link can be.

A joint with twist Phi closes both under its own motion: span{exp(q A) x} is the smallest subspace
that holds x and is invariant under the generator A. A transfer phi is unnoticed iff the functionals
A cl(F), b(cl(L), Phi) and b(Phi, Phi) vanish on it, b(u, w) = u^T I(phi) w.
"""

from typing import Final

import numpy as np

from sysid_bench.models.tree import BALL, FREE, HINGE, Tree, TreeJoint
from sysid_bench.spatial.inertia import (
    matrix_of_six,
    phi_of_pseudo_inertia,
    pseudo_inertia,
    transport,
)
from sysid_bench.spatial.rotation import skew
from sysid_bench.types import Array

SMALL: Final = 1e-9
"""Relative to the largest; rounded angles of model files lie below, geometry above."""


def parameter_nullspace(tree: Tree) -> Array:
    """A basis (10 nb, k) of the parameter changes that no motion of an uncoupled tree can tell.

    Columns are orthonormal; rows are the bodies of the tree, ten each. 10 nb - k is the structural
    rank of the joint torque regressor.
    """
    changes: list[Array] = []
    seen: list[tuple[Array, Array]] = []  # (L, F) of each link
    own = {link.body: i for i, link in enumerate(tree.links)}
    body_of = [link.body for link in tree.links]
    count = len(tree.carrier)
    for link in tree.links:
        L, F = seen[link.parent] if link.parent >= 0 else (np.zeros((6, 0)), _gravity(tree))
        X = transport(link.R0, link.p0)
        told, L, F = _after_joints(link.joints, _in_frame(L, link.R0, link.p0), X.T @ F)
        seen.append((L, F))
        parent = body_of[link.parent] if link.parent >= 0 else None
        changes += _transfers(count, link.body, parent, X, _null(told))
    for body, carrier in enumerate(tree.carrier):
        if body not in own:
            rider_on = body_of[carrier] if carrier >= 0 else None
            changes += _transfers(count, body, rider_on, tree.X[body], np.eye(10))
    stacked = np.column_stack(changes) if changes else np.zeros((10 * count, 0))
    return np.linalg.qr(stacked)[0]


def structural_rank(tree: Tree) -> int:
    """Base parameters of the inertias of an uncoupled tree."""
    nullspace = parameter_nullspace(tree)
    return nullspace.shape[0] - nullspace.shape[1]


def _after_joints(joints: tuple[TreeJoint, ...], L: Array, F: Array) -> tuple[Array, Array, Array]:
    """(functionals that a transfer has to vanish on, L, F) after the joints of one body."""
    told = np.zeros((10, 0))
    for joint in joints:
        if joint.kind == FREE:
            return np.eye(10), np.eye(6), np.eye(10)
        twists = _twists(joint)
        on_twists, on_functionals = (
            [_adjoint(w) for w in twists.T],
            [_functional_rate(w) for w in twists.T],
        )
        L, F = _closure(L, on_twists), _closure(F, on_functionals)
        mixed = _bilinear(np.column_stack([L, twists]), twists)
        moved = np.column_stack([A @ F for A in on_functionals])
        told = _span(np.column_stack([told, moved, mixed]))
        L, F = _span(np.column_stack([L, twists])), _span(np.column_stack([F, mixed]))
    return told, L, F


def _transfers(count: int, body: int, parent: int | None, X: Array, phis: Array) -> list[Array]:
    """Changes (10 nb,) that take phi (10, t) from a body to the one that carries it."""
    changes = []
    for phi in phis.T:
        change = np.zeros(10 * count)
        change[10 * body : 10 * body + 10] = phi
        if parent is not None:
            change[10 * parent : 10 * parent + 10] -= X @ phi
        changes.append(change)
    return changes


def _gravity(tree: Tree) -> Array:
    """The potential -g . h of a body at rest in the world, as a functional (10, 0 or 1)."""
    if not tree.gravity.any():
        return np.zeros((10, 0))
    functional = np.zeros((10, 1))
    functional[1:4, 0] = tree.gravity / np.linalg.norm(tree.gravity)
    return functional


def _twists(joint: TreeJoint) -> Array:
    """Twists [w; v] (6, dofs) of a joint at its reference, in the body frame."""
    if joint.kind == HINGE:
        axes = joint.axis[:, None]
    elif joint.kind == BALL:
        axes = np.eye(3)
    else:
        return np.concatenate([np.zeros(3), joint.axis])[:, None]
    return np.vstack([axes, np.cross(joint.anchor, axes.T).T])


def _in_frame(L: Array, R: Array, p: Array) -> Array:
    """Twists (6, l) of the parent link as the frame (R, p) in it has them."""
    w, v = L[:3], L[3:]
    return np.vstack([R.T @ w, R.T @ (v + skew(p).T @ w)])


def _adjoint(twist: Array) -> Array:
    """d/dq of a constant twist seen from a frame that moves with `twist`: -ad (6, 6)."""
    w, v = skew(twist[:3]), skew(twist[3:])
    return -np.block([[w, np.zeros((3, 3))], [v, w]])


def _functional_rate(twist: Array) -> Array:
    """The same for functionals (10, 10): the derivative of the transport by the motion."""
    H = np.zeros((4, 4))
    H[:3, :3], H[:3, 3] = skew(twist[:3]), twist[3:]
    J = pseudo_inertia(np.eye(10))
    return phi_of_pseudo_inertia(H @ J + J @ H.T)


def _bilinear(U: Array, W: Array) -> Array:
    """Functionals b(u, w) (10, u w) of all columns of U (6, u) and W (6, w)."""
    return np.einsum("iu,kij,jw->kuw", U, _INERTIAS, W).reshape(10, -1)


def _spatial_inertias() -> Array:
    """I (10, 6, 6) of each unit phi, for twists [w; v]."""
    out = np.zeros((10, 6, 6))
    for k, phi in enumerate(np.eye(10)):
        h = skew(phi[1:4])
        out[k] = np.block([[matrix_of_six(phi[4:]), h], [-h, phi[0] * np.eye(3)]])
    return out


_INERTIAS: Final = _spatial_inertias()


def _closure(basis: Array, generators: list[Array]) -> Array:
    """The smallest subspace with `basis` that every generator maps into itself."""
    basis = _span(basis)
    while True:
        wider = _span(np.column_stack([basis, *(A @ basis for A in generators)]))
        if wider.shape[1] == basis.shape[1]:
            return basis
        basis = wider


def _span(vectors: Array) -> Array:
    """An orthonormal basis of the columns; each counts alike, however long it is."""
    norms = np.linalg.norm(vectors, axis=0)
    vectors = vectors[:, norms > SMALL] / norms[norms > SMALL]
    if vectors.shape[1] == 0:
        return vectors
    left, values, _ = np.linalg.svd(vectors, full_matrices=False)
    return left[:, values > SMALL * values[0]]


def _null(functionals: Array) -> Array:
    """An orthonormal basis (10, t) of the phis on which all functionals (10, f) vanish."""
    basis = _span(functionals)
    left, _, _ = np.linalg.svd(basis, full_matrices=True)
    return left[:, basis.shape[1] :]
