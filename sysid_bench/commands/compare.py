"""Verb `compare`: two runs, or a run and a baseline."""

import json
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.commands.request import OK, Request, argument, option, python_function
from sysid_bench.commands.result import HIDDEN, Result, value_text
from sysid_bench.commands.values import parse_metrics
from sysid_bench.errors import UsageError, unknown_name

if TYPE_CHECKING:
    from sysid_bench.harness.comparison.run_difference import Change, MetricRatio, RunDifference
    from sysid_bench.harness.comparison.run_values import RunValues
    from sysid_bench.reporting.text_table import TextTable

FORMATS: Final = ("md", "csv", "latex", "json")
_SHOWN: Final = 15
_HEAD: Final = (
    "metric", "after / before", "95 % interval", "robots", "lower", "higher", "p",
    "smallest p", "verdict", "cells", "left out",
)  # fmt: skip


def metrics_option() -> Any:
    """--metrics, in place of those that are compared."""
    return option(
        "Metrics in place of the default ones.",
        default=(), metavar="NAME,...", parse=parse_metrics, complete="metrics", separated=True,
    )  # fmt: skip


class Compare(Request["CompareResult"]):
    """Compare two runs of a suite; each is a run folder or a baseline.

    Metrics as ratios over robots with intervals, cells that changed beyond their tolerance,
    appeared or vanished, and what differs in code and libraries.
    """

    has_json = False

    before: str | Path = argument("A", complete="runs files")
    after: str | Path = argument("B", complete="runs files")
    metrics: Sequence[str] = metrics_option()

    def run(self) -> "CompareResult":
        """Compare two runs of cells with the same specifications; each is a run folder or a
        baseline.

        `metrics` replace the default ones. Raises UsageError for what is neither, for an unknown
        metric, and for two without a common cell.
        """
        from sysid_bench.commands.run_folder import open_run
        from sysid_bench.evaluation.intervals import at_level
        from sysid_bench.harness.comparison.run_difference import find_difference, metric_ratio
        from sysid_bench.harness.comparison.run_values import with_ids_of
        from sysid_bench.input_files import is_file

        before, after = str(self.before), str(self.after)
        was, now = (_values(source, self.metrics) for source in (before, after))
        if set(with_ids_of(was, now).cells).isdisjoint(now.cells):
            raise UsageError(
                f"{before!r} ({was.name!r}) and {after!r} ({now.name!r}) have no cell with "
                "the same specification or labels; compare runs of one suite."
            )
        if set(was.metrics).isdisjoint(now.metrics):
            raise UsageError(
                f"{before!r} has {', '.join(was.metrics)}, and {after!r} "
                f"{', '.join(now.metrics)}: no metric is in both; choose others with --metrics."
            )
        words = ["sysid-bench", "compare", before, after]
        words += ["--metrics", ",".join(self.metrics)] if self.metrics else []
        # A baseline does not state a level; that of a run is frozen in its suite.
        level = None if is_file(Path(after)) else open_run(after).suite.confidence
        with at_level(level):
            changes, ratios = find_difference(was, now), metric_ratio(was, now)
            return _result((before, after), changes, ratios, shlex.join(words))


class CompareCommand(Compare):
    form: str | None = option(
        "md, csv, latex or json; default: drawn, piped as md.",
        default=None, flags="--format", complete="formats",
    )  # fmt: skip
    html: Path | None = option(
        "Write a page with all changes.", default=None, path="new file", complete="files"
    )

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.terminal import print_table

        result = self.run()
        if self.html is not None:
            result.write_html(self.html)
        print_table(result.text(self.form or "md"), self.form)
        return OK


compare = python_function(Compare, "compare")


@dataclass(frozen=True, eq=False, repr=False)
class CompareResult(Result):
    """Comparison of `after` with `before`: `metrics` as ratios over robots, `changes` of single
    cells beyond the tolerances (the largest first), changed true base parameters and `models`
    (quantities of joints), `drifts` of metrics within their tolerance, cells that only one has, and
    `origin`: what differs in code, libraries and machine."""

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
    models: list[dict[str, Any]]
    drifts: list[dict[str, Any]]
    listings: "tuple[TextTable, ...]" = field(metadata=HIDDEN)
    notes: tuple[str, ...] = field(metadata=HIDDEN)
    command: str = field(metadata=HIDDEN)

    def summary(self) -> str:
        """Tables in Markdown, the first rows of long ones, and what else differs."""
        from sysid_bench.reporting.text_table import to_markdown

        parts = []
        for table in self.listings:
            more = len(table.rows) - _SHOWN
            if more > 0:
                note = f"{more} more rows are in --html and --format json."
                table = replace(table, rows=table.rows[:_SHOWN], notes=(*table.notes, note))
            parts.append(to_markdown(table).rstrip())
        return "\n\n".join([*parts, *self.notes])

    def text(self, form: str) -> str:
        """The table of metrics as "csv" or "latex"; all that was compared as "md" or "json"."""
        from sysid_bench.commands.paper import text_of
        from sysid_bench.reporting.latex import Origin

        if form not in FORMATS:
            raise unknown_name("format", form, FORMATS)
        if form == "json":
            return json.dumps(self.to_dict(), indent=2) + "\n"
        if form == "md":
            return self.summary() + "\n"
        command = f"{self.command} --format latex"
        return text_of(self.listings[0], form, Origin(self.after, "", command))

    def write_html(self, file: str | Path) -> None:
        """Write a page that is complete in itself, with a filter over the changed cells."""
        from sysid_bench.reporting.html import write_compare_page

        write_compare_page(Path(file), f"{self.before} -> {self.after}", self.listings, self.notes)


