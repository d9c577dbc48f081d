"""Verb `gate`: a run compared with a baseline; one row is judged as well, for pytest."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import KW_ONLY, asdict, dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from sysid_bench.commands.baseline import known_baseline, times_option, values_of_run, without_times
from sysid_bench.commands.request import FAILED, OK, Request, argument, option, python_function
from sysid_bench.commands.result import HIDDEN, Result
from sysid_bench.errors import UsageError

if TYPE_CHECKING:
    from sysid_bench.harness.cell import Cell
    from sysid_bench.harness.comparison.baseline import Baseline
    from sysid_bench.harness.comparison.run_difference import RunDifference
    from sysid_bench.harness.stored_run import RunFolder
    from sysid_bench.reporting.check_files import Check

_SHOWN: Final = (
    "status", "reason", "crosscheck", "rank", "gap", "condition", "torque_error", "seconds",
)  # fmt: skip


class Gate(Request["GateResult"]):
    """Compare a run with a baseline; exit code 1 where anything got worse.

    Worse are: another status, a value beyond its tolerance, cells that get worse in common, another
    robot (joint and quantity are named), cells that are gone, and with --times slower parts.
    Improvements are reported; `baseline update` takes them over.
    """

    folder: str | Path = argument("RUN", complete="runs folders")
    baseline: str | Path = option("Baseline file.", path="new", complete="files")
    _: KW_ONLY
    partial: bool = False
    times: bool = times_option()
    exact: bool = option(
        "List values that moved by more than 1e-12, too; none of them fails.", default=False
    )

    def run(self) -> "GateResult":
        """Compare a run with a baseline.

        `partial`: cells of the baseline that the run has no row of do not count; `times`: ratios of
        times within the run are compared, too; `exact`: `moved` lists what is another number.
        Raises UsageError for a folder that is not a run, and a file that is not a baseline, or one
        without times, or without the digits for `exact`.
        """
        from sysid_bench.commands.changes import change_json, moved_text
        from sysid_bench.commands.run_folder import open_run
        from sysid_bench.harness.comparison.baseline import EXACT_DIGITS
        from sysid_bench.harness.comparison.run_difference import moved_values
        from sysid_bench.harness.comparison.run_values import with_ids_of

        known = known_baseline(self.baseline, times=self.times)
        run, file = open_run(self.folder), str(self.baseline)
        if self.exact and known.digits < EXACT_DIGITS:
            raise UsageError(
                f"The baseline {file!r} holds {known.digits} digits of a value, and --exact needs "
                f"{EXACT_DIGITS}; compare with one of a run of the code before ('sysid-bench "
                "baseline save RUN -o exact.json'), or leave --exact out."
            )
        result = gate_run(run, known, file, partial=self.partial, times=self.times)
        if not self.exact:
            return result
        now = values_of_run(run, tuple(known.run.metrics))
        before = with_ids_of(known.run, now)
        changes = moved_values(before, now, known.tolerances)
        return replace(
            result,
            moved=[change_json(before, change) for change in changes],
            text=f"{moved_text(before, changes, result.origin)}\n\n{result.text}",
        )

    def exit_code(self, result: "GateResult") -> int:
        return OK if result.ok else FAILED


class GateCommand(Gate):
    junit: Path | None = option(
        "Write JUnit XML, a case per cell.", default=None, path="new file", complete="files"
    )
    markdown: Path | None = option(
        "Append the summary to this file.", default=None, path="new file", complete="files"
    )
    annotations: bool = option("Print failures as hosted CI reads them.", default=False)

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.terminal import print_result

        result = self.run()
        if self.junit is not None:
            result.write_junit(self.junit)
        if self.markdown is not None:
            result.write_markdown(self.markdown)
        print_result(result, as_json)
        if self.annotations:
            click.echo(result.annotations(), nl=False, err=as_json)
        return self.exit_code(result)


gate = python_function(Gate, "gate")


def gate_run(
    run: "RunFolder", known: "Baseline", file: str, *, partial: bool, times: bool = False
) -> "GateResult":
    """Compare a run with the baseline `known` of a file; raise UsageError where nothing can be
    compared that was asked for, `times` among it."""
    from sysid_bench.commands.changes import change_json, common_fields
    from sysid_bench.harness.comparison.run_difference import find_difference

    now = values_of_run(run, tuple(known.run.metrics), times=times)
    if times and not now.speeds:
        raise without_times(run)
    # Without --times the speeds of the baseline are left out: they are not to be missed.
    before = known.run if times else replace(known.run, speeds={})
    changes = find_difference(before, now, known.tolerances, partial=partial)
    before = changes.before
    compared = len(set(before.cells).intersection(now.cells))
    if not compared:
        raise UsageError(
            f"The baseline {file!r} of {known.run.name!r} has no cell of this run of "
            f"{now.name!r}; choose the baseline of its suite, or save one."
        )
    if times and not changes.speeds:
        raise _without_common_times(run, file, changes)
    better = [change for change in changes.cells if not change.is_failed]
    return GateResult(
        folder=str(run.path),
        baseline=file,
        ok=not changes.is_failed,
        cells=compared - len(changes.open),
        failures=[change_json(before, change) for change in changes.failed_cells],
        improvements=[change_json(before, change) for change in better],
        **common_fields(changes),
        speeds=[asdict(change) | {"noise": math.expm1(change.noise)} for change in changes.speeds],
        untimed=[*changes.without_time],
        text=_gate_text(str(run.path), file, changes, len(better)),
        checks=tuple(_checks(changes)),
    )


def _without_common_times(run: "RunFolder", file: str, changes: "RunDifference") -> UsageError:
    from sysid_bench.commands.changes import first_labels

    alone = first_labels(changes.without_time) or "none"
    return UsageError(
        f"The baseline {file!r} and {str(run.path)!r} have no robot with times of two parts in "
        f"both (in the baseline alone: {alone}); save the baseline again from such a run."
    )


@dataclass(frozen=True, eq=False, repr=False)
class GateResult(Result):
    """Comparison of a run with a baseline.

    `failures` and `improvements` are changes beyond the tolerances, `parameters` the changed true
    base parameters, `models` other quantities of robots, `drifts` metrics whose cells move in
    common within their tolerance, `vanished` and `open` cells of the baseline that the run has not,
    or has no row of; `origin` names other versions; `speeds` are the changes of times as ratios
    within the runs, where these were asked for; `untimed` robots and parts have times in the
    baseline alone; `moved` values are other numbers, where asked for.
    """

    folder: str
    baseline: str
    ok: bool
    cells: int
    failures: list[dict[str, Any]]
    improvements: list[dict[str, Any]]
    parameters: list[dict[str, Any]]
    models: list[dict[str, Any]]
    drifts: list[dict[str, Any]]
    appeared: list[str]
    vanished: list[str]
    open: list[str]
    origin: list[tuple[str, str, str]]
    speeds: list[dict[str, Any]]
    untimed: list[str]
    text: str = field(metadata=HIDDEN)
    checks: "tuple[Check, ...]" = field(metadata=HIDDEN)
    moved: list[dict[str, Any]] = field(default_factory=list)

    def summary(self) -> str:
        """Regressions as tables, and the other differences."""
        return self.text

    def write_junit(self, file: str | Path) -> None:
        """Write JUnit XML with a test case for each cell and for each robot whose parameters
        changed."""
        from sysid_bench.reporting.check_files import to_junit

        Path(file).write_text(to_junit(self.baseline, self.checks), encoding="utf-8")

    def write_markdown(self, file: str | Path) -> None:
        """Append the summary to a Markdown file, such as the summary of a job."""
        with Path(file).open("a", encoding="utf-8") as out:
            out.write(f"### {self.baseline}\n\n{self.text}\n")

    def annotations(self) -> str:
        """Failures as workflow commands, a line each, which hosted CI shows beside the file."""
        from sysid_bench.reporting.check_files import to_annotations

        return to_annotations("sysid-bench gate", self.baseline, self.checks)


def _checks(changes: "RunDifference") -> "Iterator[Check]":
    """Yield a check for each cell of the baseline, and for each robot that is another one."""
    from sysid_bench.commands.changes import value_text
    from sysid_bench.reporting.check_files import Check

    wrong: dict[str, list[str]] = {cell: [] for cell in changes.before.cells}
    for one in changes.failed_cells:
        pair = f"{value_text(one.before)} -> {value_text(one.after)}"
        reason = f" ({one.reason})" if one.reason else ""
        sentence = f"{one.metric} {pair}, tolerance {one.tolerance}{reason}"
        wrong.setdefault(one.cell, []).append(sentence)
    for cells, what in ((changes.vanished, "vanished"), (changes.open, "has no row")):
        for cell in cells:
            wrong[cell].append(what)
    for cell in changes.before.cells:
        yield Check(changes.before.label(cell), tuple(wrong[cell]))
    robots: dict[str, list[str]] = {}
    for moved in changes.parameters:
        pair = f"{value_text(moved.before)} -> {value_text(moved.after)}"
        robots.setdefault(moved.robot, []).append(f"{moved.parameter} {pair} ({moved.setting})")
    for robot, sentences in robots.items():
        yield Check(f"{robot} base parameters", tuple(sentences))
    for robot, group in groupby(changes.models, key=lambda change: change.robot):
        named = (f"{one.joint or 'robot'}: {one.quantity}" for one in group)
        yield Check(f"{robot} model", tuple(named))
    for drift in changes.failed_drifts:
        sentence = (
            f"{drift.factor:.6g} times in the mean of {len(drift.cells)} cells, p {drift.p:.1g}"
        )
        yield Check(f"{drift.metric} of all cells", (sentence,))
    for slow in changes.failed_speed:
        yield Check(f"{slow.robot} {slow.part} time", (f"{slow.factor:.3g} times as slow",))


def _gate_text(folder: str, baseline: str, changes: "RunDifference", better: int) -> str:
    from sysid_bench.commands.changes import (
        cells_text,
        drift_text,
        largest_first,
        models_text,
        origin_text,
        speed_text,
        tables_text,
    )
    from sysid_bench.commands.run_folder import rerun_command

    worse = largest_first(changes.failed_cells)
    shown = tables_text("Worse than the baseline", changes, worse) + cells_text(changes)
    if better:
        update = f"'sysid-bench baseline update {folder} -o {baseline}' takes them over"
        shown.append(f"{better} values are better or new; {update}.")
    shown += [*models_text(changes), *drift_text(changes)]
    shown += [*speed_text(changes), *origin_text(changes)]
    if worse:
        shown.append(f"reproduce: {rerun_command(folder, worse[0].cell)}")
    counts = {
        "values beyond their tolerance": len(changes.failed_cells),
        "other base parameters": len(changes.parameters),
        "other quantities of robots": len(changes.models),
        "metrics that get worse in common": len(changes.failed_drifts),
        "cells vanished": len(changes.vanished),
        "cells without a row": len(changes.open),
        "slower parts": len(changes.failed_speed),
    }
    reasons = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
    verdict = f"keeps the baseline {baseline}."
    if changes.is_failed:
        verdict = f"fails the baseline {baseline}: {reasons}."
    return "\n\n".join([*shown, f"{folder} {verdict}"])


def cell_text(
    cell: "Cell", row: Mapping[str, Any], baseline: "Baseline | None", run: "RunFolder"
) -> str:
    """Return what is wrong with a row of a run, with the row and the command that computes it
    again; "" for nothing. Without its cell in a baseline a row has to be ok, and its regressor the
    one of Pinocchio."""
    from sysid_bench.commands.run_folder import rerun_command

    wrong: list[str] = []
    changes = None if baseline is None else _changes_of_row(cell, row, baseline, run)
    if changes is not None:
        wrong = changes
    elif row["status"] != "ok" or row.get("crosscheck") == "failed":
        wrong = [str(row.get("reason") or "the cross-check failed")]
    if not wrong:
        return ""
    facts = [f"{name:<14}{row[name]}" for name in _SHOWN if row.get(name) not in (None, "")]
    again = f"reproduce: {rerun_command(run.path, cell.id)}"
    return "\n\n".join([*wrong, "\n".join(facts), again])


def _changes_of_row(
    cell: "Cell", row: Mapping[str, Any], baseline: "Baseline", run: "RunFolder"
) -> list[str] | None:
    """Tables of what is worse than the baseline; None where it has no such cell."""
    from sysid_bench.commands.changes import largest_first, tables_text
    from sysid_bench.harness.comparison.run_difference import find_difference
    from sysid_bench.harness.comparison.run_values import cell_values, settings_key, true_values

    known = baseline.run
    first = cell.first_fields
    values = cell_values(first, dict(row), known.axes, known.metrics)
    table = row.get("parameters_table") or ()
    truth = true_values(table)
    parameters = {settings_key(first, table): truth} if truth else {}
    record = run.models.get(values.robot)
    # A run of one cell: partial, so that all others of the baseline do not count as gone.
    now = replace(
        known, cells={cell.id: values}, parameters=parameters, heads={cell.id: first},
        models={values.robot: record["behaviour"]} if record else {},
    )  # fmt: skip
    changes = find_difference(known, now, baseline.tolerances, partial=True)
    if changes.appeared:
        return None
    if not changes.is_failed:
        return []
    return tables_text("Worse than the baseline", changes, largest_first(changes.failed_cells))
