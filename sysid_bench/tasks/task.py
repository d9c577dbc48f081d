"""What is unknown: the parameters of a task, their true values, and what methods take as known."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.errors import UnsupportedError, unknown_name
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import SensorCut, cut_at, instruments_of, sensor_names, the_sensor
from sysid_bench.spatial.inertia import transport
from sysid_bench.spatial.rotation import matrix_of_quaternion
from sysid_bench.types import Array, Body, Truth

TASKS: Final = ("robot", "payload", "link", "terminal", "wrench", "wrench-payload")
SENSOR_TASKS: Final = ("wrench", "wrench-payload")
"""Tasks that look at a force/torque sensor alone."""

WITH_TERMS: Final = ("robot", "terminal", *SENSOR_TASKS)
"""Tasks whose unknowns may hold terms of joints or sensors; in the others these are known."""


@dataclass(frozen=True, eq=False)
class Task:
    """A question about a robot. `truth` holds the unknowns; `known_links` (n_links, 10) and
    `known_terms` (by term, (nv,)) and `known_coupling` (nv, nv), the viscous one, are the parts of
    the plant that methods are given."""

    name: str
    bodies: tuple[Body, ...]
    truth: Truth
    known_links: Array
    known_terms: dict[str, Array]
    rows: tuple[str, ...] | None = None
    """Names of the degrees of freedom whose torque is measured, or of a sensor's six components;
    None: all degrees of freedom."""
    cuts: tuple[SensorCut, ...] = ()
    """The force/torque sensors that are looked at; where one is measured alone, those that end its
    sub-tree come after it."""
    known_coupling: Array | None = None

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the unknowns (p,)."""
        return self.truth.parameters

    @property
    def end_sensors(self) -> tuple[SensorCut, ...]:
        """The sensors whose wrench is taken from that of the first."""
        return self.cuts[1:] if self.name in SENSOR_TASKS else ()

    @property
    def has_known_part(self) -> bool:
        """Whether a known torque has to be taken from the measured one."""
        terms = (*self.known_terms.values(), self.known_coupling)
        return bool(self.known_links.any() or any(v is not None and v.any() for v in terms))


def task_of(
    robot: RobotModel,
    name: str,
    terms: tuple[str, ...],
    sensor: str | None = None,
    offset: Callable[[int], Array] | None = None,
) -> Task:
    """The task `robot` (links and `terms`), `payload` or `link` (ten numbers, the rest known), or
    `terminal` (the last joint's torque alone: ten numbers of its link, and its `terms`).

    `wrench`: what is behind a force/torque `sensor`, from that sensor alone; `wrench-payload`: the
    payload's ten numbers from it, the rest known. With the term "offset" the constants of the
    sensor and of those that end its sub-tree are unknown as well; `offset` of their number gives
    the true ones (6 count,).

    With a `sensor` (several: "left, right") the tasks `robot` and `payload` look at it beside all
    joint torques. Joint terms that are not identified are known. Raises UnsupportedError where the
    robot or the payload has no such unknowns.
    """
    task = _task_of(robot, name, terms, sensor, offset)
    if name in SENSOR_TASKS:
        return task
    identified = robot.term_columns(terms)
    return replace(task, known_coupling=_coupling_without(robot, identified, task.parameters))


def _task_of(
    robot: RobotModel,
    name: str,
    terms: tuple[str, ...],
    sensor: str | None,
    offset: Callable[[int], Array] | None,
) -> Task:
    match name:
        case "robot":
            return _beside_sensors(robot, _robot(robot, terms), sensor)
        case "payload":
            return _beside_sensors(robot, _payload(robot), sensor)
        case "link":
            return _link(robot)
        case "terminal":
            return _terminal(robot, terms)
        case "wrench" | "wrench-payload":
            behind = _behind_sensor(robot, the_sensor(robot, sensor), name == "wrench")
            return _with_offset(behind, terms, offset)
    raise unknown_name("task", name, TASKS)


