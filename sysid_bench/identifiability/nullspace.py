"""Structural nullspace of the inertial parameters, computed from the tree without sampling motions.

Recursive parameter nullspace algorithm of Wensing, Niemeyer and Slotine ("A geometric
characterization of observability in inertial parameter identification", IJRR 2024). A parameter
change is unobservable iff it leaves kinetic energy and gravity potential unchanged up to a
constant; every such change is a sum of *transfers* of inertia from a link to its parent across one
joint. Unobservable transfers follow from two subspaces that are propagated from the base to the
tips:

- L, the attainable twists of the link;
- F, the functionals of phi (10,) that energy and potential of the link can take.

A joint with twist Phi closes both under its motion: span{exp(q A) x} is the smallest subspace that
contains x and is invariant under the generator A. A transfer phi is unobservable iff the
functionals A cl(F), b(cl(L), Phi) and b(Phi, Phi) vanish on it, with b(u, w) = u^T I(phi) w.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np

from sysid_bench.models.tree import BALL, FREE, HINGE, Tree, TreeJoint
from sysid_bench.spatial import (
    inertia_matrix,
    inertia_transform,
    phi_of_pseudo_inertia,
    pseudo_inertia,
    skew,
)
from sysid_bench.types import Array

SMALL: Final = 1e-9
"""Relative singular value: smaller ones come from rounded angles in model files."""


def parameter_nullspace(tree: Tree) -> Array:
    """Return an orthonormal basis (10 nb, k) of the unobservable changes of inertial parameters.

    The tree is taken without joint couplings; rows are its bodies, ten parameters each. 10 nb - k
    is the rank of the joint torque regressor over all motions.
    """
    count = len(tree.carrier)
    changes = [np.zeros((10 * count, 0)), *_across_joints(tree)]
    bodies = [*(link.body for link in tree.links), None]
    for body, carrier in enumerate(tree.carrier):
        if body not in bodies:  # welded: all of its parameters act through its carrier
            changes.append(_transfers(tree, body, bodies[carrier], tree.X[body], np.eye(10)))
    return np.linalg.qr(np.column_stack(changes))[0]


def structural_rank(tree: Tree) -> int:
    """Return the number of inertial base parameters of a tree without joint couplings."""
    nullspace = parameter_nullspace(tree)
    return int(nullspace.shape[0] - nullspace.shape[1])


def _across_joints(tree: Tree) -> Iterator[Array]:
    """Unobservable transfers (10 nb, t) from each link to its parent."""
    # The world is at index -1: it does not move, and only gravity acts through it.
    bodies = [*(link.body for link in tree.links), None]
    # Potential -g . h of a body at rest in the world, as a functional (10, 0 or 1).
    g = tree.gravity[:, None]
    potential = np.zeros((10, int(tree.gravity.any())))
    if tree.gravity.any():
        potential[1:4] = g / np.linalg.norm(g)
    reached = [(np.zeros((6, 0)), potential)] * (len(tree.links) + 1)  # (L, F)
    for i, link in enumerate(tree.links):
        L, F = reached[link.parent]
        X = inertia_transform(link.R0, link.p0)
        # Twists of the parent in the frame (R0, p0) of the link before its joints move.
        w, v = L[:3], L[3:]
        L = np.vstack([link.R0.T @ w, link.R0.T @ (v + skew(link.p0).T @ w)])
        observed, L, F = _after_joints(link.joints, L, X.T @ F)
        reached[i] = L, F
        # What all functionals (10, f) vanish on: the orthogonal complement of their span.
        basis = _span(observed)
        left, _, _ = np.linalg.svd(basis, full_matrices=True)
        yield _transfers(tree, link.body, bodies[link.parent], X, left[:, basis.shape[1] :])


def _after_joints(joints: tuple[TreeJoint, ...], L: Array, F: Array) -> tuple[Array, Array, Array]:
    """(functionals that vanish on unobservable transfers, L, F) behind the joints of one body."""
    observed = np.zeros((10, 0))
    for joint in joints:
        if joint.kind == FREE:
            # A free joint moves in every way: nothing can be transferred across it.
            return np.eye(10), np.eye(6), np.eye(10)
        moved, mixed, L, F = _after_joint(_twists(joint), L, F)
        observed = _span(np.column_stack([observed, moved, mixed]))
    return observed, L, F


def _after_joint(twists: Array, L: Array, F: Array) -> tuple[Array, Array, Array, Array]:
    """Functionals A cl(F) and b(., Phi) of one joint with the twists Phi (6, dofs), and L and F
    behind it."""
    adjoints, rates, J = [], [], pseudo_inertia(np.eye(10))
    for twist in twists.T:
        w, v = skew(twist[:3]), skew(twist[3:])
        # -ad(twist): rate of a constant twist as seen from a frame that moves with the joint.
        adjoints.append(-np.block([[w, np.zeros((3, 3))], [v, w]]))
        H = np.zeros((4, 4))
        H[:3, :3], H[:3, 3] = w, twist[3:]
        # The same rate for functionals of phi, by dJ/dq = H J + J H^T of pseudo-inertias.
        rates.append(phi_of_pseudo_inertia(H @ J + J @ H.T))
    L, F = _closure(L, adjoints), _closure(F, rates)
    both = np.column_stack([L, twists])
    # b(u, w) of every attainable twist with every twist of the joint.
    mixed = np.asarray(np.einsum("iu,kij,jw->kuw", both, _INERTIAS, twists)).reshape(10, -1)
    moved = np.column_stack([A @ F for A in rates])
    return moved, mixed, _span(both), _span(np.column_stack([F, mixed]))


def _transfers(tree: Tree, body: int, parent: int | None, X: Array, phis: Array) -> Array:
    """Changes (10 nb, t) that transfer each column of phi (10, t) from a body to its parent."""
    changes = np.zeros((len(tree.carrier), 10, phis.shape[1]))
    changes[body] = phis
    if parent is not None:
        for t, phi in enumerate(phis.T):  # one product per column keeps the rounding of each
            changes[parent, :, t] -= X @ phi
    return changes.reshape(10 * len(changes), phis.shape[1])


def _twists(joint: TreeJoint) -> Array:
    """Twists [w; v] (6, dofs) of a joint at its reference, in the body frame."""
    if joint.kind == HINGE:
        axes = joint.axis[:, None]
    elif joint.kind == BALL:
        axes = np.eye(3)
    else:
        return np.concatenate([np.zeros(3), joint.axis])[:, None]
    return np.vstack([axes, np.cross(joint.anchor, axes.T).T])


_INERTIAS: Final = np.array(
    [
        np.block([[inertia_matrix(phi[4:]), skew(phi[1:4])], [-skew(phi[1:4]), phi[0] * np.eye(3)]])
        for phi in np.eye(10)
    ]
)
"""Spatial inertia I (10, 6, 6) of each unit phi, for twists [w; v]."""


def _closure(basis: Array, generators: list[Array]) -> Array:
    """Smallest subspace that contains `basis` and is invariant under every generator."""
    basis = _span(basis)
    while True:
        wider = _span(np.column_stack([basis, *(A @ basis for A in generators)]))
        if wider.shape[1] == basis.shape[1]:
            return basis
        basis = wider


def _span(vectors: Array) -> Array:
    """Orthonormal basis of the columns, which are normalised first."""
    norms = np.linalg.norm(vectors, axis=0)
    # Unit columns: lengths (m) and products of lengths (m^2) share one tolerance.
    vectors = vectors[:, norms > SMALL] / norms[norms > SMALL]
    if vectors.shape[1] == 0:
        return vectors
    left, values, _ = np.linalg.svd(vectors, full_matrices=False)
    return left[:, values > SMALL * values[0]]
