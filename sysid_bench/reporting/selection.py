"""Choice of cells by field values or an expression, and the text of their labels."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name

if TYPE_CHECKING:
    import pandas as pd

Choose = Callable[[str, Mapping[str, Any]], bool]
"""(expression, cell) -> whether the cell meets it."""

SWEEPABLE: Final = (
    "robot", "payload", "task", "plant", "excitation", "simulation", "noise", "estimator",
)  # fmt: skip
"""Fields that make experiments different; a table that pools over one of these has a note."""


def label(value: Any) -> str:
    """A field of a row as text; mappings and lists read as "tau 0.5 %, q 1e-4 rad"."""
    if isinstance(value, Mapping):
        parts = [label(v) if k == "use" else f"{k} {label(v)}" for k, v in value.items()
                 if v is not None]  # fmt: skip
        return ", ".join(parts) or "none"
    if isinstance(value, (list, tuple, np.ndarray)):
        return " ".join(label(v) for v in value)
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return "none"
    return f"{value:g}" if isinstance(value, (float, np.floating)) else str(value)


def with_labels(cells: "pd.DataFrame") -> "pd.DataFrame":
    """The same cells with text in every field that can make a row or column."""
    texts = [
        name
        for name in cells.columns
        if name in (*SWEEPABLE, "status")
        or (cells[name].dtype == object and not _is_boolean(cells[name]))
    ]
    return cells.assign(**{name: [label(value) for value in cells[name]] for name in texts})


def _is_boolean(column: "pd.Series") -> bool:
    """True where all values of a column are booleans: a metric, not a label."""
    values = column.dropna()
    return len(values) > 0 and all(isinstance(value, (bool, np.bool_)) for value in values)


def selected(
    cells: "pd.DataFrame", spec: Mapping[str, Any], choose: Choose | None
) -> "pd.DataFrame":
    """Cells that `spec["select"]` keeps: a mapping of field to value (or list of values), or an
    expression that `choose(expression, cell)` decides. Raises UsageError where none is left."""
    select = spec.get("select")
    if isinstance(select, str):
        if choose is None:
            raise UsageError(f"Give `choose` to evaluate the expression {select!r}.")
        keep = [choose(select, {str(k): v for k, v in row.items()})
                for row in cells.to_dict("records")]  # fmt: skip
        cells = cells[keep]
    for field, value in select.items() if isinstance(select, Mapping) else ():
        if field not in cells.columns:
            raise unknown_name("field of the cells", str(field), map(str, cells.columns))
        allowed = [label(v) for v in (value if isinstance(value, list) else [value])]
        cells = cells[[label(v) in allowed for v in cells[field]]]
    if len(cells) == 0:
        raise UsageError(f"The table {spec.get('name', '')!r} has no cell (select: {select!r}).")
    return cells
