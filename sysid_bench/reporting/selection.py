"""Choice of cells by field values or an expression, and the text of their labels."""

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name

if TYPE_CHECKING:
    import pandas as pd

Choose = Callable[[str, Mapping[str, Any]], bool]
"""(expression, cell) -> whether the cell meets it."""

_BLOCK: Final = 1000  # cells that are mappings at a time
SWEEPABLE: Final = (
    "robot", "payload", "task", "plant", "excitation", "simulation", "noise", "pipeline",
    "estimator",
)  # fmt: skip
"""Fields that make experiments different; a table that pools over one of these has a note."""


def label(value: Any) -> str:
    """A field of a row as text; mappings and lists read as "tau 0.5 %, q 1e-4 rad"."""
    if type(value) is str:
        return value
    if isinstance(value, Mapping):
        return ", ".join(_parts(value)) or "none"
    if isinstance(value, (list, tuple, np.ndarray)):
        return " ".join(map(label, value))
    if isinstance(value, (float, np.floating)):
        return _float_label(value)
    return "none" if value is None else str(value)


def _parts(value: Mapping[Any, Any]) -> Iterator[str]:
    """ "key value" of each key that is set; the name of what is used stands without its key."""
    for key, part in value.items():
        if part is not None:
            yield label(part) if key == "use" else f"{key} {label(part)}"


def _float_label(value: "float | np.floating[Any]") -> str:
    # pandas stores a missing text as NaN.
    return "none" if np.isnan(value) else f"{value:g}"


def with_labels(cells: "pd.DataFrame") -> "pd.DataFrame":
    """The same cells with text in every field that can make a row or column."""
    columns = [cells[name] for name in cells.columns if _has_labels(cells[name])]
    texts = [str(column.name) for column in columns if set(map(type, column)) != {str}]
    return cells.assign(**{name: list(map(label, cells[name])) for name in texts})


def _has_labels(column: "pd.Series") -> bool:
    if column.name in (*SWEEPABLE, "status"):
        return True
    return column.dtype == object and not _is_boolean(column)


def _is_boolean(column: "pd.Series") -> bool:
    """True where all values of a column are booleans: a metric, not a label."""
    types = set(map(type, column.dropna()))
    return bool(types) and types <= {bool, np.bool_}


def select_rows(
    cells: "pd.DataFrame", spec: Mapping[str, Any], choose: Choose | None
) -> "pd.DataFrame":
    """Cells that `spec["select"]` keeps: a mapping of field to value (or list of values), or an
    expression that `choose(expression, cell)` decides. Raises UsageError where none is left."""
    select = spec.get("select")
    if isinstance(select, str):
        cells = _matching(cells, select, choose)
    elif isinstance(select, Mapping):
        cells = _with_values(cells, select)
    if len(cells) == 0:
        raise UsageError(f"The table {spec.get('name', '')!r} has no cell (select: {select!r}).")
    return cells


def _matching(cells: "pd.DataFrame", expression: str, choose: Choose | None) -> "pd.DataFrame":
    """Cells that meet an expression."""
    if choose is None:
        raise UsageError(f"Give `choose` to evaluate the expression {expression!r}.")
    return cells[[choose(expression, row) for row in _rows(cells)]]


def _rows(cells: "pd.DataFrame") -> Iterator[dict[str, Any]]:
    """Yield the cells as mappings, which are made for a block at a time."""
    for start in range(0, len(cells), _BLOCK):
        for row in cells[start : start + _BLOCK].to_dict("records"):
            yield {str(key): value for key, value in row.items()}


def _with_values(cells: "pd.DataFrame", select: Mapping[str, Any]) -> "pd.DataFrame":
    """Cells whose field has the value, or one of the list of values, for every field."""
    for field, value in select.items():
        if field not in cells.columns:
            raise unknown_name("field of the cells", str(field), map(str, cells.columns))
        allowed = set(map(label, value if isinstance(value, list) else [value]))
        cells = cells[[text in allowed for text in map(label, cells[field])]]
    return cells
