"""NumPy kernel of the regressor: forward kinematics of blocks of samples, then Y link by link.

All quantities are in link axes, with samples along the last axis. The body regressor A(w, alpha, d)
needs the angular velocity w, the angular acceleration alpha and d, the classical acceleration of
the link's origin minus gravity; the linear velocity cancels. With the axis z of a degree of freedom
and the velocity u of the link's origin per unit rate, virtual power gives its row of Y as [z; u]^T
A(w, alpha, d). Only rows of joints that move the link are computed, so Y needs no zeros.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.models.tree import BALL, FREE, HINGE, Link, Tree, TreeJoint
from sysid_bench.regressors.body import entries
from sysid_bench.regressors.kernel_c import select_kernel
from sysid_bench.regressors.kernel_layout import torque_layout
from sysid_bench.spatial import matrix_of_quaternion, skew
from sysid_bench.types import Array, Trajectory

BLOCK = 1024
"""Samples per block, so that the arrays of one link stay in the second-level cache."""


@dataclass(frozen=True, eq=False)
class LinkMotion:
    """Motion of one link at n samples, in its axes.

    w, alpha, d (3, n) as in the module's docstring. `ZU` (k, 6, n): z and u of each of the k
    degrees of freedom that move the link, i.e. the columns of its Jacobian [w; v].
    """

    w: Array
    alpha: Array
    d: Array
    ZU: Array


def blocks(motion: Trajectory, size: int = BLOCK) -> Iterator[slice]:
    """Yield slices of at most `size` samples that cover the motion."""
    for start in range(0, len(motion), size):
        yield slice(start, min(start + size, len(motion)))


def motion_part(motion: Trajectory, part: slice) -> Trajectory:
    """Return the samples of one block."""
    return Trajectory(motion.t[part], motion.q[part], motion.v[part], motion.a[part])


def link_motions(tree: Tree, q: Array, v: Array, a: Array) -> list[LinkMotion]:
    """Return the motion of every link at n samples; q (nq, n), v and a (nv, n)."""
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
    """Return m wanted columns of the ten of the body regressor A of one link, (6, m, n)."""
    columns = entries(state.w, state.alpha, state.d)
    A = np.zeros((6, len(wanted), state.w.shape[1]))
    for index, column in enumerate(wanted):
        for row, value in columns[column]:
            A[row, index] = value
    return A


def newton_euler(tree: Tree, phi: Array, motion: Trajectory) -> Array:
    """Return the rigid-body torque (N, nv) of links with parameters phi (n_links, 10)."""
    library = select_kernel().library
    if library is not None:
        nonzero = np.flatnonzero(phi.any(axis=1))
        return library.torque(torque_layout(tree, nonzero.tolist()), motion, phi[nonzero])
    tau = np.zeros((len(motion), tree.nv))
    for part in blocks(motion):
        states = link_motions(tree, motion.q[part].T, motion.v[part].T, motion.a[part].T)
        for link, state, link_phi in zip(tree.links, states, phi, strict=True):
            if not link_phi.any():
                continue
            wrench = np.zeros((6, state.w.shape[1]))  # A phi
            columns = entries(state.w, state.alpha, state.d)
            for parameter, column in zip(link_phi, columns, strict=True):
                for row, value in column:
                    wrench[row] += parameter * value
            tau[part, link.dofs] += np.einsum("kin,in->nk", state.ZU, wrench)
    return tau


def _through_joints(link: Link, state: LinkMotion, q: Array, v: Array, a: Array) -> LinkMotion:
    R, p = link.R0, link.p0
    for joint in link.joints:
        if joint.kind == FREE:
            state = _free(joint, state, q, v, a)
        elif joint.kind == HINGE:
            state = _hinge(joint, _in_frame(state, R, p + R @ joint.anchor, 1), q, v, a)
        elif joint.kind == BALL:
            state = _ball(joint, _in_frame(state, R, p + R @ joint.anchor, 3), q, v, a)
        else:
            state = _slide(joint, _in_frame(state, R, p, 1), q, v, a)
        R, p = np.eye(3), np.zeros(3)  # the next joint of this body starts in the body frame
    return state


def _in_frame(state: LinkMotion, R: Array, p: Array, new: int) -> LinkMotion:
    """State at a frame (R, p) fixed in the old one, with `new` further rows allocated in ZU."""
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
    # An axis such as (0, 1, 4e-8) is not a coordinate axis, although its 1 is exact.
    if np.count_nonzero(joint.axis) == 1:
        turned = _rotated_about_axis(state, axis, joint.axis[axis] * angle)
    else:
        turned = _rotated(state, _rotations(joint.axis, angle), 1)
    along = joint.axis[:, None]
    turned.ZU[-1, :3] = along
    turned.ZU[-1, 3:] = 0.0
    return _with_joint_rate(joint, turned, along * v[joint.vadr], along * a[joint.vadr])


def _ball(joint: TreeJoint, state: LinkMotion, q: Array, v: Array, a: Array) -> LinkMotion:
    quaternion = q[joint.qadr : joint.qadr + 4].T
    turned = _rotated(state, np.moveaxis(matrix_of_quaternion(quaternion), 0, -1), 3)
    turned.ZU[-3:, :3] = np.eye(3)[:, :, None]
    turned.ZU[-3:, 3:] = 0.0
    dofs = slice(joint.vadr, joint.vadr + 3)
    return _with_joint_rate(joint, turned, v[dofs], a[dofs])


def _with_joint_rate(joint: TreeJoint, state: LinkMotion, rate: Array, change: Array) -> LinkMotion:
    """State with the joint's rate and acceleration (3, n) added, moved from anchor to origin."""
    alpha = state.alpha + change + _cross(state.w, rate)
    spun = LinkMotion(state.w + rate, alpha, state.d, state.ZU)
    return _translated(spun, -joint.anchor[:, None]) if joint.anchor.any() else spun


