"""Data frames of rows.

A row makes a part of each frame: one line of `cells`, and one of `parameters` and `joints` for each
entry of its tables. Frames are Arrow tables: in memory for few rows (`data_frames`), else in the
files of a run (`coverage.py`, `consolidate.py`).
"""

import json
import secrets
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from types import NoneType
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.harness.work.row_files import TABLES, columns_of, with_entries
from sysid_bench.metrics import METRICS, names_of
from sysid_bench.types import Row
from sysid_bench.words import COVERAGE, JOINT, LABELS, PARAMETER, STD_FROM, VERDICT

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow

FRAMES: Final = ("cells", "parameters", "joints")
_TABLE_OF: Final = {"parameters": "parameters_table", "joints": "joints"}
"""Field of a row by the frame that its entries make."""
_FIRST: Final[Mapping[str, tuple[str, ...]]] = {
    "cells": ("id", "experiment", *LABELS, "repeat", "status", "reason"),
    "parameters": (
        *("id", "body", "name", "true", "estimate", "std", "std_from", "identifiable"),
        *("base_error", "bound", "bound_encoders"),
    ),
    "joints": ("id", "name"),
}
"""Columns that a frame has in any case."""
_JOINT_COLUMNS: Final = {"name": JOINT, **{METRICS[name].key: name for name in names_of("joint")}}

_HUGE: Final = 2**63

ReadFrame = Callable[[str, Collection[str] | None], "pd.DataFrame"]
"""(frame, fields or None for all) -> the frame with the columns of those fields that it has."""
Columns = dict[str, list[Any]]
"""Values of the columns of a frame."""
_Types = tuple[tuple[str, frozenset[type]], ...]
"""Types of the values of each column of a part of a frame."""
Kind = tuple[_Types, ...]
"""Types of the parts that a row makes of the frames."""


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
        # Empty frames would decide on the types of the columns, too.
        lines = pd.concat([part for part in parts if len(part)] or parts)
        return lines.sort_values("order", kind="stable", ignore_index=True).drop(columns="order")

    @cached_property
    def by_std_from(self) -> "pd.DataFrame":
        """`cells` with a line per source of standard deviations, and its coverage. A cell that is
        not ok has a line for each source of its estimator in other cells, else for all sources;
        without any source (exact data) each cell has one line."""
        import pandas as pd

        # A metric of intervals has a column for each kind of interval: "coverage.KIND".
        figures = names_of("interval")
        columns = list(map(str, self.cells.columns))
        kinds = [name for name in columns if name.startswith(f"{COVERAGE}.")]
        prefixes = tuple(f"{name}." for name in figures)
        plain = self.cells.drop(columns=[name for name in columns if name.startswith(prefixes)])
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
            line[STD_FROM] = kind.removeprefix(f"{COVERAGE}.")
            for name in figures:
                line[name] = self.cells.get(kind.replace(COVERAGE, name, 1))
            lines.append(line)
        return pd.concat(lines).sort_index(kind="stable", ignore_index=True)


def data_frames(rows: Iterable[Row]) -> Frames:
    """Return the frames of rows; nested tables of a cell become columns with dotted names."""
    parts = list(map(parts_of, rows))
    types = _column_types({kind_of(part): None for part in parts})
    tables = {frame: _values([part[frame] for part in parts], types[frame]) for frame in FRAMES}

    def read(name: str, fields: Collection[str] | None) -> "pd.DataFrame":
        table, kinds = tables[name], types[name]
        wanted = columns_of_fields(fields, table)
        # Without Arrow, and with the same types as from a Parquet file (`pandas_frame`).
        size = len(next(iter(table.values()), ()))
        return _frame({key: _array(table[key], kinds[key]) for key in wanted}, size)

    return Frames(read)


def _array(values: list[Any], kind: str) -> np.ndarray:
    """Values of a column as `pandas_frame` gives them: NaN is absent, as None is."""
    if kind in ("double", "int64"):
        floats = [np.nan if v is None else v for v in values]
        return np.array(floats, dtype=float if kind == "double" else np.int64)
    made = np.empty(len(values), dtype=object)
    made[:] = [None if isinstance(v, float) and v != v else v for v in values]
    return made


# --- From rows to Arrow tables ------------------------------------------------------------------


def parts_of(row: Row) -> dict[str, Columns]:
    """Part of each frame that a row makes, empty where it has no entries."""
    cell = _flat({key: value for key, value in row.items() if key not in TABLES})
    parts: dict[str, Columns] = {"cells": {key: [value] for key, value in cell.items()}}
    for frame, field in _TABLE_OF.items():
        columns = columns_of(row.get(field))
        if columns is None or any({dict, list} & set(map(type, c)) for c in columns.values()):
            written = with_entries(row).get(field) or ()
            entries = [{"id": row["id"], **_flat(entry)} for entry in written]
            names = dict.fromkeys(chain.from_iterable(entries))
            parts[frame] = {name: [entry.get(name) for entry in entries] for name in names}
        else:
            # Most tables are written by column, and need not be taken apart.
            size = len(next(iter(columns.values())))
            parts[frame] = {"id": [row["id"]] * size, **columns} if size else {}
    return parts


