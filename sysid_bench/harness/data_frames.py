"""Rows become data frames: one of cells, two long ones of parameters and joints."""

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.metrics import METRICS, names_of
from sysid_bench.types import Row
from sysid_bench.vocabulary import COVERAGE, JOINT, LABELS, PARAMETER, STD_FROM, VERDICT

if TYPE_CHECKING:
    import pandas as pd

FIRST_COLUMNS: Final = ("id", "experiment", *LABELS, "repeat", "status", "reason")
_JOINT_COLUMNS: Final = {
    "name": JOINT,
    **{METRICS[name].key: name for name in names_of("joint")},
}
_LONG: Final[Mapping[str, tuple[str, ...]]] = {
    "joints": ("id", "name"),
    "parameters_table": (
        *("id", "body", "name", "true", "estimate", "std", "std_from", "identifiable"),
        *("base_error", "bound"),
    ),
}


@dataclass(frozen=True, eq=False)
class Frames:
    """`cells` has a line per row, `parameters` and `joints` one per parameter or joint of a cell,
    which `id` names."""

    cells: "pd.DataFrame"
    parameters: "pd.DataFrame"
    joints: "pd.DataFrame"

    @cached_property
    def by_parameter(self) -> "pd.DataFrame":
        """`cells` with a line per parameter (m, ..., fc) and its verdict; a cell that tells of none
        has a line for each that others tell of."""
        names = {"name": PARAMETER, "identifiable": VERDICT}
        told = self.parameters[["id", *names]].rename(columns=names)
        return self._spread(told, PARAMETER)

    @cached_property
    def by_joint(self) -> "pd.DataFrame":
        """`cells` with a line per joint and its errors; a cell that tells of none has a line for
        each that others tell of."""
        told = self.joints.rename(columns=_JOINT_COLUMNS)
        return self._spread(told.reindex(columns=["id", *_JOINT_COLUMNS.values()]), JOINT)

    def _spread(self, told: "pd.DataFrame", label: str) -> "pd.DataFrame":
        """`cells` with a line for each line of `told` (id, label, ...), in their own order."""
        import pandas as pd

        lines = self.cells.reset_index(names="place")
        silent = lines[~lines["id"].isin(told["id"])]
        every = pd.DataFrame({label: told[label].unique() if len(told) else [None]})
        both = [lines.merge(told, on="id"), silent.merge(every, how="cross")]
        whole = pd.concat([part for part in both if len(part)] or both)
        return whole.sort_values("place", kind="stable", ignore_index=True).drop(columns="place")

    @cached_property
    def by_std_from(self) -> "pd.DataFrame":
        """`cells` with a line per way to tell how sure an estimate is, and its coverage; a cell
        that is not ok has a line for each that its estimator tells of elsewhere, or any does.
        Where no cell tells of any (exact data), all have one line."""
        import pandas as pd

        prefix = f"{COVERAGE}."
        kinds = [str(name) for name in self.cells.columns if str(name).startswith(prefix)]
        plain = self.cells.drop(columns=kinds)
        if not kinds:
            plain[STD_FROM], plain[COVERAGE] = "none", None
            return plain
        failed, who = self.cells["status"] != "ok", self.cells["estimator"]
        mute = ~who.isin(who[self.cells[kinds].notna().any(axis=1)])
        lines = []
        for kind in kinds:
            told = self.cells[kind]
            line = plain[told.notna() | failed & (mute | who.isin(who[told.notna()]))].copy()
            line[STD_FROM], line[COVERAGE] = kind.removeprefix(prefix), told
            lines.append(line)
        return pd.concat(lines).sort_index(kind="stable", ignore_index=True)

    def write(self, folder: Path) -> None:
        """cells.parquet, parameters.parquet and joints.parquet, each whole or not at all."""
        for name in ("cells", "parameters", "joints"):
            path = folder / f"{name}.parquet"
            beside = path.with_name(f".{path.name}.{os.getpid()}")
            getattr(self, name).to_parquet(beside, compression="zstd", index=False)
            beside.replace(path)


def data_frames(rows: Iterable[Row]) -> Frames:
    """Frames of rows; nested tables of a cell become columns with dotted names."""
    rows = list(rows)
    cells = [_flat({key: value for key, value in row.items() if key not in _LONG}) for row in rows]
    return Frames(
        _frame(cells, FIRST_COLUMNS),
        _frame(_long(rows, "parameters_table"), _LONG["parameters_table"]),
        _frame(_long(rows, "joints"), _LONG["joints"]),
    )


def _long(rows: Iterable[Row], field: str) -> Iterator[Row]:
    for row in rows:
        for entry in row.get(field) or ():
            yield {"id": row["id"], **_flat(entry)}


def _flat(row: Mapping[str, Any], prefix: str = "") -> Row:
    flat: Row = {}
    for key, value in row.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            # A column of lists has no place in a table that DuckDB and a person both read.
            flat[prefix + key] = json.dumps(value) if isinstance(value, list) else value
    return flat


def _frame(rows: Iterable[Row], first: tuple[str, ...]) -> "pd.DataFrame":
    import pandas as pd

    rows = list(rows)
    columns = dict.fromkeys((*first, *(key for row in rows for key in row)))
    return pd.DataFrame({column: _column([row.get(column) for row in rows]) for column in columns})


def _column(values: list[Any]) -> "pd.Series":
    """One type per column: Parquet takes no mixture of texts and numbers."""
    import pandas as pd

    kinds = {type(value) for value in values if value is not None}
    if int in kinds and any(abs(v) >= 2**63 for v in values if isinstance(v, int)):
        kinds.add(str)  # no integer column is that wide: keep the digits as a text
    if kinds <= {int, float} and kinds:
        return pd.Series(values, dtype="float64" if None in values or float in kinds else "int64")
    if len(kinds) > 1:
        values = [v if v is None or isinstance(v, str) else json.dumps(v) for v in values]
    return pd.Series(values, dtype="object")