def _slide(joint: TreeJoint, state: LinkMotion, q: Array, v: Array, a: Array) -> LinkMotion:
    axis = joint.axis[:, None]
    state.ZU[-1] = 0.0
    moved = _translated(state, axis * (q[joint.qadr] - joint.q0))
    moved.ZU[-1, 3:] = axis
    d = moved.d + axis * a[joint.vadr] + 2 * _cross(moved.w, axis * v[joint.vadr])
    return LinkMotion(moved.w, moved.alpha, d, moved.ZU)


def _free(joint: TreeJoint, state: LinkMotion, q: Array, v: Array, a: Array) -> LinkMotion:
    """State behind a free joint: linear velocity in world axes, angular velocity in body axes; q is
    the absolute pose."""
    R = np.moveaxis(matrix_of_quaternion(q[joint.qadr + 3 : joint.qadr + 7].T), 0, -1)
    linear, angular = slice(joint.vadr, joint.vadr + 3), slice(joint.vadr + 3, joint.vadr + 6)
    ZU = np.zeros((6, 6, q.shape[1]))
    ZU[3:, :3] = np.eye(3)[:, :, None]
    ZU[:3, 3:] = R
    d = _transposed(R, state.d + a[linear])
    return LinkMotion(np.array(v[angular]), np.array(a[angular]), d, ZU)


def _translated(state: LinkMotion, r: Array) -> LinkMotion:
    """State at a point r (3, 1) or (3, n) away, in the same axes; overwrites the state's ZU."""
    d = state.d + _cross(state.alpha, r) + _cross(state.w, _cross(state.w, r))
    z, u = state.ZU[:, :3], state.ZU[:, 3:]
    for i, j, k in _CYCLES:
        u[:, i] += z[:, j] * r[k]
        u[:, i] -= z[:, k] * r[j]
    return LinkMotion(state.w, state.alpha, d, state.ZU)


def _rotated_about_axis(state: LinkMotion, axis: int, angle: Array) -> LinkMotion:
    """State in axes rotated about coordinate axis 0, 1 or 2, a plane rotation; overwrites the
    state's ZU."""
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


def _rotated(state: LinkMotion, E: Array, new: int) -> LinkMotion:
    """State in axes rotated by E (3, 3, n); overwrites the state's ZU."""
    old = state.ZU[:-new]
    for part in (slice(0, 3), slice(3, 6)):
        old[:, part] = np.einsum("jin,kjn->kin", E, old[:, part])
    w, alpha, d = (_transposed(E, x) for x in (state.w, state.alpha, state.d))
    return LinkMotion(w, alpha, d, state.ZU)


def _transposed(E: Array, x: Array) -> Array:
    """E^T x for E (3, 3, n) and x (3, n)."""
    return np.asarray(E[0] * x[0] + E[1] * x[1] + E[2] * x[2])


def _rotations(axis: Array, angle: Array) -> Array:
    """Rotation matrices (3, 3, n) by `angle` (n,) about a unit axis (Rodrigues' formula)."""
    along = np.outer(axis, axis)[:, :, None]
    across = np.eye(3)[:, :, None] - along
    return np.asarray(along + across * np.cos(angle) + skew(axis)[:, :, None] * np.sin(angle))


_CYCLES: Final = ((0, 1, 2), (1, 2, 0), (2, 0, 1))


def _cross(x: Array, y: Array) -> Array:
    out = x[[1, 2, 0]] * y[[2, 0, 1]]
    out -= x[[2, 0, 1]] * y[[1, 2, 0]]
    return np.asarray(out)
