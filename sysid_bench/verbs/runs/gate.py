"""The gate that compares a run with a baseline."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sysid_bench.commands.result import Result
from sysid_bench.errors import UsageError
from sysid_bench.harness.comparison.baseline import Baseline
from sysid_bench.harness.comparison.run_difference import RunDifference, find_difference
from sysid_bench.harness.comparison.run_values import RunValues, read_run
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.reporting.check_files import Check, to_annotations, to_junit
from sysid_bench.verbs.runs import change_table as listing
from sysid_bench.verbs.runs.baseline import read_baseline, without_times
from sysid_bench.verbs.runs.run_folder import no_rows, open_run


@dataclass(frozen=True, eq=False, repr=False)
class GateResult(Result):
    """Comparison of a run with a baseline. `failures` and `improvements` are changes beyond the
    tolerances, `parameters` the changed true base parameters, `vanished` and `open` cells of the
    baseline that the run has not, or has no row of; `origin` names other versions; `speeds` are the
    changes of times as ratios within the runs, where these were asked for; `untimed` robots and
    parts have times in the baseline alone."""

    folder: str
    baseline: str
    ok: bool
    cells: int
    failures: list[dict[str, Any]]
    improvements: list[dict[str, Any]]
    parameters: list[dict[str, Any]]
    appeared: list[str]
    vanished: list[str]
    open: list[str]
    origin: list[tuple[str, str, str]]
    speeds: list[dict[str, Any]]
    untimed: list[str]
    text: str
    checks: tuple[Check, ...]

    def summary(self) -> str:
        """What got worse, as tables, and what else differs."""
        return self.text

    def _fields(self) -> dict[str, Any]:
        hidden = ("text", "checks")
        return {key: value for key, value in super()._fields().items() if key not in hidden}

    def write_junit(self, file: str | Path) -> None:
        """Write JUnit XML with a test case for each cell and for each robot whose parameters
        changed."""
        Path(file).write_text(to_junit(self.baseline, self.checks), encoding="utf-8")

    def write_markdown(self, file: str | Path) -> None:
        """Append the summary to a Markdown file, such as the summary of a job."""
        with Path(file).open("a", encoding="utf-8") as out:
            out.write(f"### {self.baseline}\n\n{self.text}\n")

    def annotations(self) -> str:
        """Failures as workflow commands, a line each, which hosted CI shows beside the file."""
        return to_annotations("sysid-bench gate", self.baseline, self.checks)


def values_of_run(run: RunFolder, metrics: Sequence[str], *, times: bool = False) -> RunValues:
    """What a run is compared by; raises UsageError for one without rows."""
    values = read_run(run, metrics, times=times)
    if all(cell.status == "open" for cell in values.cells.values()):
        raise no_rows(run)
    return values


def gate(
    run: str | Path, baseline: str | Path, *, partial: bool = False, times: bool = False
) -> GateResult:
    """Compare a run with a baseline.

    `partial`: cells of the baseline that the run has no row of do not count; `times`: ratios of
    times within the run are compared, too. Raises UsageError for a folder that is not a run, and a
    file that is not a baseline, or one without times.
    """
    known = known_baseline(baseline, times=times)
    return gate_run(open_run(run), known, str(baseline), partial=partial, times=times)


def known_baseline(file: str | Path, *, times: bool) -> Baseline:
    """The baseline of a file; raises UsageError for one without the `times` asked for."""
    known = read_baseline(file)
    if times and not known.run.speeds:
        raise UsageError(
            f"The baseline {str(file)!r} holds no times; save it with 'sysid-bench baseline save "
            f"RUN -o {file} --times', from three repeats or more."
        )
    return known


def gate_run(
    run: RunFolder, known: Baseline, file: str, *, partial: bool, times: bool = False
) -> GateResult:
    """Compare a run with the baseline `known` of a file; raises UsageError where nothing can be
    compared that was asked for, `times` among it."""
    now = values_of_run(run, tuple(known.run.metrics), times=times)
    if times and not now.speeds:
        raise without_times(run)
    before = known.run if times else replace(known.run, speeds={})
    changes = find_difference(before, now, known.tolerances, partial=partial)
    if set(known.run.cells).isdisjoint(now.cells):
        raise UsageError(
            f"The baseline {file!r} of {known.run.name!r} has no cell of this run of "
            f"{now.name!r}; choose the baseline of its suite, or save one."
        )
    if times:
        _check_speeds(changes, run, file)
    return _result(str(run.path), file, changes)


def _check_speeds(changes: RunDifference, run: RunFolder, file: str) -> None:
    """Raise UsageError where no part has times in the run and in the baseline."""
    if not changes.speeds:
        alone = listing.first_names(changes.without_time) or "none"
        raise UsageError(
            f"The baseline {file!r} and {str(run.path)!r} have no robot with times of two parts in "
            f"both (in the baseline alone: {alone}); save the baseline again from such a run."
        )


def _result(folder: str, baseline: str, changes: RunDifference) -> GateResult:
    better = [change for change in changes.cells if not change.is_failed]
    compared = len(set(changes.before.cells).intersection(changes.after.cells))
    return GateResult(
        folder=folder,
        baseline=baseline,
        ok=not changes.is_failed,
        cells=compared - len(changes.open),
        failures=[listing.change_json(changes, change) for change in changes.failed_cells],
        improvements=[listing.change_json(changes, change) for change in better],
        parameters=[listing.parameter_json(change) for change in changes.parameters],
        appeared=list(changes.appeared),
        vanished=list(changes.vanished),
        open=list(changes.open),
        origin=list(changes.origin),
        speeds=[listing.speed_json(change) for change in changes.speeds],
        untimed=[*changes.without_time],
        text=_text(folder, baseline, changes, len(better)),
        checks=tuple(_checks(changes)),
    )


def _checks(changes: RunDifference) -> Iterator[Check]:
    """Yield a check for each cell of the baseline, and for each robot that is another one."""
    yield from _cell_checks(changes)
    yield from _robot_checks(changes)
    for slow in changes.failed_speed:
        yield Check(f"{slow.robot} {slow.part} time", (f"{slow.factor:.3g} times as slow",))


def _cell_checks(changes: RunDifference) -> Iterator[Check]:
    wrong: dict[str, list[str]] = {}
    for change in changes.failed_cells:
        pair = f"{listing.text(change.before)} -> {listing.text(change.after)}"
        reason = f" ({change.reason})" if change.reason else ""
        sentence = f"{change.metric} {pair}, tolerance {change.tolerance}{reason}"
        wrong.setdefault(change.cell, []).append(sentence)
    gone = dict.fromkeys(changes.vanished, "vanished") | dict.fromkeys(changes.open, "has no row")
    for cell in changes.before.cells:
        sentences = [*wrong.get(cell, ()), *filter(None, [gone.get(cell)])]
        yield Check(changes.before.label(cell), tuple(sentences))


def _robot_checks(changes: RunDifference) -> Iterator[Check]:
    robots: dict[str, list[str]] = {}
    for moved in changes.parameters:
        pair = f"{listing.text(moved.before)} -> {listing.text(moved.after)}"
        robots.setdefault(moved.robot, []).append(f"{moved.parameter} {pair} ({moved.setting})")
    for robot, sentences in robots.items():
        yield Check(f"{robot} base parameters", tuple(sentences))


def _text(folder: str, baseline: str, changes: RunDifference, better: int) -> str:
    worse = listing.largest_first(changes.failed_cells)
    shown = listing.tables_text(changes, "Worse than the baseline", worse)
    shown += listing.cells_text(changes)
    if better:
        update = f"'sysid-bench baseline update {folder} -o {baseline}' takes them over"
        shown.append(f"{better} values are better or new; {update}.")
    shown += [*listing.speed_text(changes), *listing.origin_text(changes)]
    if worse:
        shown.append(f"reproduce: {listing.cell_command(folder, worse[0].cell)}")
    return "\n\n".join([*shown, f"{folder} {_verdict(changes, baseline)}"])


def _verdict(changes: RunDifference, baseline: str) -> str:
    if not changes.is_failed:
        return f"keeps the baseline {baseline}."
    counts = {
        "values beyond their tolerance": len(changes.failed_cells),
        "other base parameters": len(changes.parameters),
        "cells vanished": len(changes.vanished),
        "cells without a row": len(changes.open),
        "slower parts": len(changes.failed_speed),
    }
    reasons = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
    return f"fails the baseline {baseline}: {reasons}."
