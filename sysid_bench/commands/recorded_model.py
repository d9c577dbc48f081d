"""Model file identified from recordings: written with whole bodies, read again and judged."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.commands.write_model import KEYS, PASSIVE, format_of, write_text, write_values
from sysid_bench.errors import EstimationError, ModelError, first_names
from sysid_bench.evaluation.crosscheck import crosscheck
from sysid_bench.evaluation.score import feasible_figures, joint_errors
from sysid_bench.evaluation.torque_errors import RowErrors
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.recorded.source import RecordedSource
from sysid_bench.identification.estimators.feasible import LMI, Entropic
from sysid_bench.identification.feasibility.completion import completed_parameters
from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.identification.linear.least_squares import RESIDUALS, RMS_TORQUE
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import JointTerms, find_manifest
from sysid_bench.models.robot import TERM_OF, RobotModel
from sysid_bench.models.writing.manifest_writer import manifest_text
from sysid_bench.types import Array, Estimate, Problem

ENTROPIC: Final = "entropic"
"""Distance in which bodies are completed where none is asked for."""

LARGEST_COST: Final = 1.1
"""Training error of a feasible fit over that of the estimate above which the rows are weighted by
the RMS torque of their joint: weights of the noise believe the joints that the model explains, and
a constraint may then cost a small joint half of what it had explained."""

WAY_ON: Final = (
    "Write the file with bodies of your own choice: --estimator lmi needs no prior, and "
    '--prior \'{ mass = "20 %", inertia = "30 %" }\' believes the file\'s inertias as they stand.'
)


@dataclass(frozen=True)
class WrittenModel:
    """A written model and its errors when it is read again; `manifest` holds the joint terms that
    the format of `file` has no place for. `completed`: distance to the prior in which whole bodies
    were chosen (None: the estimator's own), `refitted`: no feasible bodies have exactly the
    identified base parameters, so that a feasible fit took their place, its rows weighted by
    `weights`; `ratio`: its error over that of the estimate, on the tests, else in training.
    `left_out`: parameters that neither file holds. `gap`, `closure`: of the cross-check of
    both engines."""

    file: str
    manifest: str
    completed: str | None
    refitted: bool
    weights: str
    ratio: float | None
    masses: dict[str, float]
    left_out: list[str]
    gap: float
    closure: float
    torque_error: float | None
    tests: dict[str, dict[str, float | None]]
    training: dict[str, float | None]


def write_recorded_model(
    prepared: ExperimentData[RecordedSource], estimate: Estimate, target: Path, distance: str | None
) -> WrittenModel:
    """Write the model file `target` and the manifest beside it; read both again and judge them.

    Joint terms of recorded joints that were not identified are zero in both files, as they were in
    the fit. Raises EstimationError without whole bodies, ModelError where the files cannot be
    written or differ from what was written.
    """
    chosen = _whole(prepared, estimate, distance)
    assert chosen.estimate.theta is not None
    assert estimate.beta is not None
    robot, problem = prepared.source.training[0].robot, prepared.problem
    theta = dict(zip(problem.parameters, chosen.estimate.theta.tolist(), strict=True))
    bodies = {
        body.name: np.array([theta.pop(column) for column in body.columns])
        for body in problem.bodies
    }
    terms, left_out = _terms_by_joint(robot, problem.rows, theta)
    # The manifest as written, without the joints that a log has locked.
    original = robot.manifest
    if original.text is None:
        original = find_manifest(original.source or str(original.manifest_file or original.path))
    joints = {**robot.manifest.joints, **terms}
    # Of a name of its own: suites know an installed robot by the other one.
    manifest = replace(original, name=target.stem, joints=joints)
    form = format_of(target)
    in_file = _in_file(robot, terms, form)
    manifest = write_values(robot, bodies, in_file, {}, target, manifest) or manifest
    file = target.with_suffix(".toml")
    write_text(file, manifest_text(manifest, target.name))
    return _judged(prepared, estimate.beta, file, chosen, left_out)


# --- Whole bodies -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Whole:
    """Whole, feasible bodies of a written model: see WrittenModel."""

    estimate: Estimate
    completed: str | None = None
    refitted: bool = False
    weights: str = RESIDUALS


def _whole(
    prepared: ExperimentData[RecordedSource], estimate: Estimate, distance: str | None
) -> _Whole:
    """The estimate with whole, feasible bodies: its own, those nearest to the prior, or a feasible
    fit that had to take its place."""
    problem, prior, theta = prepared.problem, prepared.source.prior, estimate.theta
    feasible = feasible_set_of(problem)
    if distance is None and theta is not None:
        exists = feasible_figures(theta, problem).get("feasible", True)
        if exists and (theta[feasible.nonnegative] >= 0).all():  # joint terms as well
            return _Whole(estimate)
    if prior.prior is None:
        raise EstimationError(
            f"Not written: no prior to complete the bodies, since {prior.reason}. {WAY_ON}"
        )
    distance = distance or ENTROPIC
    assert estimate.beta is not None
    try:
        theta = completed_parameters(feasible, problem.base, estimate.beta, prior.prior, distance)
    except EstimationError:
        # Noise has carried beta out of the feasible set: fit again within it.
        return _feasible_fit(problem, estimate.beta, distance)
    return _Whole(replace(estimate, theta=theta), distance)


def _feasible_fit(problem: Problem, beta: Array, distance: str) -> _Whole:
    """The feasible fit with bodies near to the prior; that with rows weighted by the RMS torque of
    their joint where the weights of the noise cost more than LARGEST_COST of the error of beta."""

    def fit(weights: str) -> tuple[Estimate, float]:
        """Bodies near to the prior, those of `lmi` where the method does not converge, and their
        torque error; infinite where no joint has a torque."""
        try:
            found = Entropic(weights=weights).solve(problem)
        except EstimationError:
            found = LMI().solve(problem)
        assert found.theta is not None
        error = RowErrors([problem], problem.base.K @ found.theta).torque_error
        return found, np.inf if error is None else error

    first, error = fit(RESIDUALS)
    own = RowErrors([problem], beta).torque_error
    if own is not None and error > LARGEST_COST * own:
        second, other = fit(RMS_TORQUE)
        if other < error:
            return _Whole(second, distance, True, RMS_TORQUE)
    return _Whole(first, distance, True)


# --- Joint terms --------------------------------------------------------------------------------


def _terms_by_joint(
    robot: RobotModel, rows: Sequence[str], theta: Mapping[str, float]
) -> tuple[dict[str, JointTerms], list[str]]:
    """Joint terms of the recorded joints in the words of a manifest, zero where not identified, and
    the parameters that are terms of none; raise ModelError for terms that would supply energy."""
    found: dict[str, dict[str, Any]] = {row: dict.fromkeys(TERM_OF.values(), 0.0) for row in rows}
    left_out = []
    for name, value in theta.items():
        joint, _, suffix = name.partition(".")
        word, _, other = suffix.partition(".")
        if joint not in found or word not in TERM_OF:
            left_out.append(name)
        elif other:
            found[joint].setdefault("viscous_coupling", {})[other] = value
        else:
            found[joint][TERM_OF[word]] = value
    _check_passive(found)
    for joint, values in found.items():
        if values["spring"]:  # its rest position is known
            place = robot.rows.index(joint)
            values["spring_reference"] = float(robot.joint_terms.spring_reference[place])
    return {joint: JointTerms(**values) for joint, values in found.items()}, left_out


def _check_passive(terms: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise ModelError for terms of joints that would supply energy."""
    wrong = [
        f"{joint}.{term} ({values[term]:.3g})"
        for joint, values in terms.items()
        for term in PASSIVE
        if values[term] < 0
    ]
    if wrong:
        raise ModelError(
            f"Not written: {first_names(wrong)} must not be negative; let the fit constrain joint "
            "terms as well (--feasible terms)."
        )


def _in_file(
    robot: RobotModel, terms: Mapping[str, JointTerms], form: str
) -> dict[str, dict[str, float]]:
    """Terms in the words of the model file, those that its format has a place for."""
    held = PASSIVE[:2] if form == "urdf" else (*PASSIVE, "spring")
    found: dict[str, dict[str, float]] = {}
    for joint, values in terms.items():
        # A negative stiffness, as of a counterbalance, stands in the manifest alone.
        found[joint] = {
            KEYS.get(term, term): max(float(getattr(values, term)), 0.0) for term in held
        }
        if form != "urdf" and values.spring_reference is not None:
            found[joint]["springref"] = values.spring_reference  # rad, m
    return found


# --- The files, read again ----------------------------------------------------------------------


def _judged(
    prepared: ExperimentData[RecordedSource],
    estimated: Array,
    file: Path,
    chosen: _Whole,
    left_out: list[str],
) -> WrittenModel:
    """Read the files again: parameters, cross-check, and errors on the recordings."""
    written, problem = find_manifest(str(file)), prepared.problem
    locked = prepared.source.training[0].robot.manifest.locked
    robot = load_robot(replace(written, locked=locked))
    # Judged as read again: what the file does not hold is missing here, as for its next user.
    check = crosscheck(load_robot(written))
    if not check.ok():
        raise ModelError(f"{file}, the written model: {check.reason_text()}")
    beta = problem.base.K @ _stated_parameters(robot, problem)
    tests, names = list(prepared.held_out.values()), robot.body_names
    error, own = (RowErrors(tests or [problem], x).torque_error for x in (beta, estimated))

    def relative(judged: Problem) -> dict[str, float | None]:
        return {name: error["relative"] for name, error in joint_errors(judged, beta).items()}

    return WrittenModel(
        file=str(written.path),
        manifest=str(file),
        completed=chosen.completed,
        refitted=chosen.refitted,
        weights=chosen.weights,
        ratio=error / own if error is not None and own else None,
        masses={x.name: float(robot.phi[names.index(x.name), 0]) for x in problem.bodies},
        left_out=left_out,
        gap=check.gap,
        closure=check.closure,
        torque_error=error if tests else None,
        tests={label: relative(test) for label, test in prepared.held_out.items()},
        training=relative(problem),
    )


def _stated_parameters(robot: RobotModel, problem: Problem) -> Array:
    """Parameters (p,) of a problem as a model has them; zero for those that no file holds."""
    values = dict(zip(robot.inertial_columns, robot.phi.ravel(), strict=True))
    terms = tuple(x for x in problem.parameters if x not in values and _is_term(robot, x))
    values |= dict(zip(terms, robot.term_values(terms), strict=True))
    return np.array([values.get(name, 0.0) for name in problem.parameters])


def _is_term(robot: RobotModel, name: str) -> bool:
    joint, _, suffix = name.partition(".")
    return joint in robot.rows and suffix.partition(".")[0] in TERM_OF
