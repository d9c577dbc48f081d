"""The tree kernel in NumPy: kinematics of whole blocks of samples, then Y link by link.

Everything is expressed in link axes, samples last (structure of arrays). With the classical
acceleration d of a link's origin less gravity, its linear velocity drops out, so a link needs only
w, alpha, d, and for each degree of freedom before it the axis z and the velocity u that a unit rate
gives to its origin: row = [z; u]^T A(w, alpha, d). Y is therefore never zero-filled here: a link
knows only the rows that move it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.models.tree import BALL, FREE, HINGE, Link, Tree, TreeJoint
from sysid_bench.regressors.body import entries
from sysid_bench.regressors.kernel_c import selected_kernel
from sysid_bench.regressors.kernel_layout import torque_layout
from sysid_bench.spatial.rotation import matrix_of_quaternion, skew
from sysid_bench.types import Array, Trajectory

BLOCK = 1024
"""Samples per block: the arrays of one link stay in the second-level cache."""


@dataclass(frozen=True, eq=False)
class LinkMotion:
    """w, alpha, d (3, n) of one link in its axes, and `ZU` (k, 6, n): for each of its k degrees of
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
    q, v, a = (np.ascontiguousarray(x) for x in (q, v, a))
    zero = np.zeros((3, n))
    ground = LinkMotion(zero, zero, np.tile(-tree.gravity[:, None], n), np.zeros((0, 6, n)))
    done: list[LinkMotion] = []
    for link in tree.links:
        state = ground if link.parent < 0 else done[link.parent]
        done.append(_through_joints(link, state, q, v, a))
    return done


def body_columns(state: LinkMotion, wanted: tuple[int, ...]) -> Array:
    """A of one link, (6, m, n): m wanted columns of its ten; a row of Y is [z; u] times it."""
    columns = entries(state.w, state.alpha, state.d)
    A = np.zeros((6, len(wanted), state.w.shape[1]))
    for place, column in enumerate(wanted):
        for row, value in columns[column]:
            A[row, place] = value
    return A


def newton_euler(tree: Tree, phi: Array, motion: Trajectory) -> Array:
    """Rigid-body torque (N, nv) of links with parameters phi (n_links, 10)."""
    library = selected_kernel().library
    if library is not None:
        heavy = np.flatnonzero(phi.any(axis=1))
        return library.torque(torque_layout(tree, heavy.tolist()), motion, phi[heavy])
    tau = np.zeros((len(motion), tree.nv))
    for part in blocks(motion):
        states = sweep(tree, motion.q[part].T, motion.v[part].T, motion.a[part].T)
        for link, state, numbers in zip(tree.links, states, phi, strict=True):
            if numbers.any():
                tau[part, link.dofs] += np.einsum("kin,in->nk", state.ZU, _wrench(state, numbers))
    return tau


def _wrench(state: LinkMotion, phi: Array) -> Array:
    wrench = np.zeros((6, state.w.shape[1]))
    for number, column in zip(phi, entries(state.w, state.alpha, state.d), strict=True):
        for row, value in column:
            wrench[row] += number * value
    return wrench


def _through_joints(link: Link, state: LinkMotion, q: Array, v: Array, a: Array) -> LinkMotion:
    R, p = link.R0, link.p0
    for joint in link.joints:
        if joint.kind == FREE:
            state = _free(joint, state, q, v, a)
        elif joint.kind == HINGE:
            state = _hinge(joint, _placed(state, R, p + R @ joint.anchor, 1), q, v, a)
        elif joint.kind == BALL:
            state = _ball(joint, _placed(state, R, p + R @ joint.anchor, 3), q, v, a)
        else:
            state = _slide(joint, _placed(state, R, p, 1), q, v, a)
        R, p = np.eye(3), np.zeros(3)  # the next joint of this body starts in the body frame
    return state


def _placed(state: LinkMotion, R: Array, p: Array, new: int) -> LinkMotion:
    """The state at a frame (R, p) fixed in the old one, with room for `new` more rows in ZU."""
    k, _, n = state.ZU.shape
    d, across = state.d, skew(p)
    if p.any():
        d = d - across @ state.alpha - _cross(state.w, across @ state.w)
    # u at the new origin is u + z × p; both turn into the new axes.
    motion = np.zeros((6, 6))
    motion[:3, :3] = motion[3:, 3:] = R.T
    motion[3:, :3] = -R.T @ across
    ZU = np.empty((k + new, 6, n))
    np.matmul(motion, state.ZU, out=ZU[:k])
    return LinkMotion(R.T @ state.w, R.T @ state.alpha, R.T @ d, ZU)


def _hinge(joint: TreeJoint, state: LinkMotion, q: Array, v: Array, a: Array) -> LinkMotion:
    angle = q[joint.qadr] - joint.q0
    axis = int(np.argmax(np.abs(joint.axis)))
    if np.count_nonzero(joint.axis) == 1:  # the 1 of (0, 1, 4e-8) is exact, too
        turned = _turned_about_axis(state, axis, joint.axis[axis] * angle)
    else:
        turned = _turned(state, _turns_about(joint.axis, angle), 1)
    along = joint.axis[:, None]
    turned.ZU[-1, :3] = along
    turned.ZU[-1, 3:] = 0.0
    return _spun(joint, turned, along * v[joint.vadr], along * a[joint.vadr])


