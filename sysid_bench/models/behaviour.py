"""Behaviour of a robot as numbers: torques of its bodies at five states, and what they come from.

Baselines keep it, so that a gate names the joint and the quantity that changed; ids and versions
hold its hash, so that one name stands for one robot. It is that of the compiled model: comments,
the order of elements, paths of meshes, colours and what is only drawn do not change it.
"""

import hashlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.canonical_json import canonical_hash
from sysid_bench.models.assembly import tool_frame
from sysid_bench.models.behaviour_change import ROBOT, TORQUE, Behaviour, Values
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.tree import BALL, COORDINATES, FREE, HINGE
from sysid_bench.spatial import matrix_of_quaternion
from sysid_bench.types import Array

STATES: Final = 5
ORDER: Final = "order of joints"
_REACH: Final = {True: (1.5, 2.0, 3.0), False: (0.2, 0.5, 1.0)}
"""Largest q, v and a of hinges (and rotations) and of slides: every term of the equations of motion
is of the size of gravity. Limits do not count: another range must not change torques."""
_DIGITS: Final = 9
_NOISE: Final = 1e-12
"""Share of a robot's largest number of a kind below which numbers are rounding."""


def computed_record(manifest: Manifest, free_base: bool) -> dict[str, Any]:
    """Return the record of a robot (see `model_record`), which is loaded."""
    robot = load_robot(manifest, free_base=free_base)
    behaviour = behaviour_of(robot)
    return {"hash": model_hash(robot, behaviour), "behaviour": behaviour}


def behaviour_of(robot: RobotModel) -> dict[str, dict[str, Values]]:
    """Return the behaviour of a robot without payload."""
    names = [ROBOT, *(joint.name for joint in robot.joints)]
    found: dict[str, dict[str, Values]] = {name: {} for name in names}
    facts = [*_robot_facts(robot), *_link_facts(robot), *_joint_facts(robot), *_torques(robot)]
    of_kind = defaultdict[str, list[float]](list)
    for _, quantity, numbers in facts:
        of_kind[quantity] += [*numbers]
    for name, quantity, numbers in facts:
        found[name][quantity] = _rounded(numbers, of_kind[quantity])
    found[ROBOT][ORDER] = names[1:]
    for joint in robot.joints:
        found[joint.name]["kind"] = [joint.kind]
    return found


def model_hash(robot: RobotModel, behaviour: Behaviour) -> str:
    """Return 16 hex digits of a robot without payload: of its behaviour but for the torques, which
    follow from the rest, of its bodies and shapes by name, and of what its manifest asks for."""
    mj, manifest = robot.mj, robot.manifest
    bodies = [
        (name, int(robot.tree.carrier[b]), _rounded(robot.phi[b], robot.phi.ravel()),
         _rounded(robot.tree.X[b].ravel(), robot.tree.X[b].ravel()))
        for b, name in enumerate(robot.body_names)
    ]  # fmt: skip
    # Of what can touch: positions and sizes (of meshes those of their box), nothing that is drawn.
    solid = np.flatnonzero(np.asarray(mj.geom_contype) | np.asarray(mj.geom_conaffinity))
    shapes = [
        (int(mj.geom_bodyid[g]), int(mj.geom_type[g]),
         *(_rounded(part[g], part[g]) for part in (mj.geom_pos, mj.geom_size, mj.geom_aabb)))
        for g in solid
    ]  # fmt: skip
    sites = [(mj.site(s).name, int(mj.site_bodyid[s]), _rounded(place, place))
             for s, place in enumerate(mj.site_pos)]  # fmt: skip
    asked = [
        manifest.terms, manifest.massless, manifest.independent, dict(manifest.locked),
        [vars(sensor) for sensor in manifest.sensors], manifest.paper and vars(manifest.paper),
    ]  # fmt: skip
    known = {
        name: {key: numbers for key, numbers in quantities.items() if key != TORQUE}
        for name, quantities in behaviour.items()
    }
    return canonical_hash([known, bodies, shapes, sites, asked])[:16]


_Fact = tuple[str, str, Sequence[float] | Array]
"""Joint, quantity and numbers."""


def _robot_facts(robot: RobotModel) -> Iterator[_Fact]:
    """Yield gravity, tool frame and couplings."""
    mj = robot.mj
    index, (place, turn) = tool_frame(mj, robot.manifest, robot.body_names)
    yield ROBOT, "gravity", robot.tree.gravity
    yield (
        ROBOT,
        f"tool frame in {robot.body_names[index]}",
        [*place, *matrix_of_quaternion(turn).ravel()],
    )
    for e in range(mj.neq if robot.coupling is not None else 0):
        kind = mujoco.mjtEq(int(mj.eq_type[e])).name.removeprefix("mjEQ_")
        # Of joints and tendons MuJoCo states no type of their ends.
        named = getattr(mujoco.mjtObj, f"mjOBJ_{kind}", int(mj.eq_objtype[e]))
        pair = (mj.eq_obj1id[e], mj.eq_obj2id[e])
        ends = [mujoco.mj_id2name(mj, named, int(i)) or "world" for i in pair]
        yield ROBOT, f"coupling {kind.lower()} {' '.join(ends)}", mj.eq_data[e]


