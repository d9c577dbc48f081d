"""Adjoint of the regressor kernel: reverse-mode derivatives of Y along whole motions.

For weights G (N, rows, p), `pullback` returns the derivatives of sum(G * Y) by q, v and a of every
sample. One forward and one backward sweep over the tree suffice, whatever the number of parameters
(reverse accumulation; Griewank and Walther 2008). Derivatives by the coordinates of
free and ball joints are left zero, since designed motions hold these joints still.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.models.coupling.pullback import Slopes
from sysid_bench.models.tree import BALL, FREE, HINGE, Link, Tree, TreeJoint
from sysid_bench.regressors.regression import SMOOTH_RATE, Regression
from sysid_bench.spatial import matrix_of_quaternion
from sysid_bench.types import Array, Trajectory

# Derivative of each joint term by (q, v, a) of its joint; the terms are those of TERM. Coulomb
# friction counts as constant: sign(v) has no useful derivative.
_SLOPE: Final[dict[str, Callable[[Array], Slopes]]] = {
    "fv": lambda v: (0 * v, np.ones_like(v), 0 * v),
    "fc": lambda v: (0 * v, 0 * v, 0 * v),
    "fc smooth": lambda v: (0 * v, (1 - np.tanh(v / SMOOTH_RATE) ** 2) / SMOOTH_RATE, 0 * v),
    "offset": lambda v: (0 * v, 0 * v, 0 * v),
    "Ia": lambda v: (0 * v, 0 * v, np.ones_like(v)),
    "k": lambda v: (np.ones_like(v), 0 * v, 0 * v),
}


def smooth_regression(regression: Regression) -> Regression:
    """Return the regression with tanh(v / SMOOTH_RATE) in place of sign(v) in Coulomb friction."""
    kinds = {"fc": "fc smooth"}
    terms = tuple(replace(t, kind=kinds.get(t.kind, t.kind)) for t in regression.terms)
    return replace(regression, terms=terms)


def pullback(regression: Regression, motion: Trajectory, G: Array) -> Slopes:
    """Return the derivatives of sum(G * Y) by q, v and a, (N, nv) each.

    G (N, rows, p) weights the entries of Y, with rows and columns as in `regression`.
    """
    weights = {}
    for columns in regression.links:
        dofs = regression.tree.links[columns.link].dofs
        G_link = G[:, dofs[:, None], columns.indices[None]].transpose(1, 2, 0)  # (k, columns, N)
        raw = np.zeros((len(dofs), 10, len(motion)))
        mixed = G_link if columns.mix is None else np.einsum("cr,kcn->krn", columns.mix, G_link)
        raw[:, list(columns.raw)] = mixed
        weights[columns.link] = raw
    slopes = _pullback_links(regression.tree, motion, weights)
    for term in regression.terms:
        for slope, of_term in zip(slopes, _SLOPE[term.kind](motion.v[:, term.rate]), strict=True):
            slope[:, term.rate] += G[:, term.row, term.index] * of_term
    return slopes


def pullback_torque(tree: Tree, phi: Array, motion: Trajectory, U: Array) -> Slopes:
    """Return the derivatives of sum(U * tau) by q, v and a, (N, nv) each.

    U (N, nv) weights the rigid-body torque tau (N, nv) of links with parameters phi (n_links, 10).
    """
    weights = {
        i: U.T[link.dofs][:, None] * phi[i][:, None]
        for i, link in enumerate(tree.links)
        if phi[i].any()
    }
    return _pullback_links(tree, motion, weights)


def _pullback_links(tree: Tree, motion: Trajectory, weights: Mapping[int, Array]) -> Slopes:
    """Derivatives for weights (k, 10, N) on the ten raw columns of each link, where k counts the
    degrees of freedom that move the link."""
    gq, gv, ga = np.zeros((3, tree.nv, len(motion)))
    if not weights:  # joint terms alone need no kinematics
        return gq.T, gv.T, ga.T
    sweep = _Sweep(motion.q.T, motion.v.T, motion.a.T, (gq, gv, ga))
    # State of each link, and the tape of adjoints that leads back to that of its parent.
    ground = np.zeros((3, 3, sweep.q.shape[1]))
    ground[2] = -tree.gravity[:, None]
    done: list[Array] = []
    tapes: list[list[_Backward]] = []
    for link in tree.links:
        tapes.append([])
        start = ground if link.parent < 0 else done[link.parent]
        done.append(_forward(link, start, sweep, tapes[-1]))
    pulled = [np.zeros_like(state) for state in done]
    # Tips before the base: the state of a parent collects the derivatives of its children.
    for i in reversed(range(len(tree.links))):
        if i in weights:
            pulled[i] += _body_slopes(done[i], weights[i])
        bar = pulled[i]
        for back in reversed(tapes[i]):
            bar = back(bar)
        if tree.links[i].parent >= 0:
            pulled[tree.links[i].parent] += bar
    return gq.T, gv.T, ga.T


# A state X is one array (3 + 2 k, 3, n) in link axes: w, alpha, d, then z and u of each of the k
# degrees of freedom. Each step returns the next state and appends its adjoint to the tape: the map
# from the derivatives by the new state to those by the old one.
_Backward = Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class _Sweep:
    """Positions q (nq, n), rates v and accelerations a (nv, n) of a sweep, and the derivatives
    (nv, n) by them, which the adjoints of the joints add to."""

    q: Array
    v: Array
    a: Array
    slopes: Slopes


def _forward(link: Link, X: Array, sweep: _Sweep, tape: list[_Backward]) -> Array:
    """State of a link from that of its parent, through all of its joints."""
    R, p = link.R0, link.p0
    for joint in link.joints:
        if joint.kind == FREE:
            X = _free(joint, X, sweep, tape)
        elif joint.kind == HINGE:
            X = _rotated(R, _translated((p + R @ joint.anchor)[:, None], X, tape), tape)
            X = _hinge(joint, X, sweep, tape)
        elif joint.kind == BALL:
            X = _rotated(R, _translated((p + R @ joint.anchor)[:, None], X, tape), tape)
            X = _ball(joint, X, sweep, tape)
        else:
            X = _rotated(R, _translated(p[:, None], X, tape), tape)
            X = _slide(joint, X, sweep, tape)
        R, p = np.eye(3), np.zeros(3)
    return X


def _rotated(R: Array, X: Array, tape: list[_Backward]) -> Array:
    """State in axes that are rotated by a constant R (3, 3)."""
    if np.array_equal(R, np.eye(3)):
        return X
    tape.append(lambda bar: np.matmul(R, bar))
    return np.asarray(np.matmul(R.T, X))


def _translated(
    r: Array, X: Array, tape: list[_Backward], add_slope: Callable[[Array], None] | None = None
) -> Array:
    """State at a point r (3, 1 or n) away, in the same axes; `add_slope` gets the derivative by r
    (3, n)."""
    # a' = a + alpha x r + w x (w x r), and the velocity per unit rate is u' = u + z x r.
    if add_slope is None and not r.any():
        return X
    w, alpha = X[0], X[1]
    wr = _cross(w, r)
    out = X.copy()
    out[2] += _cross(alpha, r) + _cross(w, wr)
    z = X[3::2]
    out[4::2] += _cross(z, r)

    def back(bar: Array) -> Array:
        old = bar.copy()
        d = bar[2]
        old[0] += _cross(wr, d) + _cross(r, _cross(d, w))
        old[1] += _cross(r, d)
        old[3::2] += _cross(r, bar[4::2])
        if add_slope is not None:
            slope = _cross(d, alpha) + _cross(w, _cross(w, d))
            add_slope(slope + _cross(bar[4::2], z).sum(axis=0))
        return old

    tape.append(back)
    return out


def _hinge(joint: TreeJoint, X: Array, sweep: _Sweep, tape: list[_Backward]) -> Array:
    axis, dof = joint.axis, joint.vadr
    E = _rotation_about(axis, sweep.q[joint.qadr] - joint.q0)
    X = E(X)
    before = X

    def back(bar: Array) -> Array:
        # dX/dq = -axis x X for every vector of the state in rotating axes.
        sweep.slopes[0][dof] -= axis @ np.asarray(_cross(before, bar).sum(axis=0))
        return E(bar, back=True)

    tape.append(back)
    X = _with_dof(X, axis, np.zeros(3), tape)
    X = _with_joint_rate(joint, X, sweep, tape)
    return _translated(-joint.anchor[:, None], X, tape)


def _with_joint_rate(joint: TreeJoint, X: Array, sweep: _Sweep, tape: list[_Backward]) -> Array:
    """State behind a hinge: alpha' = alpha + z qdd + w x z qd, w' = w + z qd."""
    axis, dof = joint.axis, joint.vadr
    along = axis[:, None]
    rate = along * sweep.v[dof]
    w = X[0]
    out = X.copy()
    out[1] += along * sweep.a[dof] + _cross(w, rate)
    out[0] += rate

    def back(bar: Array) -> Array:
        sweep.slopes[2][dof] += axis @ bar[1]
        sweep.slopes[1][dof] += axis @ (bar[0] + _cross(bar[1], w))
        old = bar.copy()
        old[0] += _cross(rate, bar[1])
        return old

    tape.append(back)
    return out


def _slide(joint: TreeJoint, X: Array, sweep: _Sweep, tape: list[_Backward]) -> Array:
    axis, dof = joint.axis, joint.vadr
    along = axis[:, None]

    def add_slope(slope: Array) -> None:
        sweep.slopes[0][dof] += axis @ slope

    X = _translated(along * (sweep.q[joint.qadr] - joint.q0), X, tape, add_slope)
    X = _with_dof(X, np.zeros(3), axis, tape)
    w, rate = X[0], along * sweep.v[dof]
    out = X.copy()
    out[2] += along * sweep.a[dof] + 2 * _cross(w, rate)  # Coriolis acceleration

    def back(bar: Array) -> Array:
        sweep.slopes[2][dof] += axis @ bar[2]
        sweep.slopes[1][dof] += 2 * (axis @ _cross(bar[2], w))
        old = bar.copy()
        old[0] += 2 * _cross(rate, bar[2])
        return old

    tape.append(back)
    return out


def _ball(joint: TreeJoint, X: Array, sweep: _Sweep, tape: list[_Backward]) -> Array:
    E = np.moveaxis(matrix_of_quaternion(sweep.q[joint.qadr : joint.qadr + 4].T), 0, -1)
    X = np.einsum("jin,mjn->min", E, X)
    tape.append(lambda bar: np.einsum("ijn,mjn->min", E, bar))
    for axis in np.eye(3):
        X = _with_dof(X, axis, np.zeros(3), tape)
    dofs = slice(joint.vadr, joint.vadr + 3)
    w, rate = X[0], sweep.v[dofs]
    out = X.copy()
    out[1] += sweep.a[dofs] + _cross(w, rate)
    out[0] += rate

    def back(bar: Array) -> Array:
        old = bar.copy()
        old[0] += _cross(rate, bar[1])
        return old

    tape.append(back)
    return _translated(-joint.anchor[:, None], out, tape)


def _free(joint: TreeJoint, X: Array, sweep: _Sweep, tape: list[_Backward]) -> Array:
    q, v, a = sweep.q, sweep.v, sweep.a
    R = np.moveaxis(matrix_of_quaternion(q[joint.qadr + 3 : joint.qadr + 7].T), 0, -1)
    linear, angular = slice(joint.vadr, joint.vadr + 3), slice(joint.vadr + 3, joint.vadr + 6)
    out = np.zeros((15, 3, q.shape[1]))
    out[0], out[1] = v[angular], a[angular]
    out[2] = np.einsum("jin,jn->in", R, X[2] + a[linear])
    for i in range(3):
        out[4 + 2 * i] = R[i]
        out[9 + 2 * i, i] = 1.0
    # Behind a free joint nothing depends on the parent's state.
    still = np.zeros_like(X)
    tape.append(lambda bar: still)
    return out


def _with_dof(X: Array, z: Array, u: Array, tape: list[_Backward]) -> Array:
    """State with one more degree of freedom, whose z and u are constant in these axes."""
    out = np.empty((len(X) + 2, *X.shape[1:]))
    out[:-2] = X
    out[-2], out[-1] = z[:, None], u[:, None]
    tape.append(lambda bar: np.asarray(bar[:-2]))
    return out


def _rotation_about(axis: Array, angle: Array) -> Callable[..., Array]:
    """Map of states into axes rotated by `angle` (n,) about a unit axis; `back` inverts it."""
    cos, sin = np.cos(angle), np.sin(angle)
    # About a coordinate axis only two components change: half of the work.
    if np.count_nonzero(axis) == 1:
        i = int(np.argmax(np.abs(axis)))
        j, k = (i + 1) % 3, (i + 2) % 3
        signed_sin = sin * axis[i]

        def about_coordinate(X: Array, back: bool = False) -> Array:
            s = -signed_sin if back else signed_sin
            out = X.copy()
            out[:, j] = cos * X[:, j] + s * X[:, k]
            out[:, k] = cos * X[:, k] - s * X[:, j]
            return out

        return about_coordinate

    def about_any(X: Array, back: bool = False) -> Array:
        s = sin if back else -sin
        along = np.einsum("i,min->mn", axis, X)[:, None] * axis[None, :, None]
        return np.asarray(cos * X + (1 - cos) * along + s * _cross(axis[:, None], X))

    return about_any


def _body_slopes(X: Array, G: Array) -> Array:
    """Derivatives by the state of sum_k [z u]_k^T A(w, alpha, d) G_k, for weights G (k, 10, n).

    With G_k read as parameters m, h, I, the wrench is the Newton-Euler equation of one body:
    A G_k = [I alpha + w x I w + h x d; m d + alpha x h + w x (w x h)].
    """
    w, alpha, d = X[0], X[1], X[2]
    z, u = X[3::2], X[4::2]
    m, h = G[:, 0], G[:, 1:4]
    II = G[:, _INERTIA_INDEX]  # (k, 3, 3, n), symmetric
    out = np.empty_like(X)
    Iw, Ia = (II * w).sum(axis=2), (II * alpha).sum(axis=2)
    wh = _cross(w, h)
    out[3::2] = Ia + _cross(w, Iw) + _cross(h, d)
    out[4::2] = m[:, None] * d + _cross(alpha, h) + _cross(w, wh)
    # By alpha: I z + h x u; by d: m u + z x h; by w: I (z x w) + (I w) x z + (w x h) x u +
    # h x (u x w).
    Iz = (II * z[:, None]).sum(axis=2)
    zw = _cross(z, w)
    Izw = (II * zw[:, None]).sum(axis=2)
    out[1] = (Iz + _cross(h, u)).sum(axis=0)
    out[2] = (m[:, None] * u + _cross(z, h)).sum(axis=0)
    out[0] = (Izw + _cross(Iw, z) + _cross(wh, u) + _cross(h, _cross(u, w))).sum(axis=0)
    return out


_INERTIA_INDEX: Final = np.array([[4, 5, 6], [5, 7, 8], [6, 8, 9]])
"""Indices of Ixx Ixy Ixz Iyy Iyz Izz among the ten parameters, as a symmetric matrix."""


def _cross(x: Array, y: Array) -> Array:
    """Cross product x x y over the last axis but one."""
    x0, x1, x2 = x[..., 0, :], x[..., 1, :], x[..., 2, :]
    y0, y1, y2 = y[..., 0, :], y[..., 1, :], y[..., 2, :]
    shape = np.broadcast_shapes(x.shape, y.shape)
    out = np.empty(shape)
    np.multiply(x1, y2, out=out[..., 0, :])
    out[..., 0, :] -= x2 * y1
    np.multiply(x2, y0, out=out[..., 1, :])
    out[..., 1, :] -= x0 * y2
    np.multiply(x0, y1, out=out[..., 2, :])
    out[..., 2, :] -= x1 * y0
    return out
