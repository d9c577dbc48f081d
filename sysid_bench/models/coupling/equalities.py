"""Active equalities of a MuJoCo model as constraints on coordinates: joint and tendon equalities
become polynomials, connects and welds closed chains."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from sysid_bench.errors import ModelError
from sysid_bench.models.coupling.constraints import (
    Chain,
    ChainClosure,
    ChainJoint,
    Constraint,
    PolynomialCoupling,
    Step,
)
from sysid_bench.models.tree import BALL, DOFS, FREE, HINGE, SLIDE
from sysid_bench.models.urdf import Mimic
from sysid_bench.spatial import matrix_of_quaternion
from sysid_bench.types import Array

_JOINT: Final = int(mujoco.mjtEq.mjEQ_JOINT)
_TENDON: Final = int(mujoco.mjtEq.mjEQ_TENDON)
_CONNECT: Final = int(mujoco.mjtEq.mjEQ_CONNECT)
_WELD: Final = int(mujoco.mjtEq.mjEQ_WELD)
_SITE: Final = int(mujoco.mjtObj.mjOBJ_SITE)
_WRAPS_JOINT: Final = int(mujoco.mjtWrap.mjWRAP_JOINT)

ADVICE: Final = "write couplings = false in a robot.toml to let every joint move on its own"


@dataclass(frozen=True, eq=False)
class Equalities:
    """The constraints of a model, the ids of their equalities, and the active equalities that are
    left out, in words."""

    constraints: tuple[Constraint, ...]
    ids: tuple[int, ...]
    left_out: tuple[str, ...]


def equalities_of(mj: mujoco.MjModel) -> Equalities:
    """Return the constraints of a compiled model; raises ModelError for spatial tendons."""
    constraints: list[Constraint] = []
    ids, left_out = [], []
    for e in range(mj.neq):
        if not mj.eq_active0[e]:
            continue
        kind, reason = int(mj.eq_type[e]), ""
        if kind in (_CONNECT, _WELD):
            bodies = one, other = [body for body, _, _ in closure_frames(mj, e)]
            if (mj.body_mocapid[bodies] >= 0).any():
                reason = "a mocap body is moved by hand"
            elif not _joints_on(mj, _path(mj, one, other) + _path(mj, other, one)):
                reason = "its bodies move together already"
        elif kind not in (_JOINT, _TENDON):
            reason = "it couples no joints"
        if reason:
            left_out.append(f"equality {_name(mj, e)} left out: {reason}")
            continue
        constraints.append(_constraint(mj, e))
        ids.append(e)
    return Equalities(tuple(constraints), tuple(ids), tuple(left_out))


def select_equalities(spec: mujoco.MjSpec, equalities: Equalities) -> None:
    """Delete all equalities of a spec that are not constraints of the robot's coupling."""
    for equality in [e for e in spec.equalities if e.id not in equalities.ids]:
        spec.delete(equality)


def _constraint(mj: mujoco.MjModel, e: int) -> Constraint:
    kind = int(mj.eq_type[e])
    if kind in (_JOINT, _TENDON):
        first, second = coupled_terms(mj, e)
        dofs = tuple(sorted(first | second))
        coefficients = np.array(mj.eq_data[e, :5])
        if not second:  # MuJoCo then holds the first sum at the constant and ignores the rest
            coefficients[1:] = 0.0
        return PolynomialCoupling(
            _name(mj, e),
            dofs,
            np.array([first.get(dof, 0.0) for dof in dofs]),
            np.array([second.get(dof, 0.0) for dof in dofs]),
            coefficients,
        )
    # eq_data[10] of a weld is its torquescale: zero leaves the orientation free, as a connect does.
    rigid = kind == _WELD and mj.eq_data[e, 10] > 0
    (one, p1, R1), (other, p2, R2) = closure_frames(mj, e)
    paths = _path(mj, one, other), _path(mj, other, one)
    joints = _joints_on(mj, paths[0] + paths[1])
    dofs = tuple(sorted(dof for j in joints for dof in _dofs_of(mj, j)))
    chains = (
        Chain(tuple(_steps(mj, paths[0], dofs)), p1, R1),
        Chain(tuple(_steps(mj, paths[1], dofs)), p2, R2),
    )
    return ChainClosure(_name(mj, e), dofs, *chains, rigid)


def coupled_terms(mj: mujoco.MjModel, e: int) -> tuple[dict[int, float], dict[int, float]]:
    """Return the two sums {dof: coefficient} that a joint or tendon equality relates; the second
    may be empty."""
    sums: list[dict[int, float]] = []
    for end in (int(mj.eq_obj1id[e]), int(mj.eq_obj2id[e])):
        if int(mj.eq_type[e]) == _JOINT:
            sums.append({int(mj.jnt_dofadr[end]): 1.0} if end >= 0 else {})
        else:
            sums.append(_tendon_sum(mj, end) if end >= 0 else {})
    return sums[0], sums[1]


