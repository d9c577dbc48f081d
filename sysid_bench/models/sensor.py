"""Force/torque sensors: where they cut a robot, the sub-tree downstream, and the rows they measure.

A sensor measures the wrench [n; f] that the carrying part exerts on the sub-tree downstream, about
the origin of the sensor frame and in its axes (MuJoCo's sign): Y_n phi where nothing touches the
sub-tree, Y_n phi - X f_x with an external wrench f_x on it (Traversaro et al. 2015, eq. 4).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Protocol

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, UnsupportedError, unknown_name
from sysid_bench.models.coupling.equalities import closure_frames
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.tree import FREE, HINGE, SLIDE, Tree, TreeJoint, tree_of
from sysid_bench.models.xml_file import parse_xml
from sysid_bench.spatial import matrix_of_quaternion
from sysid_bench.types import Array, Trajectory

COMPONENTS: Final = ("nx", "ny", "nz", "fx", "fy", "fz")
"""Rows of a sensor, `<sensor>.nx` and so on: moments first, as in every wrench here."""

KINDS: Final = ("wrench N m",) * 3 + ("wrench N",) * 3


@dataclass(frozen=True, eq=False)
class SensorSubtree:
    """A sensor between `body` and its parent; R (3, 3), p (3,): the sensor frame in the body.
    `bodies`: the sub-tree from `body` down to the next sensors, `end_sensors`."""

    name: str
    at: str
    body: int
    R: Array
    p: Array
    bodies: tuple[int, ...]
    end_sensors: tuple[str, ...] = ()

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the six components."""
        return tuple(f"{self.name}.{component}" for component in COMPONENTS)


class Measured(Protocol):
    """A tree and the names of its degrees of freedom: those of the robot, then further ones."""

    @property
    def tree(self) -> Tree:
        """The kinematic tree."""

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of its degrees of freedom (nv,)."""


@dataclass(frozen=True, eq=False)
class Instruments:
    """Measured rows of a robot: the torque of its degrees of freedom, then six rows per sensor.

    In `tree` a sensor is three hinges and three slides at rest at its frame. Their generalised
    forces are its wrench, so that one kernel serves all rows.
    """

    cuts: tuple[SensorSubtree, ...]
    tree: Tree
    rows: tuple[str, ...]  # of the tree: every degree of freedom, then the sensors
    measured: tuple[str, ...]  # of `rows`, without dependent joints, which carry no torque
    kinds: tuple[str, ...]  # of `measured`

    def motion(self, motion: Trajectory) -> Trajectory:
        """Return the motion (N, nv) with the joints of all sensors (N, nv + 6 sensors), at rest."""
        if not self.cuts:
            return motion
        # Joints that do not move carry the wrench through them, and add no velocity terms.
        still = np.zeros((len(motion), 6 * len(self.cuts)))
        q, v, a = (np.hstack([x, still]) for x in (motion.q, motion.v, motion.a))
        return replace(motion, q=q, v=v, a=a)

    def wrench_rows(self, cut: SensorSubtree) -> range:
        """Return the six indices of a sensor's wrench among the rows of the tree."""
        first = self.rows.index(cut.rows[0])
        return range(first, first + 6)


def instruments_of(robot: RobotModel, cuts: Sequence[SensorSubtree] = ()) -> Instruments:
    """Return the measured rows of a robot with these sensors; raises UnsupportedError for two
    sensors at one body."""
    if len({cut.body for cut in cuts}) < len(cuts):
        raise UnsupportedError(
            f"{robot.name}: two of the sensors {', '.join(cut.name for cut in cuts)} cut at one "
            "body; they measure the same wrench."
        )
    joints = {}
    for s, cut in enumerate(cuts):
        # Three hinges, then three slides along the axes of the sensor frame: a wrench [n; f].
        axes = enumerate(zip([HINGE] * 3 + [SLIDE] * 3, [*cut.R.T, *cut.R.T], strict=True), 6 * s)
        joints[cut.body] = tuple(
            TreeJoint(kind, robot.mj.nq + k, robot.nv + k, axis, cut.p, 0.0)
            for k, (kind, axis) in axes
        )
    wrenches = tuple(row for cut in cuts for row in cut.rows)
    return Instruments(
        cuts=tuple(cuts),
        tree=tree_of(robot.mj, joints) if cuts else robot.tree,
        rows=robot.rows + wrenches,
        measured=robot.torque_rows + wrenches,
        kinds=robot.torque_units + KINDS * len(cuts),
    )


