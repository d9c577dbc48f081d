"""Notes below a table: what its numbers pool, and why values are missing."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from sysid_bench.evaluation.intervals import REPEATS
from sysid_bench.metrics import REASONS
from sysid_bench.reporting.main_effects import effect_notes
from sysid_bench.reporting.notation import ABSENT
from sysid_bench.reporting.selection import SWEEPABLE
from sysid_bench.reporting.table_entries import Entries
from sysid_bench.reporting.table_layout import TableLayout
from sysid_bench.types import Metric
from sysid_bench.words import INTERVAL_LIMITS, OF_REPEATS, STD_FROM

PLANT: Final = "plant"
OF_PLANTS: Final = ("simulation", "noise", "pipeline")
"""Settings that a plant may bring along, as realism levels do."""

if TYPE_CHECKING:
    import pandas as pd


def table_notes(cells: "pd.DataFrame", layout: TableLayout, entries: Entries) -> Iterator[str]:
    """Sentences below a table."""
    yield from _pooling(cells, layout)
    yield from _one_simulator(cells)
    for metric in layout.metrics:
        yield from _names(cells, layout, metric)
        yield from _reasons(cells, metric)
    yield from _too_few(layout, entries)
    yield from _limits(cells, layout)
    if layout.effects:
        yield from effect_notes(dict(entries), (layout.rows, layout.columns))


def _limits(cells: "pd.DataFrame", layout: TableLayout) -> Iterator[str]:
    """Contents and limits of the intervals of each kind, a sentence each."""
    kinds = cells[STD_FROM].unique() if STD_FROM in layout.fields else ()
    yield from (f"{kind}: {INTERVAL_LIMITS[kind]}." for kind in kinds if kind in INTERVAL_LIMITS)


def _pooling(cells: "pd.DataFrame", layout: TableLayout) -> Iterator[str]:
    """Fields that differ between the cells of an entry: its statistic compares unlike settings.
    Settings that plants bring along are not counted beside the plants."""
    swept = [field for field in _swept(cells) if field not in layout.fields]
    counts = {field: _pooled_values(cells, field, layout) for field in swept}
    pooled = [f"{count} of {field}" for field, count in counts.items() if count > 1]
    if pooled:
        yield f"Each number pools different settings: {', '.join(pooled)}."


def _pooled_values(cells: "pd.DataFrame", field: str, layout: TableLayout) -> int:
    """Largest number of values of a field in an entry, and for one plant where plants set it."""
    shown = [name for name in layout.fields if name in cells.columns]
    return _most_values(cells, field, [*shown, *([PLANT] if field in OF_PLANTS else ())])


def _most_values(cells: "pd.DataFrame", field: str, groups: list[str]) -> int:
    """Largest number of values of a field among the cells that agree in other fields."""
    keys = [key for key in dict.fromkeys(groups) if key in cells.columns]
    if not keys:
        return int(cells[field].nunique())
    return int(cells.groupby(keys, dropna=False)[field].nunique().max())


def _one_simulator(cells: "pd.DataFrame") -> Iterator[str]:
    """Rows whose plant is integrated as the models of methods that simulate are."""
    if "same_simulator" not in cells.columns:
        return
    same = cells["same_simulator"].eq(True)
    if same.any():
        yield (
            f"Plant and candidate models share step and integrator in {same.sum()} of "
            f"{len(cells)} cells: errors of methods that simulate are too small there."
        )


def _swept(cells: "pd.DataFrame") -> list[str]:
    return [field for field in SWEEPABLE if field in cells.columns]


def _names(cells: "pd.DataFrame", layout: TableLayout, metric: Metric) -> list[str]:
    """Names behind a count, from the column `<metric>_names`."""
    column = f"{metric.name}_names"
    if column not in cells.columns:
        return []
    named = cells[~cells[column].isin(["", "none"])].to_dict("records")
    rows = ((" / ".join(str(row[field]) for field in layout.fields), row[column]) for row in named)
    return sorted({f"{place}: {metric.title.lower()}: {names}." for place, names in rows})


def _reasons(cells: "pd.DataFrame", metric: Metric) -> Iterator[str]:
    """Reasons of missing values, with the number of cells."""
    column = f"{REASONS}.{metric.name}"
    if column in cells.columns:
        given = cells.loc[~cells[column].isin(["", "none"]), column].value_counts()
        for why, n in given.items():
            yield f"{metric.title}: {n} cells without a value: {why}."


def _too_few(layout: TableLayout, entries: Entries) -> Iterator[str]:
    """Reason why a metric of all repeats is missing."""
    needs = _needs_of_repeats(layout)
    if needs and any(entry.missing for entry in entries.values() if entry.value is None):
        bound = ", or no noise of the torque and so no bound" if "noise" in needs else ""
        yield f"{ABSENT}: fewer than {REPEATS.fewest} repeats, no noise at all{bound}."


def _needs_of_repeats(layout: TableLayout) -> set[str]:
    """Needs of the metrics of all repeats; empty where the table has no such metric."""
    repeated = (metric.needs for metric in layout.metrics if metric.level in OF_REPEATS)
    return set().union(*repeated)
