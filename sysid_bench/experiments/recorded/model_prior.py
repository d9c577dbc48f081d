"""Prior of recorded experiments: the inertial parameters of the model file, where they may be true.

A simulated experiment draws its prior around the truth (tasks/prior.py). A real robot has no known
truth: its model file is all prior knowledge that there is.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from sysid_bench.errors import unknown_name
from sysid_bench.experiments.recorded.process_log import ProcessedLog
from sysid_bench.experiments.recorded.unknowns import Unknowns
from sysid_bench.experiments.spec import normal_prior
from sysid_bench.experiments.tasks.prior import PriorSpread, prior_std, std_with_floor
from sysid_bench.models.model_checks import placeholder_reason
from sysid_bench.spatial import gyration, phi_of
from sysid_bench.types import Array, Prior, Problem

MODEL, NONE = "model", "none"
"""Priors by name: the model file's parameters, where they are plausible, and none at all."""

GYRATION_SHARE: Final = 0.15
"""Standard deviation of a centre of mass over the body's radius of gyration, where none is stated:
15 mm for the links of an arm of 1 m reach, the spread of simulated priors."""

PAYLOAD_SHARE, PAYLOAD_RADIUS = 0.05, 0.1
"""Prior of an unknown payload: a solid sphere of this share of the robot's mass and this radius (m)
at its frame, known to its own size only. What the log states of it is not used."""


@dataclass(frozen=True, eq=False)
class ModelPrior:
    """The prior of a recorded experiment, or the reason why there is none; `spread` (com None:
    GYRATION_SHARE) in words of a suite."""

    prior: Prior | None = None
    reason: str = ""
    text: str = NONE

    def apply(self, problem: Problem) -> Problem:
        """Return the problem with this prior, in its single motions as well."""
        motions = tuple(replace(motion, prior=self.prior) for motion in problem.motions)
        return replace(problem, prior=self.prior, motions=motions)


def model_prior(
    choice: str | Mapping[str, Any],
    unknowns: Unknowns,
    problem: Problem,
    training: Sequence[ProcessedLog],
) -> ModelPrior:
    """Return the prior that `choice` names: "model", "none", or the spreads of the model's values
    ({mass, com, inertia, terms} as in a suite), which are believed as they stand.

    Joint terms that the file does not have, and all of them with "model", are weakly known: about
    as large as would explain the whole torque of their joint.
    """
    keys = ("mass", "com", "inertia", "terms")
    if isinstance(choice, str) and choice not in (MODEL, NONE):
        raise unknown_name("prior of a recording", choice, (MODEL, NONE))
    for key in () if isinstance(choice, str) else choice:
        if key not in keys:
            raise unknown_name("key of a prior", str(key), keys)
    if choice == NONE:
        return ModelPrior(reason="none was asked for")
    normal = normal_prior(choice)
    stated: Mapping[str, float] = {} if isinstance(normal, str) else normal
    # Stated spreads are believed; the file's own values only where they are plausible.
    reason = placeholder_reason(unknowns.robot) if isinstance(choice, str) else ""
    if reason:
        return ModelPrior(reason=f"the inertias of the model file are placeholders: {reason}")
    theta, std = np.add(
        _links(unknowns, problem, stated),
        _joint_terms(unknowns, problem, training, stated.get("terms")),
    )
    prior = Prior(theta, std_with_floor(std, problem.parameters))
    shares = {"mass": PriorSpread.mass, "inertia": PriorSpread.inertia, **stated}
    text = {key: f"{100 * share:g} %" for key, share in shares.items()}
    com = f"{100 * GYRATION_SHARE:g} % of the radius of gyration"
    if stated.get("com"):
        com = f"{1e3 * stated['com']:g} mm"
    terms = text.get("terms", "as large as their torque allows")
    words = f"mass {text['mass']}, centre of mass {com}, inertia {text['inertia']}, "
    return ModelPrior(prior, text=f"{words}joint terms {terms}")


