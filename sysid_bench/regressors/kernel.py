"""The tree kernel in NumPy: kinematics of whole blocks of samples, then Y link by link.

Everything is expressed in link axes, samples last (structure of arrays). With the classical
acceleration d of a link's origin less gravity, its linear velocity drops out, so a link needs only
w, alpha, d, and for each degree of freedom before it the axis z and the velocity u that a unit rate
gives to its origin: row = [z; u]^T A(w, alpha, d). Y is therefore never zero-filled here: a link
knows only the rows that move it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sysid_bench.models.tree import BALL, FREE, HINGE, Link, Tree, TreeJoint
from sysid_bench.regressors.body import entries
from sysid_bench.spatial.rotation import matrix_of_quaternion
from sysid_bench.types import Array, Trajectory

BLOCK = 1024
"""Samples per block: the arrays of one link stay in the second-level cache."""


@dataclass(frozen=True, eq=False)
class LinkMotion:
    """w, alpha, d (3, n) of one link in its axes, and `ZU` (6, k, n): for each of its k degrees of
    freedom the axis z and the velocity u of the link's origin per unit rate."""

    w: Array
    alpha: Array
    d: Array
    ZU: Array


def blocks(motion: Trajectory, size: int = BLOCK) -> Iterator[slice]:
    """Slices of at most `size` samples that cover the motion."""
    for start in range(0, len(motion), size):
        yield slice(start, min(start + size, len(motion)))


def sweep(tree: Tree, q: Array, v: Array, a: Array) -> list[LinkMotion]:
    """The motion of every link for n samples; q (nq, n), v and a (nv, n)."""
    n = q.shape[1]
    done: list[LinkMotion] = []
    for link in tree.links:
        if link.parent < 0:
            zero = np.zeros((3, n))
            ground = np.broadcast_to(-tree.gravity[:, None], (3, n))
            state = LinkMotion(zero, zero, ground, np.zeros((6, 0, n)))
        else:
            state = done[link.parent]
        done.append(_through_joints(link, state, q, v, a))
    return done


def raw_columns(state: LinkMotion, wanted: tuple[int, ...]) -> Array:
    """Y of one link, (m, k, n): m wanted columns of its ten, k rows that move it."""
    columns = entries(state.w, state.alpha, state.d)
    k, n = state.ZU.shape[1:]
    out = np.empty((len(wanted), k, n))
    product = np.empty((k, n))
    for place, column in enumerate(wanted):
        (first, value), *rest = columns[column]
        np.multiply(state.ZU[first], value, out=out[place])
        for row, value in rest:
            np.multiply(state.ZU[row], value, out=product)
            out[place] += product
    return out


def newton_euler(tree: Tree, phi: Array, motion: Trajectory) -> Array:
    """Rigid-body torque (N, nv) of links with parameters phi (n_links, 10)."""
    tau = np.zeros((len(motion), tree.nv))
    for part in blocks(motion):
        states = sweep(tree, motion.q[part].T, motion.v[part].T, motion.a[part].T)
        for link, state, numbers in zip(tree.links, states, phi, strict=True):
            wrench = _wrench(state, numbers)
            tau[part, link.dofs] += np.einsum("ikn,in->nk", state.ZU, wrench)
    return tau


def _wrench(state: LinkMotion, phi: Array) -> Array:
    wrench = np.zeros_like(state.ZU[:, 0] if state.ZU.shape[1] else np.zeros((6, state.w.shape[1])))
    for number, column in zip(phi, entries(state.w, state.alpha, state.d), strict=True):
        for row, value in column:
            wrench[row] += number * value
    return wrench


def _through_joints(link: Link, state: LinkMotion, q: Array, v: Array, a: Array) -> LinkMotion:
    R, p = link.R0, link.p0
    for joint in link.joints:
        if joint.kind == FREE:
            state = _free(joint, state, q, v, a)
        elif joint.kind in (HINGE, BALL):
            state = _rotate(joint, state, R, p, q, v, a)
        else:
            state = _slide(joint, state, R, p, q, v, a)
        R, p = np.eye(3), np.zeros(3)  # the next joint of this body starts in the body frame
    return state


