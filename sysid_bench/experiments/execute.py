"""Executes one experiment with all its estimators: a row each, always."""

import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from sysid_bench.canonical_json import plain
from sysid_bench.errors import SysidBenchError, UnsupportedError, reason_of
from sysid_bench.evaluation.covariance import StandardError, standard_errors
from sysid_bench.evaluation.score import score
from sysid_bench.experiments.recorded.prepared_logs import PreparedLogs
from sysid_bench.experiments.recorded.rows import (
    log_fields,
    parameter_table,
    prepare_recorded,
    recorded_score,
    stated_mass,
)
from sysid_bench.experiments.robot_cache import LoadedRobot, cached_robot
from sysid_bench.experiments.simulated.ft_evaluation import (
    ContactTest,
    contact_test,
    sensor_excitation,
)
from sysid_bench.experiments.simulated.ft_evaluation import sensor_scores as sub_tree_figures
from sysid_bench.experiments.simulated.prepare import Prepared, prepare
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.identifiability.subspaces import Excitation
from sysid_bench.identifiability.verdicts import verdicts
from sysid_bench.identification.identify import identify
from sysid_bench.naming import build
from sysid_bench.types import Estimate, Row
from sysid_bench.versions import versions

Emit = Callable[[Row], None]


def execute(argument: Mapping[str, Any], emit: Emit) -> None:
    """Runs the experiment of `argument` (see harness/run.py) and emits a row per estimator."""
    try:
        spec = ExperimentSpec.from_json(argument["experiment"])
        places = argument["robots_dir"], argument["folder"]
        robot = cached_robot(spec.robot, spec.payload, *places, spec.free_base)
        verdict = _verdict(robot, argument["crosscheck"])
    except SysidBenchError as error:
        _emit_all(argument, emit, {"status": "failed", "reason": str(error)})
        return
    if verdict["crosscheck"] == "failed" and argument["crosscheck"]["on_fail"] == "skip-robot":
        reason = f"cross-check failed: {robot.check.reason(argument['crosscheck']['tolerance'])}"
        _emit_all(argument, emit, verdict | {"status": "skipped", "reason": reason})
        return
    start = time.perf_counter()
    try:
        ready = prepare(spec, robot) if spec.log is None else prepare_recorded(spec, *places)
    except SysidBenchError as error:
        status = "unsupported" if isinstance(error, UnsupportedError) else "failed"
        _emit_all(argument, emit, verdict | {"status": status, "reason": str(error)})
        return
    if isinstance(ready, PreparedLogs):
        verdict["seconds_experiment"] = time.perf_counter() - start
        for estimator in argument["estimators"]:
            answer = _answer_of_logs(estimator, ready, stated_mass(spec))
            emit(_header(argument, estimator) | verdict | answer)
        return
    sensed = _Sensed.of(spec, ready) if ready.task.definition.identifies_sub_tree else None
    verdict["seconds_experiment"] = time.perf_counter() - start
    for estimator in argument["estimators"]:
        emit(_header(argument, estimator) | verdict | _answer(estimator, ready, sensed))


@dataclass(frozen=True, eq=False)
class _Sensed:
    """What estimators behind a sensor are judged by beside their scores."""

    excitation: Excitation
    trial: ContactTest | None

    @classmethod
    def of(cls, spec: ExperimentSpec, ready: Prepared) -> "_Sensed":
        return cls(sensor_excitation(ready), contact_test(spec, ready))

    def judged(self, estimate: Estimate, ready: Prepared) -> Row:
        """The part of a row that is about the sub-tree."""
        errors = None if self.trial is None else self.trial.errors(ready, estimate)
        return sub_tree_figures(self.excitation, errors)


def _verdict(robot: LoadedRobot, rule: Mapping[str, Any]) -> Row:
    """What is known of the robot before anything is identified."""
    check = robot.check
    figures: Row = {
        "gap": check.gap,
        "closure": check.closure,
        "native_gap": check.native_gap,
        "native_reason": check.native_reason,
        "crosscheck": "ok" if check.ok(rule["tolerance"]) else "failed",
        "repairs": "; ".join(robot.robot.repairs),
        "nv": robot.robot.nv,
        "free_base": robot.robot.floating,
    }
    return dict(plain(figures))


def _emit_all(argument: Mapping[str, Any], emit: Emit, outcome: Row) -> None:
    for estimator in argument["estimators"]:
        emit(_header(argument, estimator) | outcome)


def _header(argument: Mapping[str, Any], estimator: Mapping[str, Any]) -> Row:
    cell = estimator["cell"]
    print_of = argument.get("fingerprints", {}).get(cell)
    own = {"id": cell, "estimator": estimator["label"], "fingerprint": print_of}
    return {**argument["labels"], **own, "versions": versions()}


