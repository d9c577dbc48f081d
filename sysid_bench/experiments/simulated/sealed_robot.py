"""Robot of a sealed plant: bodies, rotors and friction that nobody can look up.

The model file is what everybody knows: it is the prior of the methods, and the truth is drawn
around it by the secret seed, with the deviations that the suite states for its prior.
"""

from collections.abc import Collection
from dataclasses import fields, replace

import numpy as np

from sysid_bench.experiments.spec import SEALED, ExperimentSpec, plant_seed
from sysid_bench.experiments.tasks.prior import PriorSpread, drawn_body, drawn_terms, prior_std
from sysid_bench.experiments.tasks.prior import std_with_floor as with_floor
from sysid_bench.experiments.tasks.task import Task
from sysid_bench.models.robot import SUFFIX, JointTerms, RobotModel
from sysid_bench.types import Prior


def robot_of_plant(
    spec: ExperimentSpec, robot: RobotModel, parameters: Collection[str]
) -> RobotModel:
    """Return the robot whose parameters are the truth: of a sealed plant one whose unknown
    `parameters` are drawn, the same for all payloads, and the others, which a task takes as known,
    those of the file; else the robot itself."""
    if not spec.plant.get(SEALED):
        return robot
    spread = stated_spread(spec)

    def rng(*channel: str) -> np.random.Generator:
        return np.random.default_rng(plant_seed(spec, "robot", *channel))

    unknown, phi = set(parameters), robot.phi.copy()
    for b, body in enumerate(robot.bodies):
        if unknown.issuperset(body.columns):
            phi[b] = drawn_body(phi[b], spread, rng("body", body.name))
    terms = {field.name: getattr(robot.joint_terms, field.name) for field in fields(JointTerms)}
    for term, suffix in SUFFIX.items():
        dofs = robot.scalar_dofs
        drawn = terms[term].copy()
        drawn[dofs] = drawn_terms(drawn[dofs], suffix, spread, rng("terms", term))[0]
        own = [f"{row}.{suffix}" in unknown for row in robot.rows]
        terms[term] = np.where(own, drawn, terms[term])
    return replace(robot, phi=phi, joint_terms=JointTerms(**terms))


def stated_spread(spec: ExperimentSpec) -> PriorSpread:
    """Return the deviations of the prior that a specification states; the usual ones where it
    states none."""
    written = {} if isinstance(spec.prior, str) else dict(spec.prior)
    known = {field.name for field in fields(PriorSpread)}
    return PriorSpread(**{key: value for key, value in written.items() if key in known})


def file_prior(task: Task, spread: PriorSpread) -> Prior:
    """Return the parameters of the model file, whose truth `task` states, as a prior with the
    deviations of the draw."""
    theta, std = task.truth.theta, np.zeros_like(task.truth.theta)
    index = {name: i for i, name in enumerate(task.truth.parameters)}
    inertial = np.zeros(len(theta), dtype=bool)
    for body in task.bodies:
        columns = [index[column] for column in body.columns]
        inertial[columns] = True
        std[columns] = prior_std(theta[columns], spread)
    std[~inertial] = spread.terms * np.abs(theta[~inertial])
    return Prior(theta, spread.declared * with_floor(std, task.truth.parameters))
