"""Execution of one experiment: a row for each of its estimators, whatever happens."""

import json
import math
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, Final

from sysid_bench.canonical_json import plain
from sysid_bench.errors import LONGEST_TEXT, SysidBenchError, UsageError, reason_of, status_of
from sysid_bench.evaluation.intervals import at_level
from sysid_bench.evaluation.score import base_parameters
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.job_channel import (
    JobChannel,
    JobEnd,
    MemoryUse,
    MethodEnd,
    usage_fields,
)
from sysid_bench.experiments.loaded_robot import LoadedRobot, loaded_robot
from sysid_bench.experiments.paper_data import write_paper_data
from sysid_bench.experiments.recorded.prepare import prepare_recorded
from sysid_bench.experiments.simulated.prepare import prepare_simulated
from sysid_bench.experiments.spec import SEALED, ExperimentSpec, refuse_beside_seeds
from sysid_bench.experiments.third_party import loaded_sources, read_package_files
from sysid_bench.identification.identify import fit_fields, identify
from sysid_bench.metrics import REASONS, metric_fields
from sysid_bench.plugin_names import build, is_of_package, module_files
from sysid_bench.regressors.kernel_c import kernel_times
from sysid_bench.types import MetricInput, Row, Score
from sysid_bench.version_fields import version_fields


def prepare(spec: ExperimentSpec, loaded: LoadedRobot) -> ExperimentData[Any]:
    """The data, problem and scoring of a specification.

    Raises UnsupportedError or UsageError where there is no such experiment, with the reason.
    """
    run = prepare_simulated if spec.log is None else prepare_recorded
    return run(spec, loaded)


def execute(argument: Mapping[str, Any], channel: JobChannel) -> None:
    """Run the experiment of `argument` (`job_of` in harness/run.py); emit a row for each open cell.

    Third-party code (`argument["third_party"]`) runs in processes of its own: an experiment whose
    data depend on it as a whole, otherwise cells with metrics of others, one by one. An estimator
    of others runs in a process that never held the truth, and this one scores its answer. Built-in
    methods see the same process whoever else is in the suite.
    """
    with at_level(argument["experiment"].get("confidence")):
        if not argument["third_party"]["data"]:
            _execute(argument, channel)
            return
        read_package_files()
        open_cells = (entry for entry in argument["estimators"] if entry["cell"] in channel.cells)
        heads = {entry["cell"]: _header(argument, entry) for entry in open_cells}
        death = channel.run_process(partial(_execute, argument), heads)
        if death is not None:
            raise JobEnd(death)


def _execute(argument: Mapping[str, Any], channel: JobChannel) -> None:
    estimators = [entry for entry in argument["estimators"] if entry["cell"] in channel.cells]
    headers = {entry["cell"]: _header(argument, entry) for entry in estimators}
    try:
        spec, loaded = load_experiment(argument)
        shared = _robot_fields(loaded, argument["crosscheck"])
    except SysidBenchError as error:
        _emit_all(headers, channel, {"status": "failed", "reason": str(error)})
        return
    if shared["crosscheck"] == "failed" and argument["crosscheck"]["on_fail"] == "skip-robot":
        reason = f"cross-check failed: {loaded.check.reason(argument['crosscheck']['tolerance'])}"
        _emit_all(headers, channel, shared | {"status": "skipped", "reason": reason})
        return
    try:
        start, cpu_start, kernel_start = time.perf_counter(), time.process_time(), kernel_times()
        prepared = prepare(spec, loaded)
        seconds = {
            "seconds_experiment": time.perf_counter() - start,
            "seconds_experiment_cpu": time.process_time() - cpu_start,
            "seconds_kernel_cpu": kernel_times() - kernel_start,
        }
    except SysidBenchError as error:
        outcome = {"status": status_of(error), "reason": str(error)}
        _emit_all(headers, channel, shared | outcome)
        return
    code = argument["third_party"]
    if any(code.values()):
        read_package_files()  # once, before the forks and the time limits of their cells
    for entry in estimators:
        header = headers[entry["cell"]] | shared | seconds
        cell = _PreparedCell(argument, entry, prepared, header)
        channel.start_cell(entry["cell"])
        # Metrics of others are given the truth: they may spoil their own process alone.
        emit = cell.emit_isolated if code["metrics"] else cell.emit
        emit(channel)