def _with_payload(robot: RobotModel) -> Array:
    """phi (nb, 10) with the payload's as part of the body that carries it."""
    phi = robot.phi.copy()
    if robot.payload_body is not None:
        b = robot.payload_body + 1  # MuJoCo counts the world
        R = matrix_of_quaternion(np.array(robot.mj.body_quat[b]))
        phi[robot.tool_body] += (
            transport(R, np.array(robot.mj.body_pos[b])) @ phi[robot.payload_body]
        )
    return phi


def _behind_sensor(robot: RobotModel, sensor: str, all_bodies: bool) -> Task:
    """All bodies behind a sensor, or the payload alone with the others known."""
    cut = cut_at(robot, sensor)
    cuts = (cut, *(cut_at(robot, stop) for stop in cut.end_sensors))
    own = [b for b in cut.bodies if b != robot.payload_body]
    known, phi = np.zeros_like(robot.phi), _with_payload(robot)
    if not all_bodies:
        if robot.payload_body is None or robot.payload_body not in cut.bodies:
            raise UnsupportedError(
                f"No payload is mounted behind the sensor {sensor!r}: the task 'wrench-payload' "
                "has nothing to identify."
            )
        known[own], phi, own = robot.phi[own], robot.phi, [robot.payload_body]
    bodies = tuple(robot.bodies[b] for b in own)
    columns = tuple(column for body in bodies for column in body.columns)
    return Task(
        "wrench" if all_bodies else "wrench-payload",
        bodies,
        Truth(columns, phi[own].ravel()),
        instruments_of(robot, cuts).tree.composite_links(known),
        {},
        cut.rows,
        cuts,
    )


def _beside_sensors(robot: RobotModel, task: Task, sensor: str | None) -> Task:
    """The task with the rows of sensors after those of all joints."""
    if sensor is None:
        return task
    cuts = tuple(cut_at(robot, name, ()) for name in sensor_names(sensor))
    asked = {body.name for body in task.bodies}
    known = robot.phi if task.name == "payload" else _with_payload(robot)
    known = known * [[float(name not in asked)] for name in robot.body_names]
    if robot.payload_body is not None:
        known[robot.payload_body] = 0.0  # asked for, or a part of the tool's body
    lumped = instruments_of(robot, cuts).tree.composite_links(known)
    rows = robot.torque_rows + tuple(row for cut in cuts for row in cut.rows)
    return replace(task, rows=rows, cuts=cuts, known_links=lumped)


def _with_offset(task: Task, terms: tuple[str, ...], offset: Callable[[int], Array] | None) -> Task:
    """The task with the constants of its sensors unknown as well, where that is asked for."""
    if not terms:
        return task
    if terms != ("offset",):
        raise UnsupportedError(
            f"A force/torque sensor feels no joint term: {', '.join(terms)} cannot be identified "
            f"with the task {task.name!r}; 'offset' alone can, the sensor's own constants."
        )
    columns = tuple(f"{row}.{SUFFIX['offset']}" for cut in task.cuts for row in cut.rows)
    true = np.zeros(len(columns)) if offset is None else offset(len(task.cuts))
    truth = Truth(task.parameters + columns, np.concatenate([task.truth.theta, true]))
    return replace(task, truth=truth)


def _robot(robot: RobotModel, terms: tuple[str, ...]) -> Task:
    phi = _with_payload(robot)
    asked = {body.name for body in unknown_bodies(robot)}
    own = [i for i, name in enumerate(robot.body_names) if name in asked]
    bodies = tuple(robot.bodies[i] for i in own)
    columns = tuple(column for body in bodies for column in body.columns) + robot.term_columns(
        terms
    )
    theta = np.concatenate([phi[own].ravel(), robot.term_values(terms)])
    rest = phi.copy()
    rest[own] = 0.0
    if robot.payload_body is not None:
        rest[robot.payload_body] = 0.0  # it is part of the tool's body
    known = robot.tree.composite_links(rest)
    return Task("robot", bodies, Truth(columns, theta), known, _terms_without(robot, terms))