def _answer(spec: Mapping[str, Any], ready: Prepared, sensed: _Sensed | None) -> Row:
    """Status, scores and parameters of one estimator; a stranger's exception is a failed row."""
    settings = _settings(spec)
    try:
        estimate = identify(build("estimator", settings), ready.problem, ready.experiment)
        return _with_sub_tree(_judged(estimate, ready), estimate, ready, sensed)
    except (Exception, SystemExit) as error:
        row = dict(plain({**_failure(error), **ready.figures}))
    return _with_sub_tree(row, Estimate(status="failed"), ready, sensed)


def _answer_of_logs(spec: Mapping[str, Any], posed: PreparedLogs, mass: float | None) -> Row:
    """The same for what was recorded."""
    try:
        method = build("estimator", _settings(spec))
        estimate = identify(method, posed.problem, posed.experiment)
        score = recorded_score(method, estimate, posed, mass)
    except (Exception, SystemExit) as error:
        return dict(plain(_failure(error)))
    stats = dict(estimate.stats)
    outcome: Row = {
        "status": estimate.status,
        "reason": estimate.reason,
        "seconds": stats.pop("seconds"),
    }
    outcome |= vars(score) | log_fields(posed)
    outcome["stats"] = stats
    outcome["parameters_table"] = parameter_table(estimate, posed.problem)
    return dict(plain(outcome))


def _settings(spec: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in spec.items() if key not in ("cell", "label")}


def _failure(error: BaseException) -> Row:
    """Our own errors speak for themselves; a stranger's show where they come from."""
    told: Row = {"status": "failed", "reason": reason_of(error)}
    if not isinstance(error, SysidBenchError):
        told["traceback"] = "".join(traceback.format_exception(error))
    return told


def _with_sub_tree(row: Row, estimate: Estimate, ready: Prepared, sensed: _Sensed | None) -> Row:
    """The row with what a sensor's data tell of its sub-tree; a failure names what they miss."""
    if sensed is None:
        return row
    missing = "" if row["status"] == "ok" else sensed.excitation.warning
    told = {"reason": f"{row['reason']} {missing}".strip(), **sensed.judged(estimate, ready)}
    return row | dict(plain(told))


def _judged(estimate: Estimate, ready: Prepared) -> Row:
    stats = dict(estimate.stats)
    outcome: Row = {
        "status": estimate.status,
        "reason": estimate.reason,
        "seconds": stats.pop("seconds"),
    }
    problem, truth, sure = ready.problem, ready.truth, standard_errors(ready.problem, estimate)
    told = sure if ready.noisy else None
    outcome |= vars(
        score(estimate, problem, ready.held_out, truth, ready.extents, ready.figures, told)
    )
    outcome["stats"] = stats
    outcome["parameters_table"] = list(_parameters(estimate, ready, sure))
    return dict(plain(outcome))


def _parameters(
    estimate: Estimate, ready: Prepared, sure: Mapping[str, StandardError]
) -> Iterator[Row]:
    """True and estimated base parameters, named by their pivots; all parameters where the method
    claims all of them, with the verdict on each, so that no claim passes for knowledge.

    `std` is the first of the deviations that there are, and `std_from` says which. Where a
    parameter is the pivot of a base parameter, `base_error` is what the estimate of that one is off
    by, and `bound` its deviation by Cramer and Rao."""
    if estimate.status != "ok" or estimate.beta is None:
        return
    problem, truth = ready.problem, ready.truth
    base, told = problem.base, verdicts(problem.base)
    place = {int(j): i for i, j in enumerate(base.pivots)}
    kind = next(iter(sure), None)
    deviations = {f"std_{name}": spread.std for name, spread in sure.items()}
    if kind is not None:
        deviations["std"] = sure[kind].std
    of_base = {"base_error": estimate.beta - base.K @ truth.theta}
    if ready.bound is not None:
        of_base["bound"] = ready.bound
    whole = estimate.theta is not None
    true = truth.theta if whole else base.embed(base.K @ truth.theta)
    found = base.embed(estimate.beta) if estimate.theta is None else estimate.theta
    for j in range(len(told)) if whole else base.pivots.tolist():
        body, _, parameter = problem.parameters[j].rpartition(".")
        single = not whole or told[j] == "identifiable"
        numbers = of_base if j in place else {}
        numbers = numbers | (deviations if single else {})
        yield {
            "body": body,
            "name": parameter,
            "true": float(true[j]),
            "estimate": float(found[j]),
            "std": None,
            "std_from": kind if single else None,
            "identifiable": told[j],
            **{name: float(values[place[j]]) for name, values in numbers.items()},
        }
