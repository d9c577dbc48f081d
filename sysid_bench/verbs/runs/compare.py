"""Comparison of two runs, or of a run with a baseline."""

import json
import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from sysid_bench.commands.result import Result, value_text
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.harness.comparison.run_difference import (
    MARGIN,
    Change,
    MetricRatio,
    RunDifference,
    find_difference,
    metric_ratio,
)
from sysid_bench.harness.comparison.run_values import METRICS_COMPARED, RunValues
from sysid_bench.input_files import is_file
from sysid_bench.reporting import latex
from sysid_bench.reporting.html import write_compare_page
from sysid_bench.reporting.text_table import TextTable, to_csv, to_latex, to_markdown
from sysid_bench.verbs.runs import change_table as listing
from sysid_bench.verbs.runs.baseline import read_baseline
from sysid_bench.verbs.runs.gate import values_of_run
from sysid_bench.verbs.runs.run_folder import open_run

FORMATS: Final = ("md", "csv", "latex", "json")
_SHOWN: Final = 15
_NAMES: Final = (*METRICS_COMPARED, "seconds")
_HEAD: Final = (
    "metric", "after / before", "95 % interval", "robots", "lower", "higher", "p",
    "smallest p", "verdict", "cells", "left out",
)  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class CompareResult(Result):
    """Comparison of `after` with `before`: `metrics` as ratios over robots, `changes` of single
    cells beyond the tolerances (the largest first), changed true base parameters, cells that only
    one has, and `origin`: what differs in code, libraries and machine."""

    before: str
    after: str
    cells: int
    equal: int
    metrics: list[dict[str, Any]]
    changes: list[dict[str, Any]]
    parameters: list[dict[str, Any]]
    appeared: list[str]
    vanished: list[str]
    open: list[str]
    origin: list[tuple[str, str, str]]
    listings: tuple[TextTable, ...]
    notes: tuple[str, ...]
    command: str

    def summary(self) -> str:
        """Tables in Markdown and what else differs."""
        tables = [to_markdown(_first_rows(table)).rstrip() for table in self.listings]
        return "\n\n".join([*tables, *self.notes])

    def text(self, form: str) -> str:
        """The table of metrics as "csv" or "latex"; all that was compared as "md" or "json"."""
        if form not in FORMATS:
            raise unknown_name("format", form, FORMATS)
        if form == "json":
            return json.dumps(self.to_dict(), indent=2) + "\n"
        if form == "md":
            return self.summary() + "\n"
        first = self.listings[0]
        if form == "csv":
            return to_csv(first)
        return to_latex(first, latex.Origin(self.after, "", f"{self.command} --format latex"))

    def write_html(self, file: str | Path) -> None:
        """Write a page that is complete in itself, with a filter over the changed cells."""
        write_compare_page(Path(file), f"{self.before} -> {self.after}", self.listings, self.notes)

    def _fields(self) -> dict[str, Any]:
        hidden = ("listings", "notes", "command")
        return {key: value for key, value in super()._fields().items() if key not in hidden}


def _first_rows(table: TextTable) -> TextTable:
    """The first rows of a long table, with a note on the others."""
    more = len(table.rows) - _SHOWN
    if more <= 0:
        return table
    note = f"{more} more rows are in --html and --format json."
    return replace(table, rows=table.rows[:_SHOWN], notes=(*table.notes, note))


def compare(before: str | Path, after: str | Path, metrics: Sequence[str] = ()) -> CompareResult:
    """Compare two runs of cells with the same specifications; each is a run folder or a baseline.

    `metrics` replace the default ones. Raises UsageError for what is neither, for an unknown
    metric, and for two without a common cell.
    """
    was, now = (_values(source, metrics) for source in (before, after))
    if set(was.cells).isdisjoint(now.cells):
        raise UsageError(
            f"{str(before)!r} ({was.name!r}) and {str(after)!r} ({now.name!r}) have no cell with "
            "the same specification; compare runs of one suite."
        )
    if set(was.metrics).isdisjoint(now.metrics):
        raise UsageError(
            f"{str(before)!r} has {', '.join(was.metrics)}, and {str(after)!r} "
            f"{', '.join(now.metrics)}: no metric is in both; choose others with --metrics."
        )
    changes = find_difference(was, now)
    ratios = metric_ratio(was, now)
    words = ["sysid-bench", "compare", str(before), str(after)]
    words += ["--metrics", ",".join(metrics)] if metrics else []
    made = _result(str(before), str(after), changes, ratios)
    return replace(made, command=shlex.join(words))


