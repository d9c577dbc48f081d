"""Data frames of rows: one of cells, and long ones of parameters and joints."""

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
    """`cells` has a line per row; `parameters` and `joints` have one per parameter or joint of the
    cell `id`."""

    cells: "pd.DataFrame"
    parameters: "pd.DataFrame"
    joints: "pd.DataFrame"

    @cached_property
    def by_parameter(self) -> "pd.DataFrame":
        """`cells` with a line per parameter (m, ..., fc) and its verdict; a cell without any has a
        line for each parameter of the others."""
        names = {"name": PARAMETER, "identifiable": VERDICT}
        verdicts = self.parameters[["id", *names]].rename(columns=names)
        return self._merged(verdicts, PARAMETER)

    @cached_property
    def by_joint(self) -> "pd.DataFrame":
        """`cells` with a line per joint and its errors; a cell without any has a line for each
        joint of the others."""
        errors = self.joints.rename(columns=_JOINT_COLUMNS)
        return self._merged(errors.reindex(columns=["id", *_JOINT_COLUMNS.values()]), JOINT)

    def _merged(self, entries: "pd.DataFrame", label: str) -> "pd.DataFrame":
        """`cells` with a line for each line of `entries` (id, label, ...), in order."""
        import pandas as pd

        cells = self.cells.reset_index(names="order")
        without = cells[~cells["id"].isin(entries["id"])]
        values = pd.DataFrame({label: entries[label].unique() if len(entries) else [None]})
        parts = [cells.merge(entries, on="id"), without.merge(values, how="cross")]
        lines = pd.concat([part for part in parts if len(part)] or parts)
        return lines.sort_values("order", kind="stable", ignore_index=True).drop(columns="order")

    @cached_property
    def by_std_from(self) -> "pd.DataFrame":
        """`cells` with a line per source of standard deviations, and its coverage. A cell that is
        not ok has a line for each source of its estimator in other cells, else for all sources;
        without any source (exact data) each cell has one line."""
        import pandas as pd

        prefix = f"{COVERAGE}."
        kinds = [str(name) for name in self.cells.columns if str(name).startswith(prefix)]
        plain = self.cells.drop(columns=kinds)
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
            line[STD_FROM], line[COVERAGE] = kind.removeprefix(prefix), coverage
            lines.append(line)
        return pd.concat(lines).sort_index(kind="stable", ignore_index=True)

    def write(self, folder: Path) -> None:
        """Write cells.parquet, parameters.parquet and joints.parquet, each atomically."""
        for name in ("cells", "parameters", "joints"):
            path = folder / f"{name}.parquet"
            temporary = path.with_name(f".{path.name}.{os.getpid()}")
            getattr(self, name).to_parquet(temporary, compression="zstd", index=False)
            temporary.replace(path)


def data_frames(rows: Iterable[Row]) -> Frames:
    """Return the frames of rows; nested tables of a cell become columns with dotted names."""
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
            # Lists are stored as JSON, which DuckDB and people both read.
            flat[prefix + key] = json.dumps(value) if isinstance(value, list) else value
    return flat


def _frame(rows: Iterable[Row], first: tuple[str, ...]) -> "pd.DataFrame":
    import pandas as pd

    rows = list(rows)
    columns = dict.fromkeys((*first, *(key for row in rows for key in row)))
    return pd.DataFrame({column: _column([row.get(column) for row in rows]) for column in columns})


def _column(values: list[Any]) -> "pd.Series":
    """Give a column one type: Parquet does not mix texts and numbers."""
    import pandas as pd

    kinds = {type(value) for value in values if value is not None}
    if int in kinds and any(abs(v) >= 2**63 for v in values if isinstance(v, int)):
        kinds.add(str)  # beyond 64 bits the digits are kept as a text
    if kinds <= {int, float} and kinds:
        return pd.Series(values, dtype="float64" if None in values or float in kinds else "int64")
    if len(kinds) > 1:
        values = [v if v is None or isinstance(v, str) else json.dumps(v) for v in values]
    return pd.Series(values, dtype="object")
