"""MJCF model of a Denavit-Hartenberg table.

Standard (Siciliano et al. 2009): frame i = frame prev · Rz(theta) Tz(d) Tx(a) Rx(alpha). Modified
(Craig 1986): Rx(alpha) Tx(a) Rz(theta) Tz(d), where a and alpha are those before the joint.

The frame of a link's parameters is part of the model, since base parameters depend on it: "joint"
has the axes of frame i at the origin before its joint (o_prev for R, o_i for P), as is usual in
identification; "link" is frame i itself. With modified tables both are frame i.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal
from xml.sax.saxutils import quoteattr

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.models.dh.dh_table import DhRow, DhTable
from sysid_bench.spatial.rotation import quaternion_of_matrix
from sysid_bench.types import Array

Convention = Literal["standard", "modified"]
Frames = Literal["joint", "link"]

WIDTH: Final = 0.05
"""m; thickness of the bar that stands for a link of unknown shape."""

DENSITY: Final = 1000.0
"""kg/m^3; density of water."""

TINY: Final = (1e-6, 1e-12)
"""kg, and kg m^2 about the centre, of massless links: they still have to be simulated."""

ARMATURE: Final = 5e-4
"""kg m^2; armature on the joints of massless links, which keeps the mass matrix regular."""


@dataclass(frozen=True, eq=False)
class _Placed:
    """Body of a link: its frame (R, p) in the parent body (or DH frame), axis and anchor of its
    joint in the body frame, and DH frame i in it."""

    parent: int
    R: Array
    p: Array
    axis: Array
    anchor: Array
    R_end: Array
    p_end: Array


def mjcf_of(
    table: DhTable,
    name: str = "robot",
    convention: Convention = "standard",
    frames: Frames = "joint",
    base: Sequence[float] = (0.0, 0.0, 0.0),
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
    massless: Sequence[str] = (),
) -> str:
    """Return the MJCF text of a table; `base` turns frame 0 in the world (roll, pitch, yaw about
    fixed axes, rad). Bodies are called link<row>, joints j<row>; fixed rows become no bodies.

    Raises UsageError for an unknown massless link, and for a link without mass.
    """
    placed = _place(table, convention, frames, _rpy(base))
    unknown = set(massless) - {row.link for row in table.rows}
    if unknown:
        known = [row.link for row in table.rows]
        raise unknown_name("massless link", min(unknown), known)
    bodies = "".join(
        _body(table, placed, i, frozenset(massless), "    ")
        for i, row in enumerate(table.rows)
        if placed[i].parent < 0 and row.kind != "F"
    )
    motors = "".join(
        f'    <motor name="m{row.link}" joint="j{row.link}"/>\n'
        for row in table.rows
        if row.kind != "F" and row.motor and not row.coupling_coefficients
    )
    return (
        f"<mujoco model={quoteattr(name)}>\n"
        '  <compiler angle="radian" inertiafromgeom="false" autolimits="true"/>\n'
        f'  <option gravity="{_words(gravity)}" integrator="implicitfast"/>\n'
        f"  <worldbody>\n{bodies}  </worldbody>\n"
        + _couplings(table, placed)
        + f"  <actuator>\n{motors}  </actuator>\n</mujoco>\n"
    )


def _place(table: DhTable, convention: Convention, frames: Frames, R_base: Array) -> list[_Placed]:
    """Bodies in table order; a fixed row keeps the body that it is fixed to."""
    index = {row.link: i for i, row in enumerate(table.rows)}
    placed: list[_Placed] = []
    for row in table.rows:
        if row.prev is None:
            parent, R_before, p_before = -1, R_base, np.zeros(3)
        else:
            before = placed[index[row.prev]]
            fixed = table.rows[index[row.prev]].kind == "F"
            parent = before.parent if fixed else index[row.prev]
            R_before, p_before = before.R_end, before.p_end
        frame = _standard if convention == "standard" else _modified
        R, p, axis, anchor, R_end, p_end = frame(row, frames)
        R, p = R_before @ R, p_before + R_before @ p
        if row.kind == "F":
            R_end, p_end = R @ R_end, p + R @ p_end
        placed.append(
            _Placed(parent=parent, R=R, p=p, axis=axis, anchor=anchor, R_end=R_end, p_end=p_end)
        )
    return placed


_Pose = tuple[Array, Array, Array, Array, Array, Array]


def _standard(row: DhRow, frames: Frames) -> _Pose:
    """Body frame in frame prev, axis and anchor of its joint, frame i in the body frame."""
    theta, d = row.theta.constant, row.d.constant
    R = _Rz(theta) @ _Rx(row.alpha)
    p = _Rz(theta) @ np.array([row.a, 0.0, d])
    axis = _Rx(row.alpha).T @ np.array([0.0, 0.0, 1.0])
    if row.kind == "R" and frames == "joint":
        return R, np.zeros(3), axis, np.zeros(3), np.eye(3), R.T @ p
    anchor = -R.T @ p if row.kind == "R" else np.zeros(3)
    return R, p, axis, anchor, np.eye(3), np.zeros(3)


def _modified(row: DhRow, frames: Frames) -> _Pose:
    R = _Rx(row.alpha) @ _Rz(row.theta.constant)
    p = np.array([row.a, 0.0, 0.0]) + _Rx(row.alpha) @ np.array([0.0, 0.0, row.d.constant])
    z = np.array([0.0, 0.0, 1.0])
    return R, p, z, np.zeros(3), np.eye(3), np.zeros(3)


def _body(
    table: DhTable, placed: list[_Placed], i: int, massless: frozenset[str], indent: str
) -> str:
    row, body = table.rows[i], placed[i]
    kind = "hinge" if row.kind == "R" else "slide"
    limits = "" if row.limits is None else f' range="{_words(row.limits)}"'
    anchor = f' pos="{_words(body.anchor)}"' if body.anchor.any() else ""
    armature = f' armature="{ARMATURE}"' if row.link in massless else ""
    inner = "".join(
        _body(table, placed, k, massless, indent + "  ")
        for k, other in enumerate(placed)
        if other.parent == i and table.rows[k].kind != "F"
    )
    return (
        f'{indent}<body name="link{row.link}" pos="{_words(body.p)}" '
        f'quat="{_words(quaternion_of_matrix(body.R), 17)}">\n'
        f'{indent}  <joint name="j{row.link}" type="{kind}" axis="{_words(body.axis)}"{anchor}'
        f"{limits}{armature}/>\n"
        f"{indent}  {_inertial(table, placed, i, row.link in massless)}\n"
        f"{inner}{indent}</body>\n"
    )


def _inertial(table: DhTable, placed: list[_Placed], i: int, massless: bool) -> str:
    row = table.rows[i]
    com, size = _shape(table, placed, i)
    if massless:
        mass, moments = TINY[0], np.full(3, TINY[1])
    else:
        mass = DENSITY * float(np.prod(size)) if row.mass is None else row.mass
        # Without BLAS, whose order of summation differs between machines.
        moments = mass / 12 * (float((size**2).sum()) - size**2)
    if not mass > 0:
        raise UsageError(
            f"Link {row.link!r} has the mass {mass}; list it as massless or give it a mass."
        )
    return f'<inertial pos="{_words(com)}" mass="{mass:.9g}" diaginertia="{_words(moments)}"/>'


def _shape(table: DhTable, placed: list[_Placed], i: int) -> tuple[Array, Array]:
    """Centre and size (3,) in m of a box in the body frame: as in the table, else from the axis of
    the joint to the frame of the next link."""
    row, body = table.rows[i], placed[i]
    if row.size is not None:
        size = np.array(row.size)
    else:
        ends = [other.p for other in placed if other.parent == i] or [body.p_end]
        reach = max(ends, key=lambda p: float(np.linalg.norm(p - body.anchor))) - body.anchor
        size = np.maximum(np.abs(reach), WIDTH)
    if row.com is not None:
        return body.p_end + body.R_end @ np.array(row.com), size
    if row.size is not None:
        return body.p_end.copy(), size
    return body.anchor + 0.5 * reach, size


def _couplings(table: DhTable, placed: list[_Placed]) -> str:
    """Dependent joints as joint equalities, or as tendon equalities where they follow several;
    closed chains as connects."""
    equalities, tendons = "", ""
    for row in table.rows:
        if row.kind == "F" or not row.coupling_coefficients:
            continue
        joint = f"j{row.link}"
        if len(row.coupling_coefficients) == 1:
            ((name, value),) = row.coupling_coefficients.items()
            other = f"j{name[1:]}"
            polynomial = f"0 {value:.15g} 0 0 0"
            equalities += (
                f'    <joint joint1="{joint}" joint2="{other}" polycoef="{polynomial}"/>\n'
            )
            continue
        parts = "".join(
            f'      <joint joint="j{name[1:]}" coef="{-value:.15g}"/>\n'
            for name, value in row.coupling_coefficients.items()
        )
        tendons += (
            f'    <fixed name="t{row.link}">\n      <joint joint="{joint}" coef="1"/>\n{parts}'
            "    </fixed>\n"
        )
        equalities += f'    <tendon tendon1="t{row.link}"/>\n'
    index = {row.link: i for i, row in enumerate(table.rows)}
    for one, other in table.connects:
        equalities += (
            f'    <connect body1="link{one}" body2="link{other}" '
            f'anchor="{_words(placed[index[one]].p_end)}"/>\n'
        )
    return (f"  <tendon>\n{tendons}  </tendon>\n" if tendons else "") + (
        f"  <equality>\n{equalities}  </equality>\n" if equalities else ""
    )


def _Rx(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _Rz(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _rpy(angles: Sequence[float]) -> Array:
    roll, pitch, yaw = angles
    c, s = np.cos(pitch), np.sin(pitch)
    Ry = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    R: Array = _Rz(yaw) @ Ry @ _Rx(roll)
    return R


def _words(numbers: Sequence[float] | Array, digits: int = 15) -> str:
    # cos(pi/2) is 6e-17: such a number is a rounded zero, and is written as zero.
    return " ".join(f"{0.0 if abs(x) < 1e-15 else float(x):.{digits}g}" for x in numbers)
