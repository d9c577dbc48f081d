"""Plant model of an identification method: the robot's kinematics with estimated parameters."""

import itertools
from dataclasses import dataclass, replace

import numpy as np

from sysid_bench.models.robot import SUFFIX, JointTerms, RobotModel
from sysid_bench.simulation.plant import Plant, coupling_law
from sysid_bench.types import Array, Body


@dataclass(frozen=True, eq=False)
class KnownModel:
    """Model knowledge of an identification method: the kinematics `robot`, the names `parameters`
    (p,) of the unknowns, and what the task takes as known.

    `known_links` (n_links, 10) are inertial parameters, `known_terms` (nv,) joint terms by name,
    and `known_coupling` (nv, nv) viscous friction between joints. The true values of the unknowns
    cannot be reached from here.
    """

    robot: RobotModel
    parameters: tuple[str, ...]
    bodies: tuple[Body, ...]
    known_links: Array
    known_terms: dict[str, Array]
    known_coupling: Array


def plant_of_model(model: KnownModel, theta: Array) -> Plant:
    """Return the plant with the values theta (p,) of the unknowns and the known parameters."""
    robot = model.robot
    index = {name: i for i, name in enumerate(model.parameters)}
    phi = np.zeros_like(robot.phi)
    for link, known in zip(robot.tree.links, model.known_links, strict=True):
        phi[link.body] += known
    for body in model.bodies:
        b = robot.body_names.index(body.name)
        phi[b] += theta[[index[column] for column in body.columns]]
    terms = _terms(model, theta, index)
    return Plant(robot, terms, coupling_law(terms), phi)


def _terms(model: KnownModel, theta: Array, index: dict[str, int]) -> JointTerms:
    robot, values = model.robot, {}
    for term, suffix in SUFFIX.items():
        known = model.known_terms.get(term)
        value = np.zeros(robot.nv) if known is None else known.copy()
        for dof in robot.scalar_dofs:
            i = index.get(f"{robot.rows[dof]}.{suffix}")
            if i is not None:
                value[dof] = theta[i]
        values[term] = value
    coupling = model.known_coupling.copy()
    # Friction of one joint by the speed of another: both directions are parameters of their own.
    for dof, other in itertools.permutations(robot.scalar_dofs, 2):
        i = index.get(f"{robot.rows[dof]}.fv.{robot.rows[other]}")
        if i is not None:
            coupling[dof, other] = theta[i]
    values["viscous_coupling"] = coupling
    return replace(robot.joint_terms, **values)
