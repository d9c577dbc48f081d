"""What is unknown: the parameters of a task, their true values, and what methods take as known."""

from collections.abc import Sequence
from dataclasses import dataclass
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
    `known_terms` (by term, (nv,)) are the parts of the plant that methods are given."""

    name: str
    bodies: tuple[Body, ...]
    truth: Truth
    known_links: Array
    known_terms: dict[str, Array]
    rows: tuple[str, ...] | None = None
    """Names of the degrees of freedom whose torque is measured; None: all."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the unknowns (p,)."""
        return self.truth.parameters

    @property
    def knows_something(self) -> bool:
        """Whether a known torque has to be taken from the measured one."""
        return bool(self.known_links.any() or any(v.any() for v in self.known_terms.values()))


def task_of(robot: RobotModel, name: str, terms: tuple[str, ...]) -> Task:
    """The task `robot` (links and `terms`), `payload` or `link` (ten numbers, the rest known), or
    `terminal` (the last joint's torque alone: ten numbers of its link, and its `terms`).

    Joint terms that are not identified are known. Raises UnsupportedError where the robot or the
    payload has no such unknowns.
    """
    for term in terms:
        if term not in SUFFIX:
            raise unknown_name("joint term", term, SUFFIX)
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
    own = [i for i in range(len(phi)) if i != robot.payload_body]
    bodies = tuple(robot.bodies[i] for i in own)
    columns = tuple(column for body in bodies for column in body.columns) + robot.term_columns(
        terms
    )
    theta = np.concatenate([phi[own].ravel(), robot.term_values(terms)])
    nothing = np.zeros((len(robot.tree.links), 10))
    return Task("robot", bodies, Truth(columns, theta), nothing, _terms_without(robot, terms))


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
    asked = [(term, dof) for term in terms for dof in dofs if dof in robot.scalar_dofs]
    values = [float(getattr(robot.joint_terms, term)[dof]) for term, dof in asked]
    known = _terms_without(robot, ())
    for term, dof in asked:
        known[term] = known[term].copy()
        known[term][dof] = 0.0
    truth = Truth(
        link.parameters + tuple(f"{robot.rows[dof]}.{SUFFIX[term]}" for term, dof in asked),
        np.concatenate([link.truth.theta, values]),
    )
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
    """The terms (nv,) that methods are given; identified ones are unknown on hinges and slides."""
    known = {term: getattr(robot.joint_terms, term).copy() for term in SUFFIX}
    for term in identified:
        known[term][robot.scalar_dofs] = 0.0
    return known
