"""Model file identified from recordings: written with whole bodies, read again and judged."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.commands.write_model import KEYS, write_text, write_values
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
from sysid_bench.models.manifest import JointTerms, Manifest, find_manifest
from sysid_bench.models.robot import TERM_OF, RobotModel
from sysid_bench.models.writing.manifest_writer import manifest_text
from sysid_bench.types import Array, Estimate, Prior, Problem

PASSIVE: Final = ("viscous", "coulomb", "armature")
"""Joint terms that must not be negative."""

IN_MJCF: Final = ("viscous", "coulomb", "armature", "spring")
"""Joint terms that an MJCF holds; the manifest holds all of them."""

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
class _WrittenModel:
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
    posed: ExperimentData[RecordedSource], estimate: Estimate, target: Path, distance: str | None
) -> _WrittenModel:
    """Write the model file `target` and the manifest beside it; read both again and judge them.

    Joint terms of recorded joints that were not identified are zero in both files, as they were in
    the fit. Raises EstimationError without whole bodies, ModelError where the files cannot be
    written or differ from what was written.
    """
    chosen = _whole(posed, estimate, distance)
    assert chosen.estimate.theta is not None
    assert estimate.beta is not None
    robot = posed.source.training[0].robot
    theta = dict(zip(posed.problem.parameters, chosen.estimate.theta.tolist(), strict=True))
    bodies = {
        body.name: np.array([theta.pop(column) for column in body.columns])
        for body in posed.problem.bodies
    }
    terms, left_out = _terms_by_joint(robot, posed.problem.rows, theta)
    write_values(robot, bodies, _in_file(robot, terms), {}, target)
    manifest = replace(_original(robot), joints={**robot.manifest.joints, **terms})
    file = target.with_suffix(".toml")
    write_text(file, manifest_text(manifest, target.name))
    return _judged(posed, estimate.beta, file, chosen, left_out)


@dataclass(frozen=True, eq=False)
class _Whole:
    """Whole, feasible bodies of a written model: see WrittenModel."""

    estimate: Estimate
    completed: str | None = None
    refitted: bool = False
    weights: str = RESIDUALS


def _whole(
    posed: ExperimentData[RecordedSource], estimate: Estimate, distance: str | None
) -> _Whole:
    """The estimate with whole, feasible bodies, or a feasible fit that had to take its place."""
    problem, prior = posed.problem, posed.source.prior
    if distance is None and _is_feasible(estimate.theta, problem):
        return _Whole(estimate)
    if prior.prior is None:
        raise EstimationError(
            f"Not written: no prior to complete the bodies, since {prior.reason}. {WAY_ON}"
        )
    return _completed(problem, estimate, prior.prior, distance or ENTROPIC)


def _completed(problem: Problem, estimate: Estimate, prior: Prior, distance: str) -> _Whole:
    """The estimate with the bodies nearest the prior, or a feasible fit."""
    feasible = feasible_set_of(problem)
    assert estimate.beta is not None
    try:
        theta = completed_parameters(feasible, problem.base, estimate.beta, prior, distance)
    except EstimationError:
        # Noise has carried beta out of the feasible set: fit again within it.
        return _feasible_fit(problem, estimate.beta, distance)
    return _Whole(replace(estimate, theta=theta), distance)


def _feasible_fit(problem: Problem, beta: Array, distance: str) -> _Whole:
    """The feasible fit with bodies near to the prior; that with rows weighted by the RMS torque of
    their joint where the weights of the noise cost more than LARGEST_COST of the error of beta."""
    first = _entropic_fit(problem, RESIDUALS)
    error = _error(problem, first)
    own = RowErrors([problem], beta).torque_error
    if own is None or error <= LARGEST_COST * own:
        return _Whole(first, distance, True)
    second = _entropic_fit(problem, RMS_TORQUE)
    if _error(problem, second) < error:
        return _Whole(second, distance, True, RMS_TORQUE)
    return _Whole(first, distance, True)


def _error(problem: Problem, estimate: Estimate) -> float:
    """Torque error of whole bodies; infinite where no joint has a torque."""
    assert estimate.theta is not None
    found = RowErrors([problem], problem.base.K @ estimate.theta).torque_error
    return np.inf if found is None else found


def _entropic_fit(problem: Problem, weights: str) -> Estimate:
    """Bodies near to the prior; those of `lmi` where the method does not converge."""
    try:
        return Entropic(weights=weights).solve(problem)
    except EstimationError:
        return LMI().solve(problem)


def _is_feasible(theta: Array | None, problem: Problem) -> bool:
    """True for whole bodies that can exist, with joint terms that are not negative."""
    if theta is None or not feasible_figures(theta, problem).get("feasible", True):
        return False
    return bool((theta[feasible_set_of(problem).nonnegative] >= 0).all())


def _terms_by_joint(
    robot: RobotModel, rows: Sequence[str], theta: Mapping[str, float]
) -> tuple[dict[str, JointTerms], list[str]]:
    """Joint terms of the recorded joints, zero where not identified, and the parameters that are
    terms of none."""
    found, left_out = _values_by_joint(rows, theta)
    _refuse_negative(found)
    terms = {joint: JointTerms(**values) for joint, values in found.items()}
    return {joint: _with_reference(robot, joint, terms[joint]) for joint in terms}, left_out


def _values_by_joint(
    rows: Sequence[str], theta: Mapping[str, float]
) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Values of the terms of each joint in the words of a manifest, and the other parameters."""
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
    return found, left_out


