"""Which way Y moves: the kernel backwards (reverse accumulation), whole motions at a time.

For any weights G (N, rows, p) the sum of G * Y is a number; here are its derivatives by q, v, a of
every sample, for the price of a few sweeps, whatever the number of parameters. Derivatives by the
coordinates of free and ball joints are left zero: designed motions hold them.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from sysid_bench.models.coupling.derivatives import Slopes
from sysid_bench.models.tree import BALL, FREE, HINGE, Link, Tree, TreeJoint
from sysid_bench.regressors.regression import SMOOTH_RATE, Regression
from sysid_bench.spatial.rotation import matrix_of_quaternion
from sysid_bench.types import Array, Trajectory

# Slope of each joint term by (q, v, a) of its joint; see TERM.
_SLOPE: Final[dict[str, Callable[[Array], Slopes]]] = {
    "fv": lambda v: (0 * v, np.ones_like(v), 0 * v),
    "fc": lambda v: (0 * v, 0 * v, 0 * v),
    "fc smooth": lambda v: (0 * v, (1 - np.tanh(v / SMOOTH_RATE) ** 2) / SMOOTH_RATE, 0 * v),
    "offset": lambda v: (0 * v, 0 * v, 0 * v),
    "Ia": lambda v: (0 * v, 0 * v, np.ones_like(v)),
    "k": lambda v: (np.ones_like(v), 0 * v, 0 * v),
}


def smoothed(regression: Regression) -> Regression:
    """The same regression with a smooth sign for Coulomb friction."""
    kinds = {"fc": "fc smooth"}
    terms = tuple(replace(t, kind=kinds.get(t.kind, t.kind)) for t in regression.terms)
    return replace(regression, terms=terms)


def pull_back(regression: Regression, motion: Trajectory, G: Array) -> Slopes:
    """Derivatives of sum(G * Y) by q, v, a (N, nv); G (N, nv, p) in the columns of `regression`."""
    weights = {}
    for columns in regression.links:
        dofs = regression.tree.links[columns.link].dofs
        own = G[:, dofs[:, None], columns.places[None]].transpose(1, 2, 0)  # (k, columns, N)
        raw = np.zeros((len(dofs), 10, len(motion)))
        mixed = own if columns.mix is None else np.einsum("cr,kcn->krn", columns.mix, own)
        raw[:, list(columns.raw)] = mixed
        weights[columns.link] = raw
    slopes = _pull_back_links(regression.tree, motion, weights)
    for term in regression.terms:
        for slope, own in zip(slopes, _SLOPE[term.kind](motion.v[:, term.rate]), strict=True):
            slope[:, term.rate] += G[:, term.row, term.place] * own
    return slopes


def pull_back_torque(tree: Tree, phi: Array, motion: Trajectory, U: Array) -> Slopes:
    """Derivatives by q, v, a (N, nv) of sum(U * tau), U (N, nv), tau the rigid-body torque of links
    with parameters phi (n_links, 10)."""
    weights = {
        i: U.T[link.dofs][:, None] * phi[i][:, None]
        for i, link in enumerate(tree.links)
        if phi[i].any()
    }
    return _pull_back_links(tree, motion, weights)


def _pull_back_links(tree: Tree, motion: Trajectory, weights: Mapping[int, Array]) -> Slopes:
    """As `pull_back`, from weights (k, 10, N) on the raw columns of links, one for each of the k
    degrees of freedom that move the link."""
    q, v, a = motion.q.T, motion.v.T, motion.a.T
    gq, gv, ga = np.zeros((3, tree.nv, len(motion)))
    if not weights:  # joint terms alone: nothing to sweep for
        return gq.T, gv.T, ga.T
    slopes = gq, gv, ga
    tapes: list[list[_Back]] = []
    done: list[Array] = []
    ground = np.zeros((3, 3, len(motion)))
    ground[2] = -tree.gravity[:, None]
    for link in tree.links:
        tape: list[_Back] = []
        start = ground if link.parent < 0 else done[link.parent]
        done.append(_forward(link, start, q, v, a, slopes, tape))
        tapes.append(tape)
    pulled = [np.zeros_like(state) for state in done]
    for i in reversed(range(len(tree.links))):
        if i in weights:
            pulled[i] += _body_slopes(done[i], weights[i])
        bar = pulled[i]
        for back in reversed(tapes[i]):
            bar = back(bar)
        if tree.links[i].parent >= 0:
            pulled[tree.links[i].parent] += bar
    return gq.T, gv.T, ga.T


# A state is one array (3 + 2 k, 3, n) in link axes: w, alpha, d, then z and u of each of k degrees
# of freedom in turn. A step returns the next state and leaves its way back on the tape: from the
# slopes by the new state to those by the old one.
_Back = Callable[[Array], Array]


def _forward(
    link: Link, X: Array, q: Array, v: Array, a: Array, slopes: Slopes, tape: list[_Back]
) -> Array:
    R, p = link.R0, link.p0
    for joint in link.joints:
        if joint.kind == FREE:
            X = _free(joint, X, q, v, a, tape)
        elif joint.kind == HINGE:
            X = _turned(R, _shifted((p + R @ joint.anchor)[:, None], X, tape), tape)
            X = _hinge(joint, X, q, v, a, slopes, tape)
        elif joint.kind == BALL:
            X = _turned(R, _shifted((p + R @ joint.anchor)[:, None], X, tape), tape)
            X = _ball(joint, X, q, v, a, tape)
        else:
            X = _turned(R, _shifted(p[:, None], X, tape), tape)
            X = _slide(joint, X, q, v, a, slopes, tape)
        R, p = np.eye(3), np.zeros(3)
    return X


def _turned(R: Array, X: Array, tape: list[_Back]) -> Array:
    if np.array_equal(R, np.eye(3)):
        return X
    tape.append(lambda bar: np.matmul(R, bar))
    return np.matmul(R.T, X)


def _shifted(r: Array, X: Array, tape: list[_Back], by: Callable[[Array], None] | None = None):  # type: ignore[no-untyped-def]
    """The same axes at a point r (3, 1 or n) away; `by` is told the slope by r (3, n)."""
    if by is None and not r.any():
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
        if by is not None:
            slope = _cross(d, alpha) + _cross(w, _cross(w, d))
            by(slope + _cross(bar[4::2], z).sum(axis=0))
        return old

    tape.append(back)
    return out


def _hinge(
    joint: TreeJoint, X: Array, q: Array, v: Array, a: Array, slopes: Slopes, tape: list[_Back]
) -> Array:
    axis, dof = joint.axis, joint.vadr
    E = _turn(axis, q[joint.qadr] - joint.q0)
    X = E(X)
    before = X

    def back(bar: Array) -> Array:
        turned = _moment(before, bar)
        slopes[0][dof] -= axis @ turned
        return E(bar, back=True)

    tape.append(back)
    X = _with_row(X, axis, np.zeros(3), tape)
    X = _spun(axis, dof, X, v[dof], a[dof], slopes, tape)
    return _shifted(-joint.anchor[:, None], X, tape)


def _spun(
    axis: Array, dof: int, X: Array, v: Array, a: Array, slopes: Slopes, tape: list[_Back]
) -> Array:
    along = axis[:, None]
    rate = along * v
    w = X[0]
    out = X.copy()
    out[1] += along * a + _cross(w, rate)
    out[0] += rate

    def back(bar: Array) -> Array:
        slopes[2][dof] += axis @ bar[1]
        slopes[1][dof] += axis @ (bar[0] + _cross(bar[1], w))
        old = bar.copy()
        old[0] += _cross(rate, bar[1])
        return old

    tape.append(back)
    return out


def _slide(
    joint: TreeJoint, X: Array, q: Array, v: Array, a: Array, slopes: Slopes, tape: list[_Back]
) -> Array:
    axis, dof = joint.axis, joint.vadr
    along = axis[:, None]

    def by(slope: Array) -> None:
        slopes[0][dof] += axis @ slope

    X = _shifted(along * (q[joint.qadr] - joint.q0), X, tape, by)
    X = _with_row(X, np.zeros(3), axis, tape)
    w, rate = X[0], along * v[dof]
    out = X.copy()
    out[2] += along * a[dof] + 2 * _cross(w, rate)

    def back(bar: Array) -> Array:
        slopes[2][dof] += axis @ bar[2]
        slopes[1][dof] += 2 * (axis @ _cross(bar[2], w))
        old = bar.copy()
        old[0] += 2 * _cross(rate, bar[2])
        return old

    tape.append(back)
    return out


def _ball(joint: TreeJoint, X: Array, q: Array, v: Array, a: Array, tape: list[_Back]) -> Array:
    E = np.moveaxis(matrix_of_quaternion(q[joint.qadr : joint.qadr + 4].T), 0, -1)
    X = np.einsum("jin,mjn->min", E, X)
    tape.append(lambda bar: np.einsum("ijn,mjn->min", E, bar))
    for axis in np.eye(3):
        X = _with_row(X, axis, np.zeros(3), tape)
    own = slice(joint.vadr, joint.vadr + 3)
    w, rate = X[0], v[own]
    out = X.copy()
    out[1] += a[own] + _cross(w, rate)
    out[0] += rate

    def back(bar: Array) -> Array:
        old = bar.copy()
        old[0] += _cross(rate, bar[1])
        return old

    tape.append(back)
    return _shifted(-joint.anchor[:, None], out, tape)


def _free(joint: TreeJoint, X: Array, q: Array, v: Array, a: Array, tape: list[_Back]) -> Array:
    R = np.moveaxis(matrix_of_quaternion(q[joint.qadr + 3 : joint.qadr + 7].T), 0, -1)
    linear, angular = slice(joint.vadr, joint.vadr + 3), slice(joint.vadr + 3, joint.vadr + 6)
    out = np.zeros((15, 3, q.shape[1]))
    out[0], out[1] = v[angular], a[angular]
    out[2] = np.einsum("jin,jn->in", R, X[2] + a[linear])
    for i in range(3):
        out[4 + 2 * i] = R[i]
        out[9 + 2 * i, i] = 1.0
    still = np.zeros_like(X)
    tape.append(lambda bar: still)
    return out


def _with_row(X: Array, z: Array, u: Array, tape: list[_Back]) -> Array:
    """One more degree of freedom, its own axis constant in these axes."""
    out = np.empty((len(X) + 2, *X.shape[1:]))
    out[:-2] = X
    out[-2], out[-1] = z[:, None], u[:, None]
    tape.append(lambda bar: bar[:-2])
    return out


def _turn(axis: Array, angle: Array) -> Callable[..., Array]:
    """Turns states into axes turned by `angle` (n,) about a unit axis, and back."""
    cos, sin = np.cos(angle), np.sin(angle)
    if np.count_nonzero(axis) == 1:
        i = int(np.argmax(np.abs(axis)))
        j, k = (i + 1) % 3, (i + 2) % 3
        own = sin * axis[i]

        def about_coordinate(X: Array, back: bool = False) -> Array:
            s = -own if back else own
            out = X.copy()
            out[:, j] = cos * X[:, j] + s * X[:, k]
            out[:, k] = cos * X[:, k] - s * X[:, j]
            return out

        return about_coordinate

    def about_any(X: Array, back: bool = False) -> Array:
        s = sin if back else -sin
        along = np.einsum("i,min->mn", axis, X)[:, None] * axis[None, :, None]
        return cos * X + (1 - cos) * along + s * _cross(axis[:, None], X)

    return about_any


def _body_slopes(X: Array, G: Array) -> Array:
    """Slopes by the state of sum over k of [z u]_k^T A(w, alpha, d) G_k, G (k, 10, n): with the ten
    numbers m, h, I of G_k, the wrench A G_k is [I alpha + w x I w + h x d; m d + alpha x h +
    w x (w x h)]."""
    w, alpha, d = X[0], X[1], X[2]
    z, u = X[3::2], X[4::2]
    m, h = G[:, 0], G[:, 1:4]
    II = G[:, _SIX_OF]  # (k, 3, 3, n), symmetric
    out = np.empty_like(X)
    Iw, Ia = (II * w).sum(axis=2), (II * alpha).sum(axis=2)
    wh = _cross(w, h)
    out[3::2] = Ia + _cross(w, Iw) + _cross(h, d)
    out[4::2] = m[:, None] * d + _cross(alpha, h) + _cross(w, wh)
    # By alpha: I z - u x h; by d: m u + z x h; by w: I (z x w) + (I w) x z + ... term by term.
    Iz = (II * z[:, None]).sum(axis=2)
    zw = _cross(z, w)
    Izw = (II * zw[:, None]).sum(axis=2)
    out[1] = (Iz + _cross(h, u)).sum(axis=0)
    out[2] = (m[:, None] * u + _cross(z, h)).sum(axis=0)
    out[0] = (Izw + _cross(Iw, z) + _cross(wh, u) + _cross(h, _cross(u, w))).sum(axis=0)
    return out


_SIX_OF: Final = np.array([[4, 5, 6], [5, 7, 8], [6, 8, 9]])
"""Places of Ixx Ixy Ixz Iyy Iyz Izz in the ten numbers, as a symmetric matrix."""


def _moment(X: Array, Y: Array) -> Array:
    """Sum of X_m x Y_m (3, n)."""
    return _cross(X, Y).sum(axis=0)


def _cross(x: Array, y: Array) -> Array:
    """x x y over the axis before the last."""
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
