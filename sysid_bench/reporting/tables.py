"""A table of results: one entry per group of cells and metric; failed cells stay visible."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from string import ascii_lowercase
from typing import Final

from sysid_bench.reporting.notation import Notation, notation
from sysid_bench.reporting.statistic import INTERVALS, STATISTICS
from sysid_bench.types import Metric

Key = tuple[str, ...]
METRIC: Final = "metric"
"""The last column field of a table with several metrics: its labels are their names."""

_DIRECTIONS: Final = {"lower": "lower is better", "higher": "higher is better"}


@dataclass(frozen=True)
class Entry:
    """One group of cells. `n` cells gave a value, `failures` counts the others by status,
    `missing` those that are ok but have no value of this metric."""

    value: float | None
    low: float | None
    high: float | None
    n: int
    failures: Mapping[str, int]
    missing: int = 0
    best: bool = False
    text: str = ""  # of a metric in words

    @property
    def n_failed(self) -> int:
        """Cells whose status is not ok."""
        return sum(self.failures.values())

    @property
    def label(self) -> str:
        """The text instead of a number: words of the cells, or the most frequent failure; empty
        where there is a number."""
        if self.text:
            return self.text
        if self.value is not None or not self.failures:
            return ""
        return max(self.failures, key=lambda kind: self.failures[kind])

    @property
    def note(self) -> str:
        """Count of the cells that the printed value or word does not cover; empty where none."""
        covered = {self.label} if self.label and not self.missing else set()
        if not set(self.failures) - covered and not (self.missing and (self.n or self.failures)):
            return ""
        counts = [f"{number} {kind}" for kind, number in self.failures.items()]
        counts += [f"{self.missing} without a value"] if self.missing else []
        lost = self.n_failed + self.missing
        return f"{lost} of {lost + self.n} cells give no number: {', '.join(counts)}."


@dataclass(frozen=True, eq=False)
class Table:
    """Entries by (row key, column key), in the order of first appearance; a key that never
    occurred has no entry. Keys hold one label per field; with several metrics the last label of a
    column is the name of its metric."""

    name: str
    title: str
    metrics: tuple[Metric, ...]
    stat: str
    interval: str
    row_fields: Key
    column_fields: Key
    rows: tuple[Key, ...]
    columns: tuple[Key, ...]
    entries: Mapping[tuple[Key, Key], Entry]
    notes: tuple[str, ...] = ()
    own_caption: str = ""  # where the columns are not one statistic of the metrics

    @property
    def metric(self) -> Metric:
        """The metric of a table that has one."""
        return self.metrics[0]

    @property
    def has_metric_columns(self) -> bool:
        """True where metrics are columns."""
        return METRIC in self.column_fields

    @property
    def has_figure(self) -> bool:
        """True where one axis can show all numbers."""
        return not self.has_metric_columns and not self.metric.text

    def metric_of(self, column: Key) -> Metric:
        """The metric of a column."""
        if not self.has_metric_columns:
            return self.metric
        return next(metric for metric in self.metrics if metric.name == column[-1])

    def column_labels(self, column: Key) -> Key:
        """Labels above a column, one per column field; metrics with unit and direction."""
        if self.has_metric_columns:
            metric = self.metric_of(column)
            return (*column[:-1], f"{metric.heading} {metric.arrow}".strip())
        return column

    def column_label(self, column: Key) -> str:
        """The labels above a column in one line; the title of the metric where there are none."""
        return " / ".join(self.column_labels(column)) or self.metric.title

    @property
    def caption(self) -> str:
        """Metric, unit, statistic and interval in one sentence."""
        if self.own_caption:
            return self.own_caption
        spread = f" with {INTERVALS[self.interval]}" if self.interval != "none" else ""
        if self.has_metric_columns:
            return f"{STATISTICS[self.stat].capitalize()}{spread}{self._legend}."
        if self.metric.text:
            return f"{self.metric.heading}."
        if self.metric.level == "repeats":
            ends = ", with 95 % bootstrap interval" if self.interval != "none" else ""
            return f"{self.metric.heading}: over all repeats and parameters{ends}."
        return f"{self.metric.heading}: {STATISTICS[self.stat]}{spread}."

    @property
    def _legend(self) -> str:
        """The arrows of the heads: "; ↓ lower is better"."""
        found = {metric.better: metric.arrow for metric in self.metrics}
        return "".join(f"; {found[b]} {text}" for b, text in _DIRECTIONS.items() if b in found)

    @cached_property
    def note_labels(self) -> dict[str, str]:
        """A letter for every note that an entry carries."""
        found = (self.entries[key].note for key in self.indices if key in self.entries)
        return {note: _letters(i) for i, note in enumerate(dict.fromkeys(filter(None, found)))}

    @property
    def indices(self) -> list[tuple[Key, Key]]:
        """Every (row, column), row by row."""
        return [(row, column) for row in self.rows for column in self.columns]

    def entry(self, row: Key, column: Key) -> Entry | None:
        """The entry of a row and column, None where no cell was planned."""
        return self.entries.get((row, column))

    @cached_property
    def column_notation(self) -> dict[Key, Notation]:
        """Notation of each column: the same where columns differ by the estimator alone."""
        values: dict[Key, list[float | None]] = {}
        digits: dict[Key, int] = {}
        for (_, column), entry in self.entries.items():
            group = self._without_estimator(column)
            values.setdefault(group, []).append(entry.value)
            digits[group] = 0 if self.stat == "count" else self.metric_of(column).digits
        shared = {group: notation(numbers, digits[group]) for group, numbers in values.items()}
        return {column: shared[self._without_estimator(column)] for column in self.columns}

    def _without_estimator(self, column: Key) -> Key:
        """The label that columns compared with each other share: all but the estimator."""
        pairs = zip(self.column_fields, column, strict=True)
        return tuple(part for field, part in pairs if field != "estimator")


def _letters(i: int) -> str:
    return (_letters(i // 26 - 1) if i >= 26 else "") + ascii_lowercase[i % 26]
