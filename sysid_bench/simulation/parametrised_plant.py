"""The model that a method simulates: the robot's kinematics with the method's own parameters."""

import itertools
from dataclasses import dataclass, replace

import numpy as np

from sysid_bench.models.robot import SUFFIX, JointTerms, RobotModel
from sysid_bench.simulation.plant import Plant, coupling_laws
from sysid_bench.types import Array, Body


@dataclass(frozen=True, eq=False)
class KnownModel:
    """What a method is told of a robot: a bare `robot`, the names of its unknowns and the parts
    that the task takes as known. Nothing of the unknowns' values can be reached from here."""

    robot: RobotModel
    parameters: tuple[str, ...]
    bodies: tuple[Body, ...]
    known_links: Array  # (n_links, 10)
    known_terms: dict[str, Array]  # by term, (nv,)
    known_coupling: Array  # (nv, nv), viscous


def parametrised_plant(told: KnownModel, theta: Array) -> Plant:
    """A plant with the unknowns at theta (p,) and the rest as it is declared known."""
    robot = told.robot
    places = {name: i for i, name in enumerate(told.parameters)}
    phi = np.zeros_like(robot.phi)
    for link, known in zip(robot.tree.links, told.known_links, strict=True):
        phi[link.body] += known
    for body in told.bodies:
        at = robot.body_names.index(body.name)
        phi[at] += theta[[places[column] for column in body.columns]]
    terms = _terms(told, theta, places)
    return Plant(robot, terms, coupling_laws(terms), phi)


def _terms(told: KnownModel, theta: Array, places: dict[str, int]) -> JointTerms:
    robot, values = told.robot, {}
    for term, suffix in SUFFIX.items():
        known = told.known_terms.get(term)
        value = np.zeros(robot.nv) if known is None else known.copy()
        for dof in robot.scalar_dofs:
            at = places.get(f"{robot.rows[dof]}.{suffix}")
            if at is not None:
                value[dof] = theta[at]
        values[term] = value
    coupling = told.known_coupling.copy()
    for dof, other in itertools.permutations(robot.scalar_dofs, 2):
        at = places.get(f"{robot.rows[dof]}.fv.{robot.rows[other]}")
        if at is not None:
            coupling[dof, other] = theta[at]
    values["viscous_coupling"] = coupling
    return replace(robot.joint_terms, **values)
