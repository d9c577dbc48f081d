"""What is unknown: the parameters of a task, their true values, and what methods take as known."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.errors import UnsupportedError, unknown_name
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.spatial.inertia import transport
from sysid_bench.spatial.rotation import matrix_of_quaternion
from sysid_bench.types import Array, Body, Truth

TASKS: Final = ("robot", "payload", "link", "terminal", "wrench")


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
    """Names of the degrees of freedom whose torque is measured; None: all."""
    known_coupling: Array | None = None

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the unknowns (p,)."""
        return self.truth.parameters

    @property
    def knows_something(self) -> bool:
        """Whether a known torque has to be taken from the measured one."""
        terms = (*self.known_terms.values(), self.known_coupling)
        return bool(self.known_links.any() or any(v is not None and v.any() for v in terms))


def task_of(robot: RobotModel, name: str, terms: tuple[str, ...]) -> Task:
    """The task `robot` (links and `terms`), `payload` or `link` (ten numbers, the rest known), or
    `terminal` (the last joint's torque alone: ten numbers of its link, and its `terms`).

    Joint terms that are not identified are known. Raises UnsupportedError where the robot or the
    payload has no such unknowns.
    """
    identified = robot.term_columns(terms)
    task = _task_of(robot, name, terms)
    return replace(task, known_coupling=_coupling_without(robot, identified, task.parameters))


def _task_of(robot: RobotModel, name: str, terms: tuple[str, ...]) -> Task:
    match name:
        case "robot":
            return _robot(robot, terms)
        case "payload":
            return _payload(robot)
        case "link":
            return _link(robot)
        case "terminal":
            return _terminal(robot, terms)
        case "wrench":
            raise UnsupportedError(f"The task {name!r} is not available in this version.")
    raise unknown_name("task", name, TASKS)


def _robot(robot: RobotModel, terms: tuple[str, ...]) -> Task:
    phi = robot.phi.copy()
    if robot.payload_body is not None:
        b = robot.payload_body + 1  # MuJoCo counts the world
        R = matrix_of_quaternion(np.array(robot.mj.body_quat[b]))
        phi[robot.tool_body] += (
            transport(R, np.array(robot.mj.body_pos[b])) @ phi[robot.payload_body]
        )
    asked = {body.name for body in asked_bodies(robot)}
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
    known = robot.tree.lumped(rest)
    return Task("robot", bodies, Truth(columns, theta), known, _terms_without(robot, terms))


def asked_bodies(robot: RobotModel) -> tuple[Body, ...]:
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
    return Task("payload", (body,), truth, robot.tree.lumped(known), _terms_without(robot, ()))


def _link(robot: RobotModel) -> Task:
    """The composite of the link that carries the tool: with all that is welded to it."""
    link = int(robot.tree.carrier[robot.tool_body])
    if link < 0:
        raise UnsupportedError(f"The tool {robot.body_names[robot.tool_body]!r} does not move.")
    body = robot.bodies[robot.tree.links[link].body]
    lumped = robot.tree.lumped(robot.phi)
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
    asked = tuple(c for c in robot.term_columns(terms) if robot.term_place(c)[1] in dofs)
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
            drivers = robot.coupling.drivers(joint.vadr)
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
        term, dof, other = robot.term_place(name)
        if other is None:
            known[term][dof] = 0.0
    return known


def _coupling_without(
    robot: RobotModel, identified: tuple[str, ...], unknown: tuple[str, ...]
) -> Array:
    """The viscous coupling (nv, nv) that methods are given."""
    known = robot.joint_terms.viscous_coupling.copy()
    for name in set(identified).intersection(unknown):
        _, dof, other = robot.term_place(name)
        if other is not None:
            known[dof, other] = 0.0
    return known