@dataclass(frozen=True, eq=False)
class _PreparedCell:
    """One estimator on the data of its experiment."""

    argument: Mapping[str, Any]
    entry: Mapping[str, Any]
    prepared: ExperimentData[Any]
    header: Row

    def emit(self, channel: JobChannel) -> None:
        """Compute the row in this process, with a method of others in one that never held the
        truth; an exception of a plug-in is a failed row."""
        code = self.argument["third_party"]
        loads_others = code["data"] or code["metrics"]
        row: Row = {"sources": loaded_sources(module_files())} if loads_others else {}
        if self.entry["cell"] not in code["methods"]:
            peak = MemoryUse()
            found = self._row(partial(estimator_of, self.entry)) | usage_fields(peak.value)
            channel.write(self.header | found | row)
            return
        settings = estimator_settings(self.entry)
        experiment = self.argument["experiment"]
        simulated = experiment.get("log") is None
        sealed = bool((experiment.get("plant") or {}).get(SEALED))
        try:
            with channel.blind_method(settings, simulated=simulated, sealed=sealed) as method:
                found = self._row(lambda: method) | usage_fields(method.peak_memory)
            found |= {"isolation": method.isolation}
            row["sources"] = dict(sorted({**row.get("sources", {}), **method.sources}.items()))
        except MethodEnd as ended:  # it could not be built
            found = self._ended(ended) | usage_fields(None) | {"isolation": None}
        channel.write(self.header | found | {"sources": {}} | row)

    def _row(self, make: Callable[[], Any]) -> Row:
        """The row of an estimator; an exception is a failed row."""
        try:
            return self._explained(self._scored(make()))
        except MethodEnd as ended:
            return self._ended(ended)
        except BaseException as error:  # Ctrl-C of a user reaches the supervisor alone
            row = {"status": status_of(error), "reason": reason_of(error)}
            if not isinstance(error, SysidBenchError):
                lines = [line[:LONGEST_TEXT] for line in traceback.format_exception(error)]
                row["traceback"] = "".join(lines)
            return self._explained(row | self.prepared.fields)

    def _ended(self, ended: MethodEnd) -> Row:
        return self._explained(ended.end.fields | self.prepared.fields)

    def emit_isolated(self, channel: JobChannel) -> None:
        """Compute the row in a process of its own; its end without a row is one here."""
        fields = self.prepared.fields  # computed before the fork, once for all cells
        cell = self.entry["cell"]
        death = channel.run_process(self.emit, {cell: self.header})
        if death is not None and cell in channel.cells:
            row = self._explained(fields | usage_fields(None) | death.fields)
            channel.write(self.header | row)

    def _explained(self, row: Row) -> Row:
        """The row as JSON values; the reason of a failure names what the data do not excite."""
        warning = "" if row["status"] == "ok" else self.prepared.source.warning
        if warning:
            row = row | {"reason": f"{row['reason']} {warning}".strip()}
        return dict(plain(row))

    def _scored(self, method: Any) -> Row:
        """Status, scores and parameters of the estimate; what `[[paper]]` entries need is stored
        beside it."""
        prepared = self.prepared
        estimate = identify(method, prepared.problem, prepared.experiment)
        stats = dict(estimate.stats)
        row: Row = {
            "status": estimate.status,
            "reason": estimate.reason,
            "seconds": stats.pop("seconds"),
            "seconds_cpu": stats.pop("seconds_cpu"),
            **fit_fields(estimate),
        }
        scores = prepared.score(method, estimate)
        errors = ("rmse_train", "rmse_test", "torque_error")
        bad = [name for name in errors if not math.isfinite(scores.get(name) or 0.0)]
        if row["status"] == "ok" and bad:
            # An estimate whose errors overflow predicts no torque, whatever it claims.
            reason = f"the estimate gives no finite {' and '.join(bad)}; {row['reason']}"
            row |= {"status": "failed", "reason": reason.rstrip("; ")}
        write_paper_data(self.argument, self.entry["cell"], estimate, prepared)
        row |= scores | prepared.fields | {"stats": _limited(stats)}
        score = Score(**{f.name: scores[f.name] for f in fields(Score) if f.name in scores})
        cell = MetricInput(estimate, prepared.problem, prepared.held_out, score)
        # Metrics of plug-ins ({name, spec} each); empty without an estimate.
        entries = self.argument.get("metrics", ())
        metrics: Row = {entry["name"]: None for entry in entries}
        if base_parameters(estimate) is not None:
            makers = {one["name"]: partial(build, "metric", one["spec"]) for one in entries}
            metrics = metric_fields(makers, cell)
        taken = sorted((metrics.keys() - {REASONS}) & row.keys())
        if taken:
            raise UsageError(
                f"The metric name {taken[0]!r} is a field of rows already; choose another."
            )
        return row | metrics