def _refuse_negative(found: Mapping[str, Mapping[str, float]]) -> None:
    """Raise ModelError, with their names, for terms that would supply energy."""
    wrong = [
        f"{joint}.{term} ({values[term]:.3g})"
        for joint, values in found.items()
        for term in PASSIVE
        if values[term] < 0
    ]
    if wrong:
        raise ModelError(
            f"Not written: {first_names(wrong)} must not be negative; let the fit constrain joint "
            "terms as well (--feasible terms)."
        )


def _with_reference(robot: RobotModel, joint: str, terms: JointTerms) -> JointTerms:
    """The terms with the rest position of the spring, which is known."""
    reference = float(robot.joint_terms.spring_reference[robot.rows.index(joint)])
    return terms.model_copy(update={"spring_reference": reference}) if terms.spring else terms


def _in_file(robot: RobotModel, terms: Mapping[str, JointTerms]) -> dict[str, dict[str, float]]:
    """Terms in the words of the model file, those that its format has a place for."""
    if robot.format == "urdf":
        return {joint: _words(values, ("viscous", "coulomb")) for joint, values in terms.items()}
    # The rest position of a spring (rad, m) in MuJoCo's word.
    return {
        joint: _words(values, IN_MJCF)
        | ({} if values.spring_reference is None else {"springref": values.spring_reference})
        for joint, values in terms.items()
    }


def _words(values: JointTerms, held: Sequence[str]) -> dict[str, float]:
    # A negative stiffness, as of a counterbalance, stands in the manifest alone.
    return {KEYS.get(term, term): max(float(getattr(values, term)), 0.0) for term in held}


def _original(robot: RobotModel) -> Manifest:
    """The manifest as written, without the joints that a log has locked."""
    manifest = robot.manifest
    source = manifest.source or str(manifest.manifest_file or manifest.path)
    return manifest if manifest.text is not None else find_manifest(source)


def _judged(
    posed: ExperimentData[RecordedSource],
    estimated: Array,
    file: Path,
    chosen: _Whole,
    left_out: list[str],
) -> _WrittenModel:
    """Read the files again: parameters, cross-check, and errors on the recordings."""
    written = find_manifest(str(file))
    locked = posed.source.training[0].robot.manifest.locked
    robot = load_robot(replace(written, locked=locked))
    check = crosscheck(load_robot(written))
    if not check.ok():
        raise ModelError(f"{file}, the written model: {check.reason_text()}")
    # Parameters (p,) of a problem as a model has them; zero for those that no file holds.
    values = dict(zip(robot.inertial_columns, robot.phi.ravel(), strict=True))
    terms = tuple(x for x in posed.problem.parameters if x not in values and _is_term(robot, x))
    values |= dict(zip(terms, robot.term_values(terms), strict=True))
    beta = posed.problem.base.K @ np.array(
        [values.get(name, 0.0) for name in posed.problem.parameters]
    )
    tests = list(posed.held_out.values())
    return _WrittenModel(
        file=str(written.path),
        manifest=str(file),
        completed=chosen.completed,
        refitted=chosen.refitted,
        weights=chosen.weights,
        ratio=_ratio(tests or [posed.problem], beta, estimated),
        masses=_masses(robot, posed.problem),
        left_out=left_out,
        gap=check.gap,
        closure=check.closure,
        torque_error=RowErrors(tests, beta).torque_error if tests else None,
        tests={label: _relative(test, beta) for label, test in posed.held_out.items()},
        training=_relative(posed.problem, beta),
    )


def _ratio(problems: list[Problem], beta: Array, estimated: Array) -> float | None:
    """Error of the written model (r,) over that of the estimate (r,); None without any error."""
    written, own = (RowErrors(problems, x).torque_error for x in (beta, estimated))
    return written / own if written is not None and own else None


def _is_term(robot: RobotModel, name: str) -> bool:
    joint, _, suffix = name.partition(".")
    return joint in robot.rows and suffix.partition(".")[0] in TERM_OF


def _relative(problem: Problem, beta: Array) -> dict[str, float | None]:
    """Relative error of each joint."""
    return {name: error["relative"] for name, error in joint_errors(problem, beta).items()}


def _masses(robot: RobotModel, problem: Problem) -> dict[str, float]:
    """Masses (kg) of the written bodies."""
    names = [body.name for body in problem.bodies]
    return {name: float(robot.phi[robot.body_names.index(name), 0]) for name in names}