def unknown_bodies(robot: RobotModel) -> tuple[Body, ...]:
    """The bodies whose parameters the task "robot" asks for: all but the payload and those that
    the manifest calls massless, which weigh what the model says."""
    names = robot.body_names
    load = None if robot.payload_body is None else names[robot.payload_body]
    return tuple(
        b for b in robot.bodies if b.name != load and b.name not in robot.manifest.massless
    )


def _payload(robot: RobotModel) -> Task:
    if robot.payload_body is None:
        raise UnsupportedError("No payload is mounted: the task 'payload' has nothing to identify.")
    known = robot.phi.copy()
    known[robot.payload_body] = 0.0
    body = robot.bodies[robot.payload_body]
    truth = Truth(body.columns, robot.phi[robot.payload_body])
    return Task(
        "payload", (body,), truth, robot.tree.composite_links(known), _terms_without(robot, ())
    )


def _link(robot: RobotModel) -> Task:
    """The composite of the link that carries the tool: with all that is welded to it."""
    link = int(robot.tree.carrier[robot.tool_body])
    if link < 0:
        raise UnsupportedError(f"The tool {robot.body_names[robot.tool_body]!r} does not move.")
    body = robot.bodies[robot.tree.links[link].body]
    lumped = robot.tree.composite_links(robot.phi)
    known = lumped.copy()
    known[link] = 0.0
    return Task(
        "link", (body,), Truth(body.columns, lumped[link]), known, _terms_without(robot, ())
    )


def _terminal(robot: RobotModel, terms: tuple[str, ...]) -> Task:
    """What the last joint before the tool tells on its own: of the composite of the link that it
    carries, and of its own terms; where it follows another joint, that one's torque and terms."""
    link = _link(robot)
    dofs = _last_measured(robot)
    rows = tuple(robot.rows[dof] for dof in dofs)
    asked = tuple(c for c in robot.term_columns(terms) if robot.term_index(c)[1] in dofs)
    truth = Truth(
        link.parameters + asked,
        np.concatenate([link.truth.theta, robot.term_values(asked)]),
    )
    known = _terms_without(robot, asked)
    return Task("terminal", link.bodies, truth, link.known_links, known, rows)


def _last_measured(robot: RobotModel) -> Sequence[int]:
    """The degrees of freedom whose torque is that of the last joint of the tool's branch: its own,
    or where it follows others the last that it follows."""
    moving, at = set(robot.torque_dofs.tolist()), int(robot.tree.carrier[robot.tool_body])
    while at >= 0:
        link = robot.tree.links[at]
        for joint in reversed(link.joints):
            if moving.issuperset(joint.dofs):
                return joint.dofs
            assert robot.coupling is not None
            drivers = robot.coupling.independent_of(joint.vadr)
            if len(drivers):
                return [int(drivers[-1])]
        at = link.parent
    raise UnsupportedError(
        f"No joint before the tool {robot.body_names[robot.tool_body]!r} can move; name another "
        "tool in the manifest."
    )


def _terms_without(robot: RobotModel, identified: tuple[str, ...]) -> dict[str, Array]:
    """The terms (nv,) that methods are given; identified ones are unknown, and zero here."""
    known = {term: getattr(robot.joint_terms, term).copy() for term in SUFFIX}
    for name in robot.term_columns(identified):
        term, dof, other = robot.term_index(name)
        if other is None:
            known[term][dof] = 0.0
    return known


def _coupling_without(
    robot: RobotModel, identified: tuple[str, ...], unknown: tuple[str, ...]
) -> Array:
    """The viscous coupling (nv, nv) that methods are given."""
    known = robot.joint_terms.viscous_coupling.copy()
    for name in set(identified).intersection(unknown):
        _, dof, other = robot.term_index(name)
        if other is not None:
            known[dof, other] = 0.0
    return known
