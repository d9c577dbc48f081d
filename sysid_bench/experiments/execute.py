"""Execution of one experiment: a row for each of its estimators, whatever happens."""

import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

from sysid_bench.canonical_json import plain
from sysid_bench.errors import SysidBenchError, UnsupportedError, reason_of
from sysid_bench.experiments.loaded_robot import LoadedRobot, loaded_robot
from sysid_bench.experiments.paper_data import store_paper_data
from sysid_bench.experiments.plugin_metrics import plugin_metrics
from sysid_bench.experiments.prepare import prepare
from sysid_bench.experiments.prepared import Prepared
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.identification.identify import identify
from sysid_bench.naming import build
from sysid_bench.types import MetricInput, Row, Score
from sysid_bench.versions import versions

Emit = Callable[[Row], None]


def execute(argument: Mapping[str, Any], emit: Emit) -> None:
    """Run the experiment of `argument` (see harness/job.py) and emit a row for each estimator."""
    try:
        spec, loaded = load_experiment(argument)
        shared = _robot_fields(loaded, argument["crosscheck"])
    except SysidBenchError as error:
        _emit_all(argument, emit, {"status": "failed", "reason": str(error)})
        return
    if shared["crosscheck"] == "failed" and argument["crosscheck"]["on_fail"] == "skip-robot":
        reason = f"cross-check failed: {loaded.check.reason(argument['crosscheck']['tolerance'])}"
        _emit_all(argument, emit, shared | {"status": "skipped", "reason": reason})
        return
    start = time.perf_counter()
    try:
        prepared = prepare(spec, loaded)
    except SysidBenchError as error:
        status = "unsupported" if isinstance(error, UnsupportedError) else "failed"
        _emit_all(argument, emit, shared | {"status": status, "reason": str(error)})
        return
    shared["seconds_experiment"] = time.perf_counter() - start
    for estimator in argument["estimators"]:
        emit(_header(argument, estimator) | shared | _result(argument, estimator, prepared))


def load_experiment(argument: Mapping[str, Any]) -> tuple[ExperimentSpec, LoadedRobot]:
    """The specification of an `argument`, and its robot."""
    spec = ExperimentSpec.from_json(argument["experiment"])
    folders = argument["robots_dir"], argument["folder"]
    return spec, loaded_robot(spec.robot, spec.payload, *folders, spec.free_base)


def _robot_fields(loaded: LoadedRobot, rule: Mapping[str, Any]) -> Row:
    """Fields of a row that depend on the robot alone; `rule`: the tolerance of its cross-check."""
    check = loaded.check
    fields: Row = {
        "gap": check.gap,
        "closure": check.closure,
        "native_gap": check.native_gap,
        "native_reason": check.native_reason,
        "crosscheck": "ok" if check.ok(rule["tolerance"]) else "failed",
        "repairs": "; ".join(loaded.robot.repairs),
        "nv": loaded.robot.nv,
        "free_base": loaded.robot.floating,
    }
    return dict(plain(fields))


def _emit_all(argument: Mapping[str, Any], emit: Emit, fields: Row) -> None:
    for estimator in argument["estimators"]:
        emit(_header(argument, estimator) | fields)


def _header(argument: Mapping[str, Any], estimator: Mapping[str, Any]) -> Row:
    cell = estimator["cell"]
    fingerprint = argument.get("fingerprints", {}).get(cell)
    header = {"id": cell, "estimator": estimator["label"], "fingerprint": fingerprint}
    return {**argument["labels"], **header, "versions": versions()}


def method_of(estimator: Mapping[str, Any]) -> Any:
    """The estimator plug-in of an entry of `argument["estimators"]`."""
    settings = {key: value for key, value in estimator.items() if key not in ("cell", "label")}
    return build("estimator", settings)


def _result(
    argument: Mapping[str, Any], estimator: Mapping[str, Any], prepared: Prepared[Any]
) -> Row:
    """Status, scores and parameters of one estimator; an exception of a plug-in is a failed row."""
    try:
        return _explained(_scored(argument, estimator, prepared), prepared)
    except (Exception, SystemExit) as error:
        return _explained(_failure(error) | prepared.fields, prepared)


def _scored(
    argument: Mapping[str, Any], estimator: Mapping[str, Any], prepared: Prepared[Any]
) -> Row:
    """Fields of a row from the estimate; what `[[paper]]` entries need is stored beside it."""
    method = method_of(estimator)
    estimate = identify(method, prepared.problem, prepared.experiment)
    stats = dict(estimate.stats)
    row: Row = {
        "status": estimate.status,
        "reason": estimate.reason,
        "seconds": stats.pop("seconds"),
    }
    scores = prepared.score(method, estimate)
    score = Score(**{f.name: scores[f.name] for f in fields(Score) if f.name in scores})
    cell = MetricInput(estimate, prepared.problem, prepared.held_out, score)
    store_paper_data(argument, estimator["cell"], estimate, prepared)
    return row | scores | prepared.fields | plugin_metrics(argument, cell) | {"stats": stats}


def _explained(row: Row, prepared: Prepared[Any]) -> Row:
    """The row as JSON values; the reason of a failure names what the data do not excite."""
    warning = "" if row["status"] == "ok" else prepared.source.warning
    if warning:
        row = row | {"reason": f"{row['reason']} {warning}".strip()}
    return dict(plain(row))


def _failure(error: BaseException) -> Row:
    """Status and reason; errors of plug-ins, which are not ours, with their traceback."""
    row: Row = {"status": "failed", "reason": reason_of(error)}
    if not isinstance(error, SysidBenchError):
        row["traceback"] = "".join(traceback.format_exception(error))
    return row