@dataclass(frozen=True, eq=False)
class FloatingSubtree:
    """The sub-tree of a sensor on its own, its first body on a free joint: any base pose, twist and
    acceleration. `root` are the indices of the six free degrees of freedom in v."""

    cut: SensorSubtree
    tree: Tree
    rows: tuple[str, ...]
    free: TreeJoint

    @property
    def wrench_rows(self) -> range:
        """The six indices of the free base among the rows."""
        return self.free.dofs

    @cached_property
    def joints(self) -> tuple[int, ...]:
        """Indices in v of the degrees of freedom inside the sub-tree."""
        inside = {int(dof) for link in self.tree.links for dof in link.dofs}
        return tuple(sorted(inside - set(self.wrench_rows)))


def floating_subtree(robot: RobotModel, cut: SensorSubtree) -> FloatingSubtree:
    """Return the sub-tree of a sensor as a floating robot; addresses in q and v stay, the free base
    comes last.

    Its base parameters are those of arbitrary base motions (Traversaro et al. 2015, eq. 6).
    """
    free = TreeJoint(FREE, robot.mj.nq, robot.nv, np.zeros(3), np.zeros(3), 0.0)
    whole = tree_of(robot.mj, {cut.body: (free,)})
    inside = [i for i, link in enumerate(whole.links) if link.body in cut.bodies]
    new_index = {old: new for new, old in enumerate(inside)}
    # Bodies outside become fixed to the world, where their parameters act on no joint.
    carrier = np.full(len(whole.carrier), -1)
    bodies = list(cut.bodies)
    carrier[bodies] = [new_index.get(int(old), -1) for old in whole.carrier[bodies]]
    # The first link is on the free joint alone; degrees of freedom are counted from there.
    root, *others = (whole.links[i] for i in inside)
    links = [replace(root, parent=-1, joints=(free,), dofs=np.array(free.dofs))]
    for link in others:
        parent = new_index[link.parent]
        own = [dof for joint in link.joints for dof in joint.dofs]
        links.append(replace(link, parent=parent, dofs=np.array([*links[parent].dofs, *own])))
    tree = replace(whole, links=tuple(links), carrier=carrier)
    free_rows = tuple(f"{cut.name}.free{k}" for k in range(6))
    return FloatingSubtree(cut, tree, robot.rows + free_rows, free)


def subtree_at(
    robot: RobotModel, sensor: str, others: Sequence[str] | None = None
) -> SensorSubtree:
    """Return the cut of a sensor: one of the robot's manifest by name, or any fixed joint, site or
    body.

    `others`: sensors that end the sub-tree where they are downstream (None: those of the manifest).
    A site cuts between its body and the parent. Raises UsageError for an unknown name, and
    ModelError or UnsupportedError where nothing can be cut there.
    """
    named = {entry.name: entry.at for entry in robot.manifest.sensors}
    at = named.get(sensor, sensor)
    body, R, p = _frame(robot, at)
    others = tuple(named) if others is None else others
    ends = {_frame(robot, named.get(other, other))[0]: other for other in others}
    ends.pop(body, None)  # the sensor itself, where it is one of the others
    bodies = [body]  # and its descendants, without those at the ends and their descendants
    for b in range(body + 1, len(robot.body_names)):  # parents come before their children
        if _parent(robot, b) in bodies and b not in ends:
            bodies.append(b)
    return SensorSubtree(
        name=sensor,
        at=at,
        body=body,
        R=R,
        p=p,
        bodies=tuple(bodies),
        end_sensors=tuple(name for end, name in ends.items() if _parent(robot, end) in bodies),
    )


def sensor_names(text: str) -> list[str]:
    """Return the sensors of a list such as "left, right"."""
    return [name.strip() for name in text.split(",") if name.strip()]


def default_sensor(robot: RobotModel, sensor: str | None) -> str:
    """Return the given name, or the only sensor of the robot's manifest; raises UnsupportedError,
    with the known sensors, for several or none."""
    names = [entry.name for entry in robot.manifest.sensors]
    if sensor is None and len(names) == 1:
        return names[0]
    if sensor is None:
        there = f"has the sensors {', '.join(names)}" if names else "has no force/torque sensor"
        raise UnsupportedError(
            f"{robot.name} {there}: say which one to use with --sensor (in a suite: sensor = ...), "
            "or name a fixed joint, site or body to cut at."
        )
    if len(sensor_names(sensor)) > 1:
        raise UnsupportedError(
            f"{robot.name}: the sensors {sensor} each have a sub-tree of their own; use one at a "
            "time, or the task 'robot', which takes several besides all joint torques."
        )
    return sensor