def _flat(row: Mapping[str, Any], prefix: str = "") -> Row:
    """Return a row without nesting: names with dots for mappings, JSON texts for lists."""
    fields: Row = {}
    for key, value in row.items():
        if isinstance(value, dict):
            fields |= _flat(value, f"{prefix}{key}.")
        else:
            # Lists are stored as JSON, which DuckDB and people both read.
            fields[prefix + key] = json.dumps(value) if isinstance(value, list) else value
    return fields


def kind_of(parts: Mapping[str, Columns]) -> Kind:
    """Types of the columns. A whole number beyond 64 bits counts as a text, too: no column of
    numbers holds all of its digits."""
    kind = []
    for frame in FRAMES:
        columns = []
        for name, values in parts[frame].items():
            types = set(map(type, values))
            if int in types and any(type(v) is int and abs(v) >= _HUGE for v in values):
                types.add(str)
            columns.append((name, frozenset(types)))
        kind.append(tuple(columns))
    return tuple(kind)


def schemas_of(kinds: Collection[Kind]) -> dict[str, "pyarrow.Schema"]:
    """Schema of each frame, with the columns in the order in which rows name them."""
    import pyarrow

    number = {"sysid_bench": secrets.token_hex(8)}  # files with equal footers are of one writing
    columns = _column_types(kinds)
    return {frame: pyarrow.schema([*columns[frame].items()], metadata=number) for frame in FRAMES}


def _column_types(kinds: Collection[Kind]) -> dict[str, dict[str, str]]:
    """Arrow's name of the type of each column of each frame, in the order in which rows name
    them."""
    columns, absent = {}, frozenset({NoneType})
    for place, frame in enumerate(FRAMES):
        parts = [dict(kind[place]) for kind in kinds if kind[place]]
        names = dict.fromkeys((*_FIRST[frame], *chain.from_iterable(parts)))
        types = {name: {t for part in parts for t in part.get(name, absent)} for name in names}
        columns[frame] = {name: _arrow_type(found) for name, found in types.items()}
    return columns


def _arrow_type(types: Collection[type]) -> str:
    """One type for a column: Parquet does not mix texts and numbers, and pandas has no whole
    numbers beside absent ones."""
    given = {*types} - {NoneType}
    if not given:
        return "null"
    if given <= {int, float}:
        return "int64" if types == {int} else "double"
    return "bool" if given == {bool} else "string"


def table_of(parts: Iterable[Columns], schema: "pyarrow.Schema") -> "pyarrow.Table":
    """Lines of the parts of a frame as an Arrow table."""
    import pyarrow

    columns = _values(parts, {field.name: str(field.type) for field in schema})
    # from_pandas: NaN is absent, as None is.
    arrays = [pyarrow.array(v, schema.field(n).type, from_pandas=True) for n, v in columns.items()]
    return pyarrow.Table.from_arrays(arrays, schema=schema)


def _values(parts: Iterable[Columns], types: Mapping[str, str]) -> Columns:
    """Values of the columns of a frame; what a part lacks is absent."""
    columns: Columns = {name: [] for name in types}
    for part in parts:
        size = max(map(len, part.values()), default=0)
        for name, values in columns.items():
            values += part.get(name) or [None] * size
    for name, values in columns.items():
        kind, found = types[name], set(map(type, values))
        if kind == "double" and int in found:
            columns[name] = [None if v is None else float(v) for v in values]
        elif kind == "string" and not found <= {str, NoneType}:
            columns[name] = [
                v if v is None or isinstance(v, str) else json.dumps(v) for v in values
            ]
    return columns


# --- From Arrow tables to data frames and rows --------------------------------------------------


def columns_of_fields(fields: Collection[str] | None, known: Iterable[str]) -> list[str]:
    """Return the known columns that fields have, nested ones several (`_flat`); all for None."""
    if fields is None:
        return list(known)
    return [name for name in known if name in fields or name.partition(".")[0] in fields]


def pandas_frame(table: "pyarrow.Table") -> "pd.DataFrame":
    """Columns of numbers, else of objects with None for what is absent."""
    made = {}
    for name in table.column_names:
        column = table.column(name)
        if column.type in ("double", "int64"):
            values = column.to_numpy()
        elif column.type != "string":
            values = np.array(column.to_pylist(), dtype=object)
        else:
            # Each text is made once; a column of codes refers to it.
            chunks = column.dictionary_encode().unify_dictionaries().chunks
            texts = [*(chunks[0].dictionary.to_pylist() if chunks else ()), None]
            codes = [chunk.indices.fill_null(len(texts) - 1).to_numpy() for chunk in chunks]
            words = np.array(texts, dtype=object)
            values = words[np.concatenate(codes)] if codes else np.array([], dtype=object)
        made[name] = values
    return _frame(made, table.num_rows)


def _frame(columns: Mapping[str, np.ndarray], size: int) -> "pd.DataFrame":
    import pandas as pd

    # With its type, since pandas 3 makes texts a type of its own, whose absent value is NaN.
    made = {name: pd.Series(values, dtype=values.dtype) for name, values in columns.items()}
    return pd.DataFrame(made, index=pd.RangeIndex(size))
