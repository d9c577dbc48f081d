"""Which way the regressor of coupled joints moves: G(q)^T Y_tree backwards.

Slopes are those by q, v, a of the whole tree, at the places of the joints that move what G itself
does there; `models.coupling.slopes.pulled` then hands those of the followers on.
"""

from dataclasses import replace

import numpy as np

from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.coupling.derivatives import Slopes, pull_back_follow
from sysid_bench.models.tree import Tree
from sysid_bench.regressors import adjoint
from sysid_bench.regressors.coupled import AnyRegression, CoupledRegression
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.types import Array, Trajectory


def smoothed(regression: AnyRegression) -> AnyRegression:
    """The same regression with a smooth sign for Coulomb friction."""
    if isinstance(regression, CoupledRegression):
        return replace(regression, tree=adjoint.smoothed(regression.tree))
    return adjoint.smoothed(regression)


def pull_back(regression: AnyRegression, motion: Trajectory, G: Array) -> Slopes:
    """Derivatives of sum(G * Y) by q, v, a (N, nv) of the tree; G (N, rows, p)."""
    if not isinstance(regression, CoupledRegression):
        return adjoint.pull_back(regression, motion, G)
    coupling, tree = regression.coupling, regression.tree
    moving = len(coupling.independent)
    weights = np.zeros((len(motion), len(tree.rows), len(tree.columns)))
    weights[:, regression.places] = G
    followed = np.einsum("ndi,nip->ndp", coupling.follow(motion.q), G[:, :moving])
    weights[:, coupling.dependent] += followed
    q, v, a = adjoint.pull_back(tree, motion, weights)
    if not coupling.constant:
        Y = tree.dense(motion).Y[:, coupling.dependent]
        own = pull_back_follow(coupling, motion, np.einsum("ndp,nip->ndi", Y, G[:, :moving]))
        q[:, : own.shape[1]] += own
    return q, v, a


def pull_back_torque(
    tree: Tree, coupling: Coupling | None, phi: Array, motion: Trajectory, U: Array
) -> Slopes:
    """Derivatives of sum(U * tau), U and tau (N, n) on the joints that move, tau the rigid-body
    torque of links with parameters phi (n_links, 10)."""
    if coupling is None:
        return adjoint.pull_back_torque(tree, phi, motion, U)
    whole = np.einsum("nij,nj->ni", coupling.G(motion.q), U)
    q, v, a = adjoint.pull_back_torque(tree, phi, motion, whole)
    if not coupling.constant:
        tau = newton_euler(tree, phi, motion)[:, coupling.dependent]
        q += pull_back_follow(coupling, motion, tau[:, :, None] * U[:, None])
    return q, v, a
