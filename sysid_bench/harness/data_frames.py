"""Data frames of rows: one of cells, and long ones of parameters and joints."""

import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import NoneType
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.metrics import METRICS, names_of
from sysid_bench.types import Row
from sysid_bench.words import COVERAGE, JOINT, LABELS, PARAMETER, STD_FROM, VERDICT

if TYPE_CHECKING:
    import pandas as pd

_JOINT_COLUMNS: Final = {
    "name": JOINT,
    **{METRICS[name].key: name for name in names_of("joint")},
}
_TABLE_OF: Final[Mapping[str, str]] = {"parameters": "parameters_table", "joints": "joints"}
"""Field of a row by the frame that its entries make."""
FIRST: Final[Mapping[str, tuple[str, ...]]] = {
    "cells": ("id", "experiment", *LABELS, "repeat", "status", "reason"),
    "parameters": (
        *("id", "body", "name", "true", "estimate", "std", "std_from", "identifiable"),
        *("base_error", "bound", "bound_encoders"),
    ),
    "joints": ("id", "name"),
}
"""Columns that a frame has in any case, by its name."""

ReadFrame = Callable[[str, Collection[str] | None], "pd.DataFrame"]
"""(frame, fields or None for all) -> the frame with the columns of those fields that it has."""


@dataclass(frozen=True, eq=False)
class Frames:
    """`cells` has a line per row; `parameters` and `joints` have one per parameter or joint of the
    cell `id`. Each is read when it is used first. `fields`: the fields of `cells`, and of what is
    made of them, where these are not all: lines by joint repeat those of their cell."""

    read: ReadFrame
    fields: frozenset[str] | None = None

    @cached_property
    def cells(self) -> "pd.DataFrame":
        """One line per row."""
        always = {"id", "status", "estimator", COVERAGE}
        return self.read("cells", None if self.fields is None else self.fields | always)

    @cached_property
    def parameters(self) -> "pd.DataFrame":
        """One line per cell and parameter."""
        return self.read("parameters", None)

    @cached_property
    def joints(self) -> "pd.DataFrame":
        """One line per cell and joint."""
        return self.read("joints", None)

    @cached_property
    def by_parameter(self) -> "pd.DataFrame":
        """`cells` with a line per parameter (m, ..., fc) and its verdict; a cell without any has a
        line for each parameter of the others."""
        names = {"name": PARAMETER, "identifiable": VERDICT}
        verdicts = self.read("parameters", ["id", *names]).rename(columns=names)
        return self._merged(verdicts, PARAMETER)

    @cached_property
    def by_value(self) -> "pd.DataFrame":
        """`cells` with a line for each parameter (body.name), its estimate and verdict."""
        columns = ["id", "body", "name", "estimate", "identifiable"]
        values = self.read("parameters", columns)
        names = (values["body"].astype(str) + "." + values["name"].astype(str)).rename(PARAMETER)
        values = values.rename(columns={"identifiable": VERDICT}).drop(columns=["body", "name"])
        found: pd.DataFrame = self.cells.merge(values.assign(**{PARAMETER: names}), on="id")
        return found

    @cached_property
    def by_joint(self) -> "pd.DataFrame":
        """`cells` with a line per joint and its errors; a cell without any has a line for each
        joint of the others."""
        names = {
            key: name
            for key, name in _JOINT_COLUMNS.items()
            if self.fields is None or name in self.fields | {JOINT}
        }
        errors = self.read("joints", ["id", *names]).rename(columns=names)
        return self._merged(errors.reindex(columns=["id", *names.values()]), JOINT)

    def _merged(self, entries: "pd.DataFrame", label: str) -> "pd.DataFrame":
        """`cells` with a line for each line of `entries` (id, label, ...), in order."""
        import pandas as pd

        cells = self.cells.reset_index(names="order")
        without = cells[~cells["id"].isin(entries["id"])]
        values = pd.DataFrame({label: entries[label].unique() if len(entries) else [None]})
        parts = [cells.merge(entries, on="id"), without.merge(values, how="cross")]
        lines = pd.concat([part for part in parts if len(part)] or parts)
        return lines.sort_values("order", kind="stable", ignore_index=True).drop(columns="order")

    def _columns(self, metric: str) -> list[str]:
        """The columns of `cells` with a metric of intervals, one for each kind."""
        names = map(str, self.cells.columns)
        return [name for name in names if name.startswith(f"{metric}.")]

    @cached_property
    def by_std_from(self) -> "pd.DataFrame":
        """`cells` with a line per source of standard deviations, and its coverage. A cell that is
        not ok has a line for each source of its estimator in other cells, else for all sources;
        without any source (exact data) each cell has one line."""
        import pandas as pd

        prefix = f"{COVERAGE}."
        kinds = self._columns(COVERAGE)
        figures = names_of("interval")
        plain = self.cells.drop(columns=[c for name in figures for c in self._columns(name)])
        if not kinds:
            plain[STD_FROM], plain[COVERAGE] = "none", None
            return plain
        failed, estimator = self.cells["status"] != "ok", self.cells["estimator"]
        unknown = ~estimator.isin(estimator[self.cells[kinds].notna().any(axis=1)])
        lines = []
        for kind in kinds:
            coverage = self.cells[kind]
            alike = estimator.isin(estimator[coverage.notna()])
            line = plain[coverage.notna() | failed & (unknown | alike)].copy()
            line[STD_FROM] = kind.removeprefix(prefix)
            for name in figures:
                line[name] = self.cells.get(kind.replace(COVERAGE, name, 1))
            lines.append(line)
        return pd.concat(lines).sort_index(kind="stable", ignore_index=True)