def _rotate(
    joint: TreeJoint, state: LinkMotion, R: Array, p: Array, q: Array, v: Array, a: Array
) -> LinkMotion:
    """A hinge or ball at `anchor` of a frame placed at (R, p) in the previous one."""
    anchor = joint.anchor[:, None]
    if joint.kind == HINGE:
        turn = _turns_about(joint.axis, q[joint.qadr] - joint.q0)
        rate = joint.axis[:, None] * v[joint.vadr]
        change = joint.axis[:, None] * a[joint.vadr]
        axes = joint.axis[:, None, None]
    else:
        turn = np.moveaxis(matrix_of_quaternion(q[joint.qadr : joint.qadr + 4].T), 0, -1)
        own = slice(joint.vadr, joint.vadr + 3)
        rate, change, axes = v[own], a[own], np.eye(3)[:, :, None]
    E = np.einsum("ij,jkn->ikn", R, turn)
    moved = _turn(_shift(state, p + R @ joint.anchor), E)
    alpha = moved.alpha + change + _cross(moved.w, rate)
    at_anchor = LinkMotion(
        moved.w + rate, alpha, moved.d, _append(moved.ZU, axes, np.zeros((3, 1, 1)))
    )
    return _shift(at_anchor, -anchor) if joint.anchor.any() else at_anchor


def _slide(
    joint: TreeJoint, state: LinkMotion, R: Array, p: Array, q: Array, v: Array, a: Array
) -> LinkMotion:
    axis = joint.axis[:, None]
    offset = p[:, None] + (R @ joint.axis)[:, None] * (q[joint.qadr] - joint.q0)
    moved = _turn(_shift(state, offset), R[:, :, None])
    d = moved.d + axis * a[joint.vadr] + 2 * _cross(moved.w, axis * v[joint.vadr])
    ZU = _append(moved.ZU, np.zeros((3, 1, 1)), axis[:, :, None])
    return LinkMotion(moved.w, moved.alpha, d, ZU)


def _free(joint: TreeJoint, state: LinkMotion, q: Array, v: Array, a: Array) -> LinkMotion:
    """Linear velocity in the world, angular velocity in the body; q is absolute."""
    R = np.moveaxis(matrix_of_quaternion(q[joint.qadr + 3 : joint.qadr + 7].T), 0, -1)
    linear, angular = slice(joint.vadr, joint.vadr + 3), slice(joint.vadr + 3, joint.vadr + 6)
    d = _transposed(R, state.d + a[linear])
    n = q.shape[1]
    ZU = np.zeros((6, 6, n))
    ZU[:3, 3:] = np.eye(3)[:, :, None]
    ZU[3:, :3] = R.transpose(1, 0, 2)
    return LinkMotion(np.array(v[angular]), np.array(a[angular]), d, ZU)


def _shift(state: LinkMotion, r: Array) -> LinkMotion:
    """The same axes at a point r (3,) or (3, n) away."""
    r = np.broadcast_to(r if r.ndim == 2 else r[:, None], state.w.shape)
    d = state.d + _cross(state.alpha, r) + _cross(state.w, _cross(state.w, r))
    ZU = np.empty_like(state.ZU)
    ZU[:3] = state.ZU[:3]
    ZU[3:] = state.ZU[3:] + _cross(state.ZU[:3], r[:, None])
    return LinkMotion(state.w, state.alpha, d, ZU)


def _turn(state: LinkMotion, E: Array) -> LinkMotion:
    """The same point in axes turned by E (3, 3, n) or (3, 3, 1)."""
    return LinkMotion(
        _transposed(E, state.w),
        _transposed(E, state.alpha),
        _transposed(E, state.d),
        np.concatenate([_transposed(E, state.ZU[:3]), _transposed(E, state.ZU[3:])]),
    )


def _append(ZU: Array, z: Array, u: Array) -> Array:
    _, k, n = ZU.shape
    new = max(z.shape[1], u.shape[1])
    out = np.empty((6, k + new, n))
    out[:, :k] = ZU
    out[:3, k:] = z
    out[3:, k:] = u
    return out


def _transposed(E: Array, x: Array) -> Array:
    """E^T x for E (3, 3, n), x (3, n) or (3, k, n)."""
    if x.ndim == 3:
        E = E[:, :, None]
    out = E[0] * x[0]
    out += E[1] * x[1]
    out += E[2] * x[2]
    return out


def _turns_about(axis: Array, angle: Array) -> Array:
    """Rotations (3, 3, n) by `angle` (n,) about a unit axis (Rodrigues)."""
    x, y, z = axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    along = np.outer(axis, axis)
    return (
        along[:, :, None]
        + (np.eye(3) - along)[:, :, None] * np.cos(angle)
        + K[:, :, None] * np.sin(angle)
    )


def _cross(x: Array, y: Array) -> Array:
    out = np.empty(np.broadcast_shapes(x.shape, y.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(x[j], y[k], out=out[i])
        out[i] -= x[k] * y[j]
    return out