def _tendon_sum(mj: mujoco.MjModel, t: int) -> dict[int, float]:
    total: dict[int, float] = {}
    for w in range(int(mj.tendon_adr[t]), int(mj.tendon_adr[t] + mj.tendon_num[t])):
        if int(mj.wrap_type[w]) != _WRAPS_JOINT:
            raise ModelError(
                f"The equality of tendon {mj.tendon(t).name!r} cannot be resolved: its length is "
                f"not a sum of joint positions; use a fixed tendon, or {ADVICE}."
            )
        # wrap_prm of a joint is its coefficient in the length of the tendon.
        dof = int(mj.jnt_dofadr[mj.wrap_objid[w]])
        total[dof] = total.get(dof, 0.0) + float(mj.wrap_prm[w])
    return total


def _dofs_of(mj: mujoco.MjModel, j: int) -> range:
    first = int(mj.jnt_dofadr[j])
    return range(first, first + DOFS[int(mj.jnt_type[j])])


def closure_frames(mj: mujoco.MjModel, e: int) -> tuple[tuple[int, Array, Array], ...]:
    """Return (body, p, R) of the two frames that a connect or weld makes coincide."""
    ids = int(mj.eq_obj1id[e]), int(mj.eq_obj2id[e])
    if int(mj.eq_objtype[e]) == _SITE:
        return tuple(
            (int(mj.site_bodyid[s]), np.array(mj.site_pos[s]), _matrix(mj.site_quat[s]))
            for s in ids
        )
    data, unturned = np.array(mj.eq_data[e]), np.eye(3)
    if int(mj.eq_type[e]) == _CONNECT:
        return (ids[0], data[:3], unturned), (ids[1], data[3:6], unturned)
    # eq_data of a weld: the anchor in the second body, then the relative pose in the first.
    return (ids[0], data[3:6], _matrix(data[6:10])), (ids[1], data[:3], unturned)


def _matrix(quaternion: Array) -> Array:
    return matrix_of_quaternion(np.array(quaternion) / np.linalg.norm(quaternion))


def _path(mj: mujoco.MjModel, body: int, other: int) -> list[int]:
    """The bodies from the last common ancestor (excluded) to `body`."""
    mine, theirs = _ancestors(mj, body), set(_ancestors(mj, other))
    return [b for b in reversed(mine) if b not in theirs]


def _ancestors(mj: mujoco.MjModel, body: int) -> list[int]:
    """A body, its parent, and so on to the world."""
    found = [body]
    while found[-1] > 0:
        found.append(int(mj.body_parentid[found[-1]]))
    return found


def _joints_on(mj: mujoco.MjModel, path: list[int]) -> list[int]:
    return [int(mj.body_jntadr[b]) + k for b in path for k in range(int(mj.body_jntnum[b]))]


def _steps(mj: mujoco.MjModel, path: list[int], dofs: tuple[int, ...]) -> Iterator[Step]:
    for b in path:
        R = _matrix(mj.body_quat[b])
        joints: list[ChainJoint] = []
        for j in _joints_on(mj, [b]):
            # The hinges and slides that move a body as the joint does, in the order of
            # `coordinates`: (slide, axis).
            kind, anchor = int(mj.jnt_type[j]), np.array(mj.jnt_pos[j])
            parts = [(kind == SLIDE, np.array(mj.jnt_axis[j]))]
            if kind in (BALL, FREE):
                parts = [(False, axis) for axis in np.eye(3)]
            if kind == FREE:
                # Displacements in world axes, given in the body; it turns about its origin.
                anchor = np.zeros(3)
                parts = [*((True, R.T @ axis) for axis in np.eye(3)), *parts]
            for dof, (slide, axis) in zip(_dofs_of(mj, j), parts, strict=True):
                joints.append(ChainJoint(dofs.index(dof), slide, axis, anchor))
        yield Step(np.array(mj.body_pos[b]), R, tuple(joints))


def _name(mj: mujoco.MjModel, e: int) -> str:
    name = mj.equality(e).name
    return repr(name) if name else f"{e + 1} (unnamed)"


def mimic_equalities(spec: mujoco.MjSpec, mimics: Sequence[Mimic]) -> Iterator[str]:
    """Add an equality for each mimic joint q = multiplier * q_driver + offset; yield, in words,
    those whose driver does not move."""
    moving = {joint.name for joint in spec.joints if int(joint.type) in (HINGE, SLIDE)}
    for mimic in (mimic for mimic in mimics if mimic.joint in moving):
        if mimic.driver in moving - {mimic.joint}:
            equality = spec.add_equality(name=f"mimic of {mimic.joint}")
            equality.type = mujoco.mjtEq.mjEQ_JOINT
            equality.objtype = mujoco.mjtObj.mjOBJ_JOINT
            equality.name1, equality.name2 = mimic.joint, mimic.driver
            # Coefficients of the driver's position in ascending order, up to the fourth power.
            equality.data[:5] = [mimic.offset, mimic.multiplier, 0.0, 0.0, 0.0]
        else:
            yield (
                f"joint {mimic.joint!r} treated as independent: it mimics {mimic.driver!r}, which "
                "is not another hinge or slide of the robot"
            )
