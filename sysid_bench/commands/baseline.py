"""Verbs `baseline save`, `baseline update` and `gate`: a small file of values, and the runs that
are compared with it; one row is judged as well, for pytest."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, asdict, dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from sysid_bench.commands.compare import metrics_option
from sysid_bench.commands.request import FAILED, OK, Request, argument, option, python_function
from sysid_bench.commands.result import HIDDEN, Result
from sysid_bench.commands.values import parse_numbers
from sysid_bench.errors import UsageError

if TYPE_CHECKING:
    from sysid_bench.harness.cell import Cell
    from sysid_bench.harness.comparison.baseline import Baseline
    from sysid_bench.harness.comparison.run_difference import RunDifference
    from sysid_bench.harness.comparison.run_values import RunValues
    from sysid_bench.harness.stored_run import RunFolder
    from sysid_bench.reporting.check_files import Check

_NO_TIMES: Final = "no part with three CPU times or more of one cell"
_SHOWN: Final = (
    "status", "reason", "crosscheck", "rank", "gap", "condition", "torque_error", "seconds",
)  # fmt: skip


def _times_option() -> Any:
    return option(
        "Times, too, as ratios within the run (three repeats or more).", default=False,
        flags="--times",
    )  # fmt: skip


# --- Baselines as files -------------------------------------------------------------------------


class BaselineSave(Request["BaselineResult"]):
    """Save the baseline of a run: sorted, a line per cell, with versions and tolerances."""

    folder: str | Path = argument("RUN", complete="runs folders")
    out: str | Path = option(
        "JSON file to write.", flags="-o --out", path="new file", complete="files"
    )
    _: KW_ONLY
    metrics: Sequence[str] = metrics_option()
    tolerances: Mapping[str, float] | None = option(
        "Factor for an error, difference for a gap; in place of the default.",
        default=None, flags="--tolerance", metavar="METRIC=SIZE", several=True,
        parse=lambda texts: parse_numbers("tolerance", texts), complete="metrics",
    )  # fmt: skip
    times: bool = _times_option()

    def run(self) -> "BaselineResult":
        """Write the baseline of a run.

        `metrics` replace the default ones; `tolerances`: metric -> size, in the kind of its default
        (a factor for errors, a difference for gaps); `times`: ratios of times within the run, too.
        Raises UsageError for an unknown metric, and where the `times` asked for are not there.
        """
        from sysid_bench.harness.comparison.baseline import baseline_of
        from sysid_bench.harness.comparison.run_values import Tolerance, read_run

        folder, sizes = _whole_run(self.folder), {}
        values = read_run(folder, tuple(self.metrics), times=self.times)
        if self.times and not values.speeds:
            raise _without_times(folder)
        default = baseline_of(values).tolerances
        for name, size in (self.tolerances or {}).items():
            known = default.get(name, Tolerance("exact"))
            kind = "ratio" if known.kind == "exact" else known.kind
            try:
                sizes[name] = Tolerance(kind, size, known.floor)
            except UsageError as error:
                raise UsageError(f"The tolerance {name}={size:g} cannot be: {error}") from error
        return _write(baseline_of(values, sizes), Path(self.out))


class BaselineUpdate(Request["BaselineResult"]):
    """Take the changes of a run over into its baseline; values within their tolerance stay, and so
    do tolerances and metrics."""

    folder: str | Path = argument("RUN", complete="runs folders")
    out: str | Path = option(
        "Baseline to replace.", flags="-o --out", path="new file", complete="files"
    )

    def run(self) -> "BaselineResult":
        """Take the changes of a run over into a baseline: what a comparison with it finds, and
        nothing else, so that values within their tolerance stay unless they drift in common.
        Metrics and tolerances stay, and times where the run has none."""
        from sysid_bench.harness.comparison.baseline import baseline_of, update_of
        from sysid_bench.harness.comparison.run_difference import find_difference
        from sysid_bench.harness.comparison.run_values import read_run

        old = read_baseline(self.out)
        run, metrics = _whole_run(self.folder), tuple(old.run.metrics)
        now = read_run(run, metrics, times=bool(old.run.speeds))
        changes = find_difference(old.run, now, old.tolerances)
        update = update_of(changes)
        # With the old tolerances: those of a baseline are part of an agreement, not of a run.
        written = _write(baseline_of(update.run, old.tolerances, old.digits), Path(self.out))
        return replace(
            written,
            taken=update.taken,
            counts=dict(update.counts),
            untimed=[*changes.without_time],
            kept=bool(old.run.speeds) and not now.speeds,
        )


baseline_save = python_function(BaselineSave, "baseline_save")
baseline_update = python_function(BaselineUpdate, "baseline_update")


@dataclass(frozen=True, eq=False, repr=False)
class BaselineResult(Result):
    """A baseline that was written: its file, cells and metrics, and the `taken` changes from the
    one that was there, with their `counts` by kind. `untimed` robots and parts had times there and
    have none in the run; `kept`: no part has, and those of before stay."""

    file: str
    cells: int
    metrics: list[str]
    bytes: int
    taken: int | None = None
    counts: dict[str, int] = field(default_factory=dict)
    untimed: list[str] = field(default_factory=list)
    kept: bool = False

    def summary(self) -> str:
        """One sentence."""
        from sysid_bench.commands.changes import first_labels

        kinds = ", ".join(f"{count} {what}" for what, count in self.counts.items())
        taken = "" if self.taken is None else f"; {self.taken} changes taken over"
        taken += f" ({kinds})" if kinds else ""
        times = ""
        if self.untimed and self.kept:
            times = f"; times are those of before, since the run has {_NO_TIMES}"
        elif self.untimed:
            times = f"; without times that were there: {first_labels(self.untimed)}"
        return f"{self.file}: {self.cells} cells, {self.bytes} bytes{taken}{times}"


def _whole_run(folder: str | Path) -> "RunFolder":
    """Open a run; raise UsageError for one with damaged rows, whose cells would become open ones of
    a baseline, which no gate compares."""
    from sysid_bench.commands.run_folder import damage_note, open_run

    run = open_run(folder)
    if run.damaged:
        raise UsageError(f"{str(folder)!r}: {damage_note(run.damaged)}")
    return run


def read_baseline(file: str | Path) -> "Baseline":
    """Return the baseline of a file; raise UsageError where it is not one."""
    from sysid_bench.harness.comparison.baseline import from_text
    from sysid_bench.input_files import read_text

    try:
        return from_text(read_text(Path(file)), str(file))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UsageError(
            f"The baseline {str(file)!r} cannot be read ({reason}); write one with "
            "'sysid-bench baseline save RUN -o FILE'."
        ) from error


def known_baseline(file: str | Path, *, times: bool) -> "Baseline":
    """Return the baseline of a file; raise UsageError for one without the `times` asked for."""
    known = read_baseline(file)
    if times and not known.run.speeds:
        raise UsageError(
            f"The baseline {str(file)!r} holds no times; save it with 'sysid-bench baseline save "
            f"RUN -o {file} --times', from three repeats or more."
        )
    return known


def _write(baseline: "Baseline", file: Path) -> BaselineResult:
    from sysid_bench.commands.run_folder import write_whole
    from sysid_bench.harness.comparison.baseline import to_text

    text = to_text(baseline)
    write_whole(file, text)
    cells, metrics = len(baseline.run.cells), [*baseline.run.metrics]
    return BaselineResult(str(file), cells, metrics, len(text.encode()))


def _without_times(run: "RunFolder") -> UsageError:
    """The error of a run that has no times to compare."""
    return UsageError(
        f"{str(run.path)!r} has {_NO_TIMES}; --times needs a suite with 'repeats = 3' or more, "
        "and ok cells."
    )


def values_of_run(run: "RunFolder", metrics: Sequence[str], *, times: bool = False) -> "RunValues":
    """Return what a run is compared by; raise UsageError for one without rows."""
    from sysid_bench.commands.run_folder import no_rows
    from sysid_bench.harness.comparison.run_values import read_run

    values = read_run(run, metrics, times=times)
    if all(cell.status == "open" for cell in values.cells.values()):
        raise no_rows(run)
    return values


# --- The gate -----------------------------------------------------------------------------------


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
    times: bool = _times_option()
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
        raise _without_times(run)
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