def file_theta(unknowns: Unknowns, problem: Problem) -> Array:
    """Return the values (p,) of the model file, plausible or not; zero for a load, which it
    lacks."""
    robot = unknowns.robot
    values = dict(zip(robot.inertial_columns, robot.phi.ravel(), strict=True))
    values |= dict(zip(unknowns.terms, unknowns.term_values, strict=True))
    return np.array([values.get(name, 0.0) for name in problem.parameters])


def _links(
    unknowns: Unknowns, problem: Problem, stated: Mapping[str, float]
) -> tuple[Array, Array]:
    """Mean and deviations (p,) of the bodies' parameters, zero for all others."""
    theta, std = np.zeros(len(problem.parameters)), np.zeros(len(problem.parameters))
    index = {name: i for i, name in enumerate(problem.parameters)}
    values = dict(zip(unknowns.robot.body_names, unknowns.robot.phi, strict=True))
    spread = PriorSpread(**{k: x for k, x in stated.items() if k != "com"})
    for body in problem.bodies:
        at = [index[column] for column in body.columns]
        if body.columns[0] not in unknowns.payload_parameters:
            phi = theta[at] = values[body.name]
            com = stated.get("com", GYRATION_SHARE * gyration(phi))
            std[at] = prior_std(phi, replace(spread, com=com))
            continue
        # A solid sphere: I = 2/5 m r^2. Its deviations are of its own order, at twice its radius.
        mass, far = PAYLOAD_SHARE * float(unknowns.robot.phi[:, 0].sum()), 2 * PAYLOAD_RADIUS
        theta[at] = phi_of(mass, np.zeros(3), 0.4 * mass * PAYLOAD_RADIUS**2 * np.eye(3))
        std[at] = 2 * mass * np.array([1.0] + [far] * 3 + [far**2] * 6)
    return theta, std


def _joint_terms(
    unknowns: Unknowns, problem: Problem, training: Sequence[ProcessedLog], share: float | None
) -> tuple[Array, Array]:
    """Mean and deviations (p,) of the joint terms and further columns, zero for the bodies; RMS
    torque of the row over the RMS of the column where no `share` of the mean is stated."""
    theta, std = np.zeros(len(problem.parameters)), np.zeros(len(problem.parameters))
    inertial = {column for body in problem.bodies for column in body.columns}
    # {base parameter: RMS torque over RMS column} of the row in which the column alone is largest;
    # of joint terms and features, which act in a row of their own.
    columns: dict[str, float] = {}
    assert problem.torque is not None
    for row, factor in enumerate(problem.factors):
        norms = np.linalg.norm(factor.R[:, :-1], axis=0) / max(factor.samples, 1) ** 0.5
        for column, norm in zip(factor.columns, norms, strict=True):
            if norm > 0:
                base, size = problem.base.names[column], float(problem.torque[row] / norm)
                columns[base] = min(columns.get(base, np.inf), size)
    in_file = dict(zip(unknowns.terms, unknowns.term_values, strict=True))
    for i, name in enumerate(problem.parameters):
        if name in inertial:
            continue
        theta[i] = in_file.get(name, 0.0)
        weak = columns.get(name) or _term_size(unknowns, problem, training, name)
        std[i] = share * abs(theta[i]) if share is not None and theta[i] else weak
    return theta, std


def _term_size(
    unknowns: Unknowns, problem: Problem, training: Sequence[ProcessedLog], name: str
) -> float:
    """The same for a joint term that is not a base parameter, such as a rotor's inertia."""
    assert problem.torque is not None
    joint, _, suffix = name.partition(".")
    if joint not in unknowns.rows:
        return 1.0
    tau = float(problem.torque[unknowns.rows.index(joint)])
    (at,) = (one for one in unknowns.robot.joints if one.dofs == (joint,))
    column = {"Ia": ("a", at.vadr), "k": ("q", at.qadr), "fv": ("v", at.vadr)}
    if suffix not in column:
        return tau or 1.0
    signal, k = column[suffix]
    values = np.concatenate([getattr(log.recording.motion, signal)[:, k] for log in training])
    rms = float(np.sqrt(np.mean(values**2)))
    return tau / rms if tau and rms else 1.0