def _values(source: str | Path, metrics: Sequence[str]) -> RunValues:
    if is_file(Path(source)):
        return read_baseline(source).run
    return values_of_run(open_run(source), tuple(metrics) or _NAMES)


def _result(
    before: str, after: str, changes: RunDifference, ratios: Sequence[MetricRatio]
) -> CompareResult:
    largest = listing.largest_first(changes.cells)
    compared = len(set(changes.before.cells).intersection(changes.after.cells))
    changed = len({change.cell for change in changes.cells})
    return CompareResult(
        before=before,
        after=after,
        cells=compared,
        equal=compared - changed - len(changes.open),
        metrics=[asdict(ratio) for ratio in ratios],
        changes=[listing.change_json(changes, change) for change in largest],
        parameters=[listing.parameter_json(change) for change in changes.parameters],
        appeared=list(changes.appeared),
        vanished=list(changes.vanished),
        open=list(changes.open),
        origin=list(changes.origin),
        listings=(_ratio_listing(ratios), *_change_listings(changes, largest)),
        notes=tuple(_notes(after, changes, compared, changed)),
        command="",
    )


def _change_listings(changes: RunDifference, largest: list[Change]) -> Iterator[TextTable]:
    """Yield the table of changes of cells and that of parameters, where there are any."""
    if largest:
        title = "Changes of cells beyond their tolerance, the largest first"
        yield listing.change_table("changes", title, changes, largest, None)
    if changes.parameters:
        yield listing.parameter_table(changes, None)


def _ratio_listing(ratios: Sequence[MetricRatio]) -> TextTable:
    rows = tuple(map(_ratio_row, ratios))
    notes = (
        "Ratio: median over robots of the mean log ratio of their cells. Lower, higher: robots. p: "
        "Wilcoxon's signed-rank test over robots, with the smallest p that so many robots allow. "
        f"Verdict: equivalent within {MARGIN:.0%}; none without an interval (fewer than six "
        "robots). Left out: cells with a value that is zero, rounding or absent.",
    )
    return TextTable("metrics", "Metrics after over before", _HEAD, rows, notes)


def _ratio_row(ratio: MetricRatio) -> tuple[str, ...]:
    interval = "-" if ratio.low is None else f"{ratio.low:.4g} to {ratio.high:.4g}"
    return (
        ratio.metric, value_text(ratio.ratio), interval,
        str(ratio.robots), str(ratio.lower), str(ratio.higher),
        *(value_text(p) if ratio.robots else "-" for p in (ratio.p, ratio.smallest_p)),
        ratio.verdict or "-", str(ratio.cells), str(ratio.zeros),
    )  # fmt: skip


def _notes(after: str, changes: RunDifference, cells: int, changed: int) -> list[str]:
    counts = Counter(change.verdict for change in changes.cells)
    of = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
    first = f"{cells} cells in both, {changed} changed" + (f": {of}." if of else ".")
    lines = [first, *listing.cells_text(changes), *listing.origin_text(changes)]
    if is_file(Path(after)):  # a baseline holds no suite that could run
        return lines
    return [*lines, *_commands(after, changes)]


def _commands(after: str, changes: RunDifference) -> list[str]:
    """Commands that compute the cells with the largest changes again; nothing without any."""
    shown = listing.largest_first(changes.cells)[: listing.WORST_SHOWN]
    unique = dict.fromkeys(change.cell for change in shown)
    commands = [listing.cell_command(after, cell) for cell in unique]
    return ["\n".join(["reproduce:", *commands])] if commands else []