def data_frames(rows: Iterable[Row]) -> Frames:
    """Return the frames of rows; nested tables of a cell become columns with dotted names."""
    rows = list(rows)
    tables = _TABLE_OF.values()
    cells = [
        frame_row({key: value for key, value in row.items() if key not in tables}) for row in rows
    ]
    made = {"cells": _frame(cells, FIRST["cells"])}
    for name, table in _TABLE_OF.items():
        made[name] = _frame(_long(rows, table), FIRST[name])

    def read(name: str, columns: Collection[str] | None) -> "pd.DataFrame":
        frame = made[name]
        return frame if columns is None else frame[columns_of(columns, frame.columns)]

    return Frames(read)


def columns_of(fields: Collection[str] | None, known: Iterable[str]) -> list[str]:
    """Return the known columns that fields have, nested ones several (`flat`); all for None."""
    if fields is None:
        return list(known)
    return [name for name in known if name in fields or name.partition(".")[0] in fields]


def _long(rows: Iterable[Row], field: str) -> Iterator[Row]:
    for row in rows:
        for entry in row.get(field) or ():
            yield {"id": row["id"], **frame_row(entry)}


def frame_row(row: Mapping[str, Any], prefix: str = "") -> Row:
    """Return a row without nesting: names with dots for mappings, JSON texts for lists."""
    fields: Row = {}
    for key, value in row.items():
        if isinstance(value, dict):
            fields |= frame_row(value, f"{prefix}{key}.")
        else:
            # Lists are stored as JSON, which DuckDB and people both read.
            fields[prefix + key] = json.dumps(value) if isinstance(value, list) else value
    return fields


def _frame(rows: Iterable[Row], first: tuple[str, ...]) -> "pd.DataFrame":
    import pandas as pd

    rows = list(rows)
    columns = dict.fromkeys((*first, *(key for row in rows for key in row)))
    return pd.DataFrame({column: _column([row.get(column) for row in rows]) for column in columns})


def _kinds(values: list[Any]) -> set[type]:
    """Types of the values of a column; beyond 64 bits the digits of a number are kept as a text."""
    kinds = set(map(type, values)) - {NoneType}
    is_large = int in kinds and any(abs(v) >= 2**63 for v in values if isinstance(v, int))
    return kinds | {str} if is_large else kinds


def _column(values: list[Any]) -> "pd.Series":
    """Give a column one type: Parquet does not mix texts and numbers."""
    import pandas as pd

    kinds = _kinds(values)
    if kinds == {int} and None not in values:
        return pd.Series(values, dtype="int64")
    if kinds and kinds <= {int, float}:
        return pd.Series(values, dtype="float64")
    if len(kinds) > 1:
        values = list(map(json_text, values))
    return pd.Series(values, dtype="object")


def json_text(value: Any) -> str | None:
    """Return a value as a column of texts holds it: texts and None as they are."""
    return value if value is None or isinstance(value, str) else json.dumps(value)