def end_body(robot: RobotModel, cut: SensorSubtree) -> int:
    """Return the tool body where it is distal to the sensor, else the body with the most joints."""
    if robot.tool_body in cut.bodies:
        return robot.tool_body
    carrier, links = robot.tree.carrier, robot.tree.links
    return max(cut.bodies, key=lambda b: len(links[carrier[b]].dofs) if carrier[b] >= 0 else 0)


def _fixed_moving(robot: RobotModel) -> tuple[dict[str, str], set[str]]:
    """Fixed joints with the links below them, and the names of moving joints."""
    fixed: dict[str, str] = {}
    moving = {joint.name for joint in robot.joints}
    if robot.format == "urdf" and robot.text:
        # From the text: the compiled model welds the links of fixed joints and forgets their names.
        for joint in parse_xml(robot.text, robot.name).findall(".//joint[child]"):
            if joint.get("type") == "fixed":
                fixed[joint.get("name", "")] = joint.findall("child")[0].get("link", "")
            else:
                moving.add(joint.get("name", ""))
    return fixed, moving


def _frame(robot: RobotModel, at: str) -> tuple[int, Array, Array]:
    """(body, R, p) of a fixed joint, a site or a body."""
    fixed, moving = _fixed_moving(robot)
    if at in fixed and fixed[at] not in robot.body_names:
        raise ModelError(
            f"{robot.name}: the link {fixed[at]!r} distal to the sensor is not a body of the robot."
        )
    sites = {robot.mj.site(s).name: s for s in range(robot.mj.nsite)}
    if at in sites and at not in fixed:
        s = sites[at]
        body = int(robot.mj.site_bodyid[s]) - 1
        if body < 0:
            raise ModelError(
                f"{robot.name}: the site {at!r} belongs to the world; a sensor's site belongs to "
                "the first body downstream."
            )
        R = matrix_of_quaternion(np.array(robot.mj.site_quat[s]))
        return body, R, np.array(robot.mj.site_pos[s])
    if fixed.get(at, at) in robot.body_names:
        return robot.body_names.index(fixed.get(at, at)), np.eye(3), np.zeros(3)
    if at in moving:
        raise UnsupportedError(
            f"{robot.name}: {at!r} is a moving joint; a sensor sits at a fixed joint, a site "
            "or a body: name the body distal to it."
        )
    sensors = robot.manifest.sensors
    declared = ", ".join(f"{s.name} at {s.at}" for s in sensors[:8])
    advice = f"Sensors of the robot: {declared}." if declared else ""
    known = [*(s.name for s in sensors), *fixed, *sites, *robot.body_names]
    raise unknown_name("sensor, fixed joint, site or body", at, known, advice)


def _parent(robot: RobotModel, body: int) -> int:
    """Index of the parent of a body; -1 for the world, which MuJoCo counts as body 0."""
    return int(robot.mj.body_parentid[body + 1]) - 1


def chain_bodies(robot: RobotModel) -> tuple[tuple[int, int], ...]:
    """Return the two bodies that each closed chain joins, -1 for the world; none where the robot's
    couplings are ignored."""
    if robot.coupling is None:
        return ()
    kinds = int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)
    chains = [e for e in range(robot.mj.neq) if robot.mj.eq_type[e] in kinds]
    ends = [[body - 1 for body, _, _ in closure_frames(robot.mj, e)] for e in chains]
    return tuple((one, other) for one, other in ends)


def check_chain(robot: RobotModel, cut: SensorSubtree) -> None:
    """Raise UnsupportedError where a closed chain leads past a sensor: its closing force also acts
    on the sub-tree, and the sensor does not measure it."""
    names = [*robot.body_names, "world"]
    for one, other in chain_bodies(robot):
        if (one in cut.bodies) != (other in cut.bodies):
            raise UnsupportedError(
                f"{robot.name}: a closed chain joins {names[one]} and {names[other]} past the "
                f"sensor {cut.name}, which does not measure its force; cut proximal or distal to "
                "the whole chain."
            )
