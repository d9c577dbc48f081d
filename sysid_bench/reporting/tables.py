"""A table of results: one entry per group of cells and metric; failed cells stay visible."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby, product, starmap
from operator import itemgetter
from string import ascii_lowercase
from types import MappingProxyType
from typing import Final

from sysid_bench.evaluation.intervals import level_text, with_level
from sysid_bench.types import Metric
from sysid_bench.words import OF_REPEATS

ABSENT: Final = "\N{EN DASH}"  # stands for a number that was not computed

# Beyond these a reader counts zeros instead of reading digits.
_SMALLEST, _LARGEST, _WIDEST_SPAN, _LARGEST_WHOLE = 1e-3, 1e5, 1e4, 1e9
_SHARED_SPAN: Final = 1e3  # of values with one power of ten
_TIMES = "\N{MULTIPLICATION SIGN}"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Notation:
    """`digits` significant ones (0: whole numbers), never more than `decimals` after the point."""

    digits: int
    scientific: bool = False
    decimals: int = 0
    low: float = 0.0  # smallest and largest size of the values that are not zero
    high: float = 0.0

    def text(self, value: float) -> str:
        """A number in plain text: "0.0123", "3.00e-13", "0"; never "-0.00"."""
        if not math.isfinite(value):
            return str(value)
        if value == 0:
            return "0"
        if self.scientific:
            # Python pads exponents to two digits; 1e-08 and 1e-8 are one number.
            mantissa, _, exponent = f"{value:.{max(self.digits, 1) - 1}e}".partition("e")
            return f"{mantissa}e{int(exponent)}"
        text = f"{value:.{self._decimals_of(value)}f}"
        return "0" if float(text) == 0 else text

    def _decimals_of(self, value: float) -> int:
        """Digits after the point; a number that should be whole but is not (a median) has one."""
        if self.digits == 0:
            return int(value != round(value))
        wanted = self.digits - 1 - _exponent(value, self.digits)
        return min(max(wanted, 0), self.decimals)

    @property
    def scale(self) -> int | None:
        """The power of ten that all values can share; None where they need none, or differ by so
        much that the smallest would lose its digits."""
        if not self.scientific or self.high > _SHARED_SPAN * self.low:
            return None
        return _exponent(self.high, max(self.digits, 1))

    def without_scale(self) -> "Notation":
        """Notation of the same values over ten to the power that they share, in plain decimals."""
        if self.scale is None:
            return self
        low = self.low / 10.0**self.scale
        return Notation(self.digits, decimals=max(self.digits - 1 - _exponent(low, self.digits), 0))

    def html_text(self, value: float) -> str:
        """The same number for the screen, with a raised power of ten."""
        mantissa, e, exponent = self.text(value).partition("e")
        return f"{mantissa}{_TIMES}10{exponent.translate(_SUPERSCRIPTS)}" if e else mantissa


def notation(values: Iterable[float | None], digits: int) -> Notation:
    """Notation for all values of a column; scientific where they span decades."""
    # Zeros print as 0 in any notation; neither they nor missing values count.
    sizes = [abs(v) for v in filter(None, values) if math.isfinite(v)]
    if not sizes:
        return Notation(digits, decimals=max(digits - 1, 0))
    low, high = min(sizes), max(sizes)
    if digits == 0:
        return Notation(3, True) if high >= _LARGEST_WHOLE else Notation(0)
    decimals = max(digits - 1 - _exponent(low, digits), 0)
    has_many_zeros = low < _SMALLEST or high >= _LARGEST or high / low > _WIDEST_SPAN
    return Notation(digits, has_many_zeros, decimals, low, high)


def _exponent(value: float, digits: int) -> int:
    """The power of ten after rounding to `digits`: 9.999 is 1.00e1."""
    return int(f"{value:.{digits - 1}e}".partition("e")[2])


STATISTICS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "median": "median",
        "mean": "mean",
        "min": "smallest value",
        "max": "largest value",
        "count": "number of cells with a value",
    }
)
INTERVALS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "none": "no interval",
        "iqr": "interquartile range",
        "std": "plus and minus one standard deviation",
        "range": "smallest and largest value",
        "ci95": "95 % bootstrap interval over repeats",
    }
)

Key = tuple[str, ...]
METRIC: Final = "metric"
"""The last column field of a table with several metrics: its labels are their names."""

_BOLD: Final = (
    "Bold: the best number of those that compete, and all that print alike; not a test, which "
    "rankings have."
)
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
    def interval(self) -> tuple[float, float] | None:
        """Both ends of the interval; None where there is none."""
        return None if self.low is None or self.high is None else (self.low, self.high)

    @property
    def label(self) -> str:
        """The text instead of a number: words of the cells, or the most frequent failure; empty
        where there is a number."""
        if self.value is not None:
            return ""
        return self.text or max(self.failures, key=self.failures.__getitem__, default="")

    @property
    def note(self) -> str:
        """Count of the cells that the printed value or word does not cover; empty where none."""
        if self._is_complete:
            return ""
        kinds = {**self.failures, "without a value": self.missing}
        counts = [f"{number} {kind}" for kind, number in kinds.items() if number]
        lost = self.n_failed + self.missing
        return f"{lost} of {lost + self.n} cells give no number: {', '.join(counts)}."

    @property
    def _is_complete(self) -> bool:
        """True where the printed value or word is that of every cell."""
        if self.missing:
            return not (self.n or self.failures)
        return set(self.failures) <= {self.label}


NO_ENTRY: Final = Entry(None, None, None, 0, {})
"""Entry of a group that has no cell."""


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
    repeats: int = 0  # of each setting, where the cells have them
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

    @property
    def rows_by_group(self) -> list[list[Key]]:
        """Rows that share their first label; a table of one row field is one group."""
        if len(self.row_fields) < 2:
            return [list(self.rows)]
        return [list(group) for _, group in groupby(self.rows, key=itemgetter(0))]

    def metric_of(self, column: Key) -> Metric:
        """The metric of a column."""
        return self._metrics_by_name[column[-1]] if self.has_metric_columns else self.metric

    @cached_property
    def _metrics_by_name(self) -> dict[str, Metric]:
        return {metric.name: metric for metric in self.metrics}

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
    def description(self) -> str:
        """Metric, unit, statistic and interval in one sentence."""
        if self.own_caption:
            return self.own_caption
        if self.has_metric_columns:
            return f"{STATISTICS[self.stat].capitalize()}{self._spread}{self._legend}."
        return f"{self.metric.heading}{self._statistic}."

    @property
    def repeat_notes(self) -> tuple[str, ...]:
        """Sentences on the repeats, and on what bold numbers are."""
        repeats = (f"{self.repeats} repeats of each setting.",) if self.repeats > 1 else ()
        is_marked = any(entry.best for entry in self.entries.values())
        return (*repeats, *((_BOLD,) if is_marked else ()))

    @property
    def _statistic(self) -> str:
        """Statistic of one metric: ": median with interquartile range"; empty for words."""
        if self.metric.text:
            return ""
        if self.metric.level not in OF_REPEATS:
            return f": {STATISTICS[self.stat]}{self._spread}"
        if self.metric.level == "interval-repeats":
            return f", with {level_text()} interval" if self.interval != "none" else ""
        # A figure of all repeats is not a statistic of cells: it has an interval of its own.
        ends = f", with {level_text()} bootstrap interval" if self.interval != "none" else ""
        return f": over all repeats and parameters{ends}"

    @property
    def _spread(self) -> str:
        return f" with {with_level(INTERVALS[self.interval])}" if self.interval != "none" else ""

    @property
    def _legend(self) -> str:
        """The arrows of the heads: "; ↓ lower is better"."""
        found = {metric.better: metric.arrow for metric in self.metrics}
        return "".join(f"; {found[b]} {text}" for b, text in _DIRECTIONS.items() if b in found)

    @cached_property
    def note_labels(self) -> dict[str, str]:
        """A letter for every note that an entry carries."""
        # Letters in the order in which a reader meets the notes.
        planned = filter(None, starmap(self.entry, self.indices))
        notes = dict.fromkeys(entry.note for entry in planned)
        return {note: _letters(i) for i, note in enumerate(filter(None, notes))}

    @property
    def indices(self) -> list[tuple[Key, Key]]:
        """Every (row, column), row by row."""
        return list(product(self.rows, self.columns))

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
            # All counts are whole numbers, whatever the digits of the metric.
            digits[group] = 0 if self.stat == "count" else self.metric_of(column).digits
        shared = {group: notation(numbers, digits[group]) for group, numbers in values.items()}
        return {column: shared[self._without_estimator(column)] for column in self.columns}

    def _without_estimator(self, column: Key) -> Key:
        """The label that columns compared with each other share: all but the estimator."""
        pairs = zip(self.column_fields, column, strict=True)
        return tuple(part for field, part in pairs if field != "estimator")


def _letters(i: int) -> str:
    """Letters that count as columns of a spreadsheet do: a, b, ..., z, aa, ab."""
    return (_letters(i // 26 - 1) if i >= 26 else "") + ascii_lowercase[i % 26]