def _values(source: str, metrics: Sequence[str]) -> "RunValues":
    from sysid_bench.commands.baseline import read_baseline, values_of_run
    from sysid_bench.commands.run_folder import open_run
    from sysid_bench.harness.comparison.run_values import METRICS_COMPARED
    from sysid_bench.input_files import is_file

    if is_file(Path(source)):
        return read_baseline(source).run
    return values_of_run(open_run(source), tuple(metrics) or (*METRICS_COMPARED, "seconds"))


def _result(
    sources: tuple[str, str],
    changes: "RunDifference",
    ratios: "Sequence[MetricRatio]",
    command: str,
) -> CompareResult:
    from sysid_bench.commands.changes import (
        change_json,
        change_tables,
        common_fields,
        largest_first,
    )

    largest = largest_first(changes.cells)
    compared = len(set(changes.before.cells).intersection(changes.after.cells))
    changed = len({change.cell for change in changes.cells})
    title = "Changes of cells beyond their tolerance, the largest first"
    counts = Counter(change.verdict for change in changes.cells)
    of = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
    first = f"{compared} cells in both, {changed} changed" + (f": {of}." if of else ".")
    return CompareResult(
        before=sources[0],
        after=sources[1],
        cells=compared,
        equal=compared - changed - len(changes.open),
        metrics=[asdict(ratio) for ratio in ratios],
        changes=[change_json(changes.before, change) for change in largest],
        **common_fields(changes),
        listings=(_ratio_table(ratios), *change_tables(title, changes, largest, None)),
        notes=(first, *_notes(sources[1], changes, largest)),
        command=command,
    )


def _ratio_table(ratios: "Sequence[MetricRatio]") -> "TextTable":
    from sysid_bench.evaluation.intervals import with_level
    from sysid_bench.harness.comparison.run_difference import MARGIN
    from sysid_bench.reporting.text_table import TextTable

    rows = tuple(
        (
            ratio.metric, value_text(ratio.ratio),
            "-" if ratio.low is None else f"{ratio.low:.4g} to {ratio.high:.4g}",
            str(ratio.robots), str(ratio.lower), str(ratio.higher),
            *(value_text(p) if ratio.robots else "-" for p in (ratio.p, ratio.smallest_p)),
            ratio.verdict or "-", str(ratio.cells), str(ratio.zeros),
        )
        for ratio in ratios
    )  # fmt: skip
    note = (
        "Ratio: median over robots of the mean log ratio of their cells. Lower, higher: robots. p: "
        "Wilcoxon's signed-rank test over robots, with the smallest p that so many robots allow. "
        f"Verdict: of a margin of {MARGIN:.0%}, from p-values that are corrected over "
        "all of this table; none without an interval (fewer than six robots). Left out: cells with "
        "a value that is zero, rounding or absent."
    )
    return TextTable(
        "metrics", "Metrics after over before", tuple(map(with_level, _HEAD)), rows, (note,)
    )


def _notes(after: str, changes: "RunDifference", largest: "Sequence[Change]") -> list[str]:
    """Sentences on other cells and versions, and the commands that compute the cells with the
    largest changes again."""
    from sysid_bench.commands.changes import WORST_SHOWN, cells_text, drift_text, origin_text
    from sysid_bench.commands.run_folder import rerun_command
    from sysid_bench.input_files import is_file

    lines = [*drift_text(changes), *cells_text(changes), *origin_text(changes)]
    shown = dict.fromkeys(change.cell for change in largest[:WORST_SHOWN])
    if shown and not is_file(Path(after)):  # a baseline holds no suite that could run
        lines.append("\n".join(["reproduce:", *(rerun_command(after, cell) for cell in shown)]))
    return lines
