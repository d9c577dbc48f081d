"""Median errors of methods by plant, and of recorded beside simulated robots."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.figures import EXACT
from sysid_bench.reporting.selection import label
from sysid_bench.reporting.tables import Table
from sysid_bench.words import RECORDED

if TYPE_CHECKING:
    import pandas as pd

SCORE: Final = "torque_error"
_MEDIAN: Final = {"metric": SCORE, "interval": "iqr"}


def plant_tables(cells: "pd.DataFrame") -> Iterator[Table]:
    """Median error of each method by plant, where cells have several plants and an error."""
    if _is_scored(cells) and "plant" in cells and cells["plant"].map(label).nunique() > 1:
        shape = {"name": "levels", "rows": ["estimator"], "columns": ["plant"]}
        yield build_table(cells, {**shape, "cells": _MEDIAN})


def source_tables(cells: "pd.DataFrame") -> Iterator[Table]:
    """Median error of each method on recorded and on simulated data with noise, of the robots that
    have both; nothing where no robot has."""
    if not _is_scored(cells) or not {"plant", "noise"} <= set(cells.columns):
        return
    is_recorded = cells["plant"].map(label) == RECORDED
    is_noisy = is_recorded | (cells["noise"].map(label) != EXACT)
    kept = cells[is_noisy & cells[SCORE].notna()]
    data = is_recorded[kept.index].map({True: RECORDED, False: "simulated"})
    lines = kept.assign(data=data)
    sources = lines.groupby("robot")["data"].nunique()
    lines = lines[lines["robot"].isin(sources.index[sources > 1])]
    if len(lines):
        spec: dict[str, Any] = {
            "name": "recorded-and-simulated",
            "title": "Recorded and simulated",
            "rows": ["robot", "estimator"],
            "columns": ["data"],
        }
        yield build_table(lines, {**spec, "cells": _MEDIAN})


def _is_scored(cells: "pd.DataFrame") -> bool:
    return SCORE in cells and bool(cells[SCORE].notna().any())
