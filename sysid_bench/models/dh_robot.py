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
from sysid_bench.models.dh_table import DhRow, DhTable
from sysid_bench.spatial import quaternion_of_matrix
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
    roll, pitch, yaw = base
    c, s = np.cos(pitch), np.sin(pitch)
    Ry = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    # Bodies in table order; a fixed row keeps the body that it is fixed to
    R_base = _Rz(yaw) @ Ry @ _Rx(roll)
    frame_of = {"standard": _standard, "modified": _modified}[convention]
    # Body that carries the DH frame of a link, and the pose of that frame in it.
    ends: dict[str | None, tuple[int, Array, Array]] = {None: (-1, R_base, np.zeros(3))}
    placed: list[_Placed] = []
    for i, row in enumerate(table.rows):
        parent, R_before, p_before = ends[row.prev]
        R, p, axis, anchor, p_end = frame_of(row, frames)
        R, p, R_end = R_before @ R, p_before + R_before @ p, np.eye(3)
        carrier = i
        if not row.is_joint:
            carrier, R_end, p_end = parent, R @ R_end, p + R @ p_end
        ends[row.link] = (carrier, R_end, p_end)
        body = _Placed(parent, R=R, p=p, axis=axis, anchor=anchor, R_end=R_end, p_end=p_end)
        placed.append(body)
    known = [row.link for row in table.rows]
    unknown = set(massless).difference(known)
    if unknown:
        raise unknown_name("massless link", min(unknown), known)
    bodies = _bodies(table, placed, -1, frozenset(massless), "    ")
    return (
        f"<mujoco model={quoteattr(name)}>\n"
        '  <compiler angle="radian" inertiafromgeom="false" autolimits="true"/>\n'
        f'  <option gravity="{_words(gravity)}" integrator="implicitfast"/>\n'
        f"  <worldbody>\n{bodies}  </worldbody>\n{_couplings(table, placed)}</mujoco>\n"
    )


def _couplings(table: DhTable, placed: list[_Placed]) -> str:
    """Sections of tendons, equalities and motors."""
    index = {row.link: i for i, row in enumerate(table.rows)}
    tendons = equalities = motors = ""
    for row in table.rows:
        joint, followed = f"j{row.link}", row.coupling_coefficients
        if row.is_joint and row.motor and not followed:
            motors += f'    <motor name="m{row.link}" joint="{joint}"/>\n'
        # MuJoCo's joint equality relates two joints; a fixed tendon adds up any number of them.
        if len(followed) == 1:
            ((driver, value),) = followed.items()
            polynomial = f'joint2="j{driver[1:]}" polycoef="0 {value:.15g} 0 0 0"'
            equalities += f'    <joint joint1="{joint}" {polynomial}/>\n'
        elif followed:
            # Its length is the joint's position minus that which the others give it.
            parts = {joint: "1"} | {f"j{n[1:]}": f"{-c:.15g}" for n, c in followed.items()}
            terms = "".join(f'      <joint joint="{j}" coef="{c}"/>\n' for j, c in parts.items())
            tendons += f'    <fixed name="t{row.link}">\n{terms}    </fixed>\n'
            equalities += f'    <tendon tendon1="t{row.link}"/>\n'
    for one, other in table.connects:
        anchor = f'anchor="{_words(placed[index[one]].p_end)}"'
        equalities += f'    <connect body1="link{one}" body2="link{other}" {anchor}/>\n'
    sections = {"tendon": tendons, "equality": equalities}
    couplings = (f"  <{tag}>\n{x}  </{tag}>\n" for tag, x in sections.items() if x)
    return f"{''.join(couplings)}  <actuator>\n{motors}  </actuator>\n"


_Pose = tuple[Array, Array, Array, Array, Array]


def _standard(row: DhRow, frames: Frames) -> _Pose:
    """Body frame in frame prev, axis and anchor of its joint, origin of frame i in the body frame,
    whose axes are those of frame i."""
    # The constants are the pose at zero joint variables, which MuJoCo takes as reference.
    theta, d = row.theta.constant, row.d.constant
    R = _Rz(theta) @ _Rx(row.alpha)
    p = _Rz(theta) @ np.array([row.a, 0.0, d])
    # The joint moves about or along z of frame prev; frame i is tilted from it by alpha.
    axis = _Rx(row.alpha).T @ np.array([0.0, 0.0, 1.0])
    if row.kind == "R" and frames == "joint":
        # Origin o_prev, axes of frame i: the lever arm p to o_i lies within the body.
        return R, np.zeros(3), axis, np.zeros(3), R.T @ p
    anchor = -R.T @ p if row.kind == "R" else np.zeros(3)
    return R, p, axis, anchor, np.zeros(3)


def _modified(row: DhRow, frames: Frames) -> _Pose:
    # a and alpha come before the joint: its axis is z of frame i, through o_i.
    R = _Rx(row.alpha) @ _Rz(row.theta.constant)
    p = np.array([row.a, 0.0, 0.0]) + _Rx(row.alpha) @ np.array([0.0, 0.0, row.d.constant])
    return R, p, np.array([0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3)


def _bodies(
    table: DhTable, placed: list[_Placed], parent: int, massless: frozenset[str], indent: str
) -> str:
    """The bodies whose parent is that of this index (-1: the world), and all bodies below them."""
    text = ""
    for i, (row, body) in enumerate(zip(table.rows, placed, strict=True)):
        if body.parent != parent or not row.is_joint:
            continue
        kind = "hinge" if row.kind == "R" else "slide"
        anchor = f' pos="{_words(body.anchor)}"' if body.anchor.any() else ""
        limits = "" if row.limits is None else f' range="{_words(row.limits)}"'
        armature = f' armature="{ARMATURE}"' if row.link in massless else ""
        text += (
            f'{indent}<body name="link{row.link}" pos="{_words(body.p)}" '
            f'quat="{_words(quaternion_of_matrix(body.R), 17)}">\n'
            f'{indent}  <joint name="j{row.link}" type="{kind}" axis="{_words(body.axis)}"{anchor}'
            f"{limits}{armature}/>\n"
            f"{indent}  {_inertial(row, placed, i, row.link in massless)}\n"
            f"{_bodies(table, placed, i, massless, indent + '  ')}{indent}</body>\n"
        )
    return text


def _inertial(row: DhRow, placed: list[_Placed], i: int, massless: bool) -> str:
    """Element of a box: as in the table, else from the joint's axis to the next link's frame."""
    body = placed[i]
    arms = [other.p - body.anchor for other in placed if other.parent == i]
    # The last link of a chain carries nothing: its own DH frame is its end.
    arms = arms or [body.p_end - body.anchor]
    reach = max(arms, key=lambda arm: float(np.linalg.norm(arm)))
    size = np.maximum(np.abs(reach), WIDTH) if row.size is None else np.array(row.size)
    com = body.anchor + 0.5 * reach if row.size is None else body.p_end
    if row.com is not None:
        com = body.p_end + body.R_end @ np.array(row.com)
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


def _Rx(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _Rz(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _words(numbers: Sequence[float] | Array, digits: int = 15) -> str:
    # cos(pi/2) is 6e-17: such a number is a rounded zero, and is written as zero.
    return " ".join(f"{0.0 if abs(x) < 1e-15 else float(x):.{digits}g}" for x in numbers)
