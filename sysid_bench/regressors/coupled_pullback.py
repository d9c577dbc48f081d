"""Adjoint of the regressor of coupled joints: reverse-mode derivatives of G(q)^T Y_tree.

Derivatives are by q, v and a of the whole tree. Those of G(q) are added at the independent joints;
`models.coupling.derivatives` then applies the chain rule to those of the dependent joints.
"""

from dataclasses import replace

import numpy as np

from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.coupling.pullback import Slopes, pullback_follow
from sysid_bench.models.tree import Tree
from sysid_bench.regressors import kernel_pullback
from sysid_bench.regressors.coupled import AnyRegression, CoupledRegression
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.types import Array, Trajectory


def smooth_regression(regression: AnyRegression) -> AnyRegression:
    """Return the regression with tanh(v / SMOOTH_RATE) in place of sign(v) in Coulomb friction."""
    if isinstance(regression, CoupledRegression):
        return replace(regression, tree=kernel_pullback.smooth_regression(regression.tree))
    return kernel_pullback.smooth_regression(regression)


def pullback(regression: AnyRegression, motion: Trajectory, G: Array) -> Slopes:
    """Return the derivatives of sum(G * Y) by q, v and a of the tree, (N, nv) each; G (N, rows,
    p) weights the entries of Y."""
    if not isinstance(regression, CoupledRegression):
        return kernel_pullback.pullback(regression, motion, G)
    coupling, tree = regression.coupling, regression.tree
    moving = len(coupling.independent)
    weights = np.zeros((len(motion), len(tree.rows), len(tree.columns)))
    weights[:, regression.tree_rows] = G
    followed = np.einsum("ndi,nip->ndp", coupling.follow(motion.q), G[:, :moving])
    weights[:, coupling.dependent] += followed
    q, v, a = kernel_pullback.pullback(tree, motion, weights)
    if not coupling.linear:
        # F(q) multiplies the dependent rows: its own derivative adds a term; constant F has none.
        Y = tree.dense(motion).Y[:, coupling.dependent]
        by_closure = pullback_follow(coupling, motion, np.einsum("ndp,nip->ndi", Y, G[:, :moving]))
        q[:, : by_closure.shape[1]] += by_closure
    return q, v, a


def pullback_torque(
    tree: Tree, coupling: Coupling | None, phi: Array, motion: Trajectory, U: Array
) -> Slopes:
    """Return the derivatives of sum(U * tau) by q, v and a of the tree, (N, nv) each.

    U (N, n) weights tau (N, n), the rigid-body torque on the independent joints of links with
    parameters phi (n_links, 10).
    """
    if coupling is None:
        return kernel_pullback.pullback_torque(tree, phi, motion, U)
    whole = np.einsum("nij,nj->ni", coupling.G(motion.q), U)
    q, v, a = kernel_pullback.pullback_torque(tree, phi, motion, whole)
    if not coupling.linear:
        tau = newton_euler(tree, phi, motion)[:, coupling.dependent]
        q += pullback_follow(coupling, motion, tau[:, :, None] * U[:, None])
    return q, v, a