def _link_facts(robot: RobotModel) -> Iterator[_Fact]:
    """Yield (joint, quantity, numbers) of the links, each under the last joint of its body: where
    it is in the link before, and its mass, first moments and inertia with all that is welded."""
    for link, phi in zip(robot.tree.links, robot.tree.link_parameters(robot.phi), strict=True):
        named = {joint.vadr: joint.name for joint in robot.joints}
        name = named[link.joints[-1].vadr]
        yield name, "origin", [*link.p0, *link.R0.ravel()]
        yield name, "mass", phi[:1]
        yield name, "first moment of mass", phi[1:4]
        yield name, "inertia", phi[4:]
        for joint in link.joints:
            yield named[joint.vadr], "axis", [*joint.axis, *joint.anchor]
            if joint.q0:
                yield named[joint.vadr], "reference", [joint.q0]


def _joint_facts(robot: RobotModel) -> Iterator[_Fact]:
    """Yield (joint, quantity, numbers) of limits, joint terms and motors."""
    limits, terms = robot.limits, robot.joint_terms
    for joint in robot.joints:
        at = slice(joint.vadr, joint.vadr + len(joint.dofs))
        named: dict[str, Sequence[float] | Array] = {
            "range": [*limits.q_low[at], *limits.q_high[at]],
            "velocity limit": limits.v[at],
            "acceleration limit": limits.a[at],
            "effort limit": limits.tau[at],
            "viscous friction": terms.viscous[at],
            "dry friction": terms.coulomb[at],
            "torque offset": terms.offset[at],
            "armature": terms.armature[at],
            "spring": [*terms.spring[at], *terms.spring_reference[at]],
            "coupled friction": terms.viscous_coupling[at].ravel(),
            "gear": robot.motors.get(joint.name, ()),
        }
        for quantity, numbers in named.items():
            # What a robot does not have is not written: files stay small.
            if np.any(np.asarray(numbers)):
                yield joint.name, quantity, numbers


def _torques(robot: RobotModel) -> Iterator[_Fact]:
    """Yield the torques of bodies alone, on the tree without joint terms and couplings."""
    mj, data = robot.mj, mujoco.MjData(robot.mj)
    torques = np.zeros((STATES, mj.nv))
    for state, torque in enumerate(torques):
        data.qpos[:] = mj.qpos0
        for j, joint in enumerate(robot.joints):
            kind = int(mj.jnt_type[j])
            # By the joint's name, so that another joint more or less leaves those that stay.
            # Numbers (count,) in [-1, 1] that depend on the text alone, with every library
            text = f"{joint.name} {state}"
            count = 3 * len(joint.dofs) + 4
            digests = (hashlib.sha256(f"{text} {i}".encode()).digest() for i in range(count))
            drawn = np.array([int.from_bytes(digest[:6]) / 2**47 - 1.0 for digest in digests])
            q, v, a = _REACH[kind in (HINGE, BALL)]
            at = slice(joint.vadr, joint.vadr + len(joint.dofs))
            turn = drawn[-4:]  # MuJoCo makes it a unit quaternion
            place = {FREE: [*drawn[:3], *turn], BALL: turn}.get(kind, q * drawn[:1])
            first = joint.qadr
            data.qpos[first : first + COORDINATES[kind]] = place
            data.qvel[at], data.qacc[at] = (
                scale * part
                for scale, part in zip((v, a), np.split(drawn[:-4], 3)[1:], strict=True)
            )
        mujoco.mj_kinematics(mj, data)
        mujoco.mj_comPos(mj, data)
        mujoco.mj_comVel(mj, data)
        mujoco.mj_rne(mj, data, True, torque)
    for joint in robot.joints:
        yield joint.name, TORQUE, torques[:, joint.vadr : joint.vadr + len(joint.dofs)].ravel()


def _size(numbers: Sequence[float] | Array) -> float:
    """Largest finite absolute value."""
    values = np.abs(np.asarray(numbers, dtype=float))
    return float(values[np.isfinite(values)].max(initial=0.0))


def _rounded(numbers: Sequence[float] | Array, kind: Sequence[float] | Array) -> Values:
    """Return numbers with nine digits of the greatest of them, zeros where all are rounding beside
    the largest of their `kind`; infinities as texts. Processors differ in the last bits only."""
    values, size = np.asarray(numbers, dtype=float), _size(numbers)
    if size <= _NOISE * _size(kind):
        rounded = np.where(np.isfinite(values), 0.0, values)
    else:
        step = 10.0 ** (np.floor(np.log10(size)) + 1 - _DIGITS)
        rounded = np.round(values / step) * step
    return [
        float(f"{x:.{_DIGITS}g}") + 0.0 if np.isfinite(x) else str(x)  # no -0
        for x in rounded.tolist()
    ]
