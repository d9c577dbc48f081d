"""Baselines of runs, and the gate that compares a run with one."""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sysid_bench.comparison.baseline import Baseline, baseline_of, from_text, to_text
from sysid_bench.comparison.changes import RunChanges, changes_between
from sysid_bench.comparison.run_values import RunValues, read_run
from sysid_bench.comparison.tolerance import Tolerance, tolerance_of
from sysid_bench.errors import UsageError
from sysid_bench.harness.store import RunFolder
from sysid_bench.input_files import read_text
from sysid_bench.metrics import METRICS
from sysid_bench.reporting.ci_files import Check, to_annotations, to_junit
from sysid_bench.verbs import change_listing as listing
from sysid_bench.verbs.result import Result
from sysid_bench.verbs.run_folder import no_rows, open_run


@dataclass(frozen=True, eq=False, repr=False)
class GateResult(Result):
    """Comparison of a run with a baseline. `failures` and `improvements` are changes beyond the
    tolerances, `parameters` the changed true base parameters, `vanished` and `open` cells of the
    baseline that the run has not, or has no row of; `origin` names other versions; `speeds` are the
    changes of times as ratios within the runs, where these were asked for."""

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


@dataclass(frozen=True, eq=False, repr=False)
class BaselineResult(Result):
    """A baseline that was written: its file, cells and metrics, and the `taken` changes from the
    one that was there."""

    file: str
    cells: int
    metrics: list[str]
    bytes: int
    taken: int | None

    def summary(self) -> str:
        """One sentence."""
        taken = "" if self.taken is None else f"; {self.taken} changes taken over"
        return f"{self.file}: {self.cells} cells, {self.bytes} bytes{taken}"


def read_baseline(file: str | Path) -> Baseline:
    """The baseline of a file; raises UsageError where it is not one."""
    try:
        return from_text(read_text(Path(file)), str(file))
    except (OSError, UnicodeDecodeError) as error:
        why = "it is not a text" if isinstance(error, UnicodeDecodeError) else error.strerror
        raise UsageError(
            f"The baseline {str(file)!r} cannot be read ({why or error}); write one with "
            "'sysid-bench baseline save RUN -o FILE'."
        ) from error


def baseline_save(
    run: str | Path,
    out: str | Path,
    *,
    metrics: Sequence[str] = (),
    tolerances: Mapping[str, float] | None = None,
    times: bool = False,
) -> BaselineResult:
    """Write the baseline of a run.

    `metrics` replace the default ones; `tolerances`: metric -> size, in the kind of its default
    (a factor for errors, a difference for gaps); `times`: ratios of times within the run, too.
    Raises UsageError for an unknown metric.
    """
    sizes = _tolerances(tolerances or {})
    names = tuple(metrics) or ()
    return _write(baseline_of(read_run(open_run(run), names, times=times), sizes), Path(out), None)


def _tolerances(sizes: Mapping[str, float]) -> dict[str, Tolerance]:
    found = {}
    for name, size in sizes.items():
        known = tolerance_of(METRICS[name]) if name in METRICS else Tolerance("ratio", 1.01, 0.0)
        kind = "ratio" if known.kind == "exact" else known.kind
        try:
            found[name] = Tolerance(kind, size, known.floor)
        except UsageError as error:
            raise UsageError(f"The tolerance {name}={size:g} cannot be: {error}") from error
    return found


def _write(baseline: Baseline, file: Path, taken: int | None) -> BaselineResult:
    text = to_text(baseline)
    file.parent.mkdir(parents=True, exist_ok=True)
    # All or nothing: a full disk must not cost the baseline that was there.
    part = file.with_name(f".{file.name}.{os.getpid()}")
    part.write_text(text, encoding="utf-8")
    part.replace(file)
    run = baseline.run
    return BaselineResult(str(file), len(run.cells), [*run.metrics], len(text.encode()), taken)


