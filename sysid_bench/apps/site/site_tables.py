"""Tables of the pages of a site: ranks, medians by robot and by method, with and without noise
apart."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from sysid_bench.apps.site.suite_version import SuiteVersion
from sysid_bench.evaluation.intervals import LEVEL_TEXT
from sysid_bench.metrics import METRICS
from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.ranking import Ranking
from sysid_bench.reporting.ranking_tables import verdict_table
from sysid_bench.reporting.selection import label
from sysid_bench.reporting.tables import Key, Table

if TYPE_CHECKING:
    import pandas as pd

_RANK = "rank"


def rank_table(ranking: Ranking) -> Table:
    """Rank of each method that has one, with its interval, for a figure."""
    verdicts = verdict_table(ranking)
    entries = _ranks(verdicts)
    return Table(
        name=f"{ranking.name}-ranks",
        title=f"{ranking.title}: ranks",
        metrics=tuple(metric for metric in verdicts.metrics if metric.name == _RANK),
        stat="median",
        interval="ci95",
        row_fields=("estimator",),
        column_fields=(),
        rows=tuple(row for row, _ in entries),
        columns=((),),
        entries=entries,
        own_caption=f"Rank and its {LEVEL_TEXT} interval over robots drawn again; 1 is the best.",
    )


def _ranks(verdicts: Table) -> dict[tuple[Key, Key], Any]:
    """Entry of each method that has a rank."""
    found = {row: verdicts.entry(row, (_RANK,)) for row in verdicts.rows}
    return {(row, ()): entry for row, entry in found.items() if entry and entry.value is not None}


def robot_tables(version: SuiteVersion, robot: str) -> Iterator[Table]:
    """Median error of each method on a robot, by plant."""
    for title, cells in _halves(version):
        chosen = cells[cells["robot"].map(label) == robot]
        yield from _scores(version, chosen, title, ("estimator",))


def method_tables(version: SuiteVersion, method: str) -> Iterator[Table]:
    """Median error of a method on each robot, by plant."""
    for title, cells in _halves(version):
        chosen = cells[cells["estimator"].map(label) == method]
        yield from _scores(version, chosen, title, ("robot",))


def median_tables(version: SuiteVersion) -> Iterator[Table]:
    """Median error of each method on each robot."""
    for title, cells in _halves(version):
        yield from _scores(version, cells, title, ("robot",), ("estimator",))


def _halves(version: SuiteVersion) -> Iterator[tuple[str, "pd.DataFrame"]]:
    yield "Data with noise", version.with_noise()
    yield "Exact data: errors are rounding", version.exact()


def _scores(
    version: SuiteVersion,
    cells: "pd.DataFrame",
    title: str,
    rows: Sequence[str],
    columns: Sequence[str] = ("plant",),
) -> Iterator[Table]:
    """A table of the version's metric; none for no cells."""
    metric = version.score
    if len(cells) and metric.level == METRICS["torque_error"].level and not metric.text:
        spec = {
            "name": "scores",
            "title": title,
            "rows": list(rows),
            "columns": [name for name in columns if name in cells.columns],
            "cells": {"metric": metric.name, "interval": "iqr"},
        }
        yield build_table(cells, spec, metrics=version.first.metrics)