MOST_STATS: Final = 256
"""Numbers of a method that become columns of the results."""


LARGEST_STATS: Final = 1_000_000
"""Bytes of `stats` as JSON, 40 times the rest of a row: 10,000 cells have 10 GB with them."""


def _limited(stats: Mapping[str, Any]) -> Row:
    """At most MOST_STATS entries of a method's `stats`; the rest as one JSON text, `more`: each key
    is a column, and 300,000 of them took minutes to write. Raises UsageError beyond LARGEST_STATS.
    """
    names = list(stats)
    if (size := len(json.dumps(plain(dict(stats))))) > LARGEST_STATS:
        raise UsageError(
            f"The method's 'stats' have {size / 1e6:.1f} MB; {LARGEST_STATS / 1e6:g} MB are stored "
            "at most, since whoever reads a run reads all its rows. Return less in 'stats'."
        )
    if len(names) <= MOST_STATS:
        return dict(stats)
    kept = {name: stats[name] for name in names[: MOST_STATS - 1]}
    return kept | {"more": json.dumps(plain({x: stats[x] for x in names[MOST_STATS - 1 :]}))}


def load_experiment(argument: Mapping[str, Any]) -> tuple[ExperimentSpec, LoadedRobot]:
    """The specification of an `argument`, and its robot.

    Raises UsageError where code of others makes its data or metrics beside secret seeds.
    """
    code = argument["third_party"]
    if code["data"] or code["metrics"]:
        refuse_beside_seeds("A plug-in of this experiment's data or metrics")
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
    if check.engine != "pinocchio":
        fields["second_engine"] = check.engine
    return dict(plain(fields))


def _emit_all(headers: Mapping[str, Row], channel: JobChannel, fields: Row) -> None:
    for header in headers.values():
        channel.write(header | fields)


def _header(argument: Mapping[str, Any], estimator: Mapping[str, Any]) -> Row:
    cell = estimator["cell"]
    fingerprint = argument.get("fingerprints", {}).get(cell)
    header = {"id": cell, "estimator": estimator["label"], "fingerprint": fingerprint}
    return {**argument["labels"], **header, "versions": version_fields()}


def estimator_of(estimator: Mapping[str, Any]) -> Any:
    """The estimator plug-in of an entry of `argument["estimators"]`, in this process."""
    if not is_of_package("estimator", estimator["use"]):
        refuse_beside_seeds(f"The estimator {estimator['use']!r}")
    return build("estimator", estimator_settings(estimator))


def estimator_settings(estimator: Mapping[str, Any]) -> dict[str, Any]:
    """{use, settings} of an entry of `argument["estimators"]`."""
    return {key: value for key, value in estimator.items() if key not in ("cell", "label")}