def baseline_update(run: str | Path, file: str | Path) -> BaselineResult:
    """Replace the values of a baseline by those of a run; metrics and tolerances stay, and times
    where it holds any."""
    old = read_baseline(file)
    now = read_run(open_run(run), tuple(old.run.metrics), times=bool(old.run.speeds))
    changes = changes_between(old.run, now, old.tolerances)
    taken = len(changes.cells) + len(changes.parameters)
    taken += len(changes.appeared) + len(changes.vanished)
    return _write(baseline_of(now, old.tolerances), Path(file), taken)


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
    """Compare a run with the baseline `known` of a file."""
    now = values_of_run(run, tuple(known.run.metrics), times=times)
    changes = changes_between(known.run, now, known.tolerances, partial=partial)
    if not set(known.run.cells) & set(now.cells):
        raise UsageError(
            f"The baseline {file!r} of {known.run.name!r} has no cell of this run of "
            f"{now.name!r}; choose the baseline of its suite, or save one."
        )
    return _result(str(run.path), file, changes)


def _result(folder: str, baseline: str, changes: RunChanges) -> GateResult:
    better = [change for change in changes.cells if not change.fails]
    compared = sum(cell in changes.after.cells for cell in changes.before.cells)
    return GateResult(
        folder=folder,
        baseline=baseline,
        ok=not changes.fails,
        cells=compared - len(changes.open),
        failures=[listing.change_json(changes, change) for change in changes.failures],
        improvements=[listing.change_json(changes, change) for change in better],
        parameters=[listing.parameter_json(change) for change in changes.parameters],
        appeared=list(changes.appeared),
        vanished=list(changes.vanished),
        open=list(changes.open),
        origin=list(changes.origin),
        speeds=[listing.speed_json(change) for change in changes.speeds],
        text=_text(folder, baseline, changes, len(better)),
        checks=tuple(_checks(changes)),
    )


def _checks(changes: RunChanges) -> Iterator[Check]:
    """Yield a check for each cell of the baseline, and for each robot that is another one."""
    wrong: dict[str, list[str]] = {}
    for change in changes.failures:
        pair = f"{listing.text(change.before)} -> {listing.text(change.after)}"
        reason = f" ({change.reason})" if change.reason else ""
        sentence = f"{change.metric} {pair}, tolerance {change.tolerance}{reason}"
        wrong.setdefault(change.cell, []).append(sentence)
    gone = dict.fromkeys(changes.vanished, "vanished") | dict.fromkeys(changes.open, "has no row")
    for cell in changes.before.cells:
        sentences = [*wrong.get(cell, ()), *filter(None, [gone.get(cell)])]
        yield Check(changes.before.label(cell), tuple(sentences))
    robots: dict[str, list[str]] = {}
    for moved in changes.parameters:
        pair = f"{listing.text(moved.before)} -> {listing.text(moved.after)}"
        robots.setdefault(moved.robot, []).append(f"{moved.parameter} {pair} ({moved.setting})")
    for robot, sentences in robots.items():
        yield Check(f"{robot} base parameters", tuple(sentences))
    for slow in changes.slower:
        yield Check(f"{slow.robot} {slow.part} time", (f"{slow.factor:.3g} times as slow",))


def _text(folder: str, baseline: str, changes: RunChanges, better: int) -> str:
    worse = listing.largest_first(changes.failures)
    shown = listing.tables_text(changes, "Worse than the baseline", worse)
    shown += listing.cells_text(changes)
    if better:
        update = f"'sysid-bench baseline update {folder} -o {baseline}' takes them over"
        shown.append(f"{better} values are better or new; {update}.")
    shown += [*listing.speed_text(changes), *listing.origin_text(changes)]
    if worse:
        shown.append(f"reproduce: {listing.reproduce(folder, worse[0].cell)}")
    if not changes.fails:
        return "\n\n".join([*shown, f"{folder} keeps the baseline {baseline}."])
    counts = {
        "values beyond their tolerance": len(changes.failures),
        "other base parameters": len(changes.parameters),
        "cells vanished": len(changes.vanished),
        "cells without a row": len(changes.open),
        "slower parts": len(changes.slower),
    }
    reasons = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
    return "\n\n".join([*shown, f"{folder} fails the baseline {baseline}: {reasons}."])