def _ball(joint: TreeJoint, state: LinkMotion, q: Array, v: Array, a: Array) -> LinkMotion:
    quaternion = q[joint.qadr : joint.qadr + 4].T
    turned = _turned(state, np.moveaxis(matrix_of_quaternion(quaternion), 0, -1), 3)
    turned.ZU[-3:, :3] = np.eye(3)[:, :, None]
    turned.ZU[-3:, 3:] = 0.0
    own = slice(joint.vadr, joint.vadr + 3)
    return _spun(joint, turned, v[own], a[own])


def _spun(joint: TreeJoint, state: LinkMotion, rate: Array, change: Array) -> LinkMotion:
    """The state with a joint's own rate and acceleration (3, n), moved from anchor to origin."""
    alpha = state.alpha + change + _cross(state.w, rate)
    spun = LinkMotion(state.w + rate, alpha, state.d, state.ZU)
    return _shifted(spun, -joint.anchor[:, None]) if joint.anchor.any() else spun


def _slide(joint: TreeJoint, state: LinkMotion, q: Array, v: Array, a: Array) -> LinkMotion:
    axis = joint.axis[:, None]
    state.ZU[-1] = 0.0
    moved = _shifted(state, axis * (q[joint.qadr] - joint.q0))
    moved.ZU[-1, 3:] = axis
    d = moved.d + axis * a[joint.vadr] + 2 * _cross(moved.w, axis * v[joint.vadr])
    return LinkMotion(moved.w, moved.alpha, d, moved.ZU)


def _free(joint: TreeJoint, state: LinkMotion, q: Array, v: Array, a: Array) -> LinkMotion:
    """Linear velocity in the world, angular velocity in the body; q is absolute."""
    R = np.moveaxis(matrix_of_quaternion(q[joint.qadr + 3 : joint.qadr + 7].T), 0, -1)
    linear, angular = slice(joint.vadr, joint.vadr + 3), slice(joint.vadr + 3, joint.vadr + 6)
    ZU = np.zeros((6, 6, q.shape[1]))
    ZU[3:, :3] = np.eye(3)[:, :, None]
    ZU[:3, 3:] = R
    d = _transposed(R, state.d + a[linear])
    return LinkMotion(np.array(v[angular]), np.array(a[angular]), d, ZU)


def _shifted(state: LinkMotion, r: Array) -> LinkMotion:
    """The same axes at a point r (3, 1) or (3, n) away; writes into the state's own ZU."""
    d = state.d + _cross(state.alpha, r) + _cross(state.w, _cross(state.w, r))
    z, u = state.ZU[:, :3], state.ZU[:, 3:]
    for i, j, k in _CYCLES:
        u[:, i] += z[:, j] * r[k]
        u[:, i] -= z[:, k] * r[j]
    return LinkMotion(state.w, state.alpha, d, state.ZU)


def _turned_about_axis(state: LinkMotion, axis: int, angle: Array) -> LinkMotion:
    """The same point in axes turned about coordinate axis 0, 1 or 2: a plane rotation. Writes into
    the state's own ZU."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    cos, sin = np.cos(angle), np.sin(angle)
    for vector in (state.w, state.alpha, state.d):
        vector[j], vector[k] = cos * vector[j] + sin * vector[k], cos * vector[k] - sin * vector[j]
    for first in (0, 3):
        x, y = state.ZU[:-1, first + j], state.ZU[:-1, first + k]
        old = x * sin
        x *= cos
        x += y * sin
        y *= cos
        y -= old
    return state


def _turned(state: LinkMotion, E: Array, new: int) -> LinkMotion:
    """The same point in axes turned by E (3, 3, n); writes into the state's own ZU."""
    old = state.ZU[:-new]
    for part in (slice(0, 3), slice(3, 6)):
        old[:, part] = np.einsum("jin,kjn->kin", E, old[:, part])
    w, alpha, d = (_transposed(E, x) for x in (state.w, state.alpha, state.d))
    return LinkMotion(w, alpha, d, state.ZU)


def _transposed(E: Array, x: Array) -> Array:
    """E^T x for E (3, 3, n) and x (3, n)."""
    return E[0] * x[0] + E[1] * x[1] + E[2] * x[2]


def _turns_about(axis: Array, angle: Array) -> Array:
    """Rotations (3, 3, n) by `angle` (n,) about a unit axis (Rodrigues)."""
    along = np.outer(axis, axis)[:, :, None]
    across = np.eye(3)[:, :, None] - along
    return along + across * np.cos(angle) + skew(axis)[:, :, None] * np.sin(angle)


_CYCLES: Final = ((0, 1, 2), (1, 2, 0), (2, 0, 1))


def _cross(x: Array, y: Array) -> Array:
    out = x[[1, 2, 0]] * y[[2, 0, 1]]
    out -= x[[2, 0, 1]] * y[[1, 2, 0]]
    return out
