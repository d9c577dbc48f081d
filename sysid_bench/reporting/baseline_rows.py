"""Rows of null models and floors beside those of methods, in tables and rankings of the error."""

from collections.abc import Mapping
from typing import Final

import pandas as pd

from sysid_bench.words import LABELS

ERROR: Final = "torque_error"
"""The metric that baselines have."""

BASELINES: Final[Mapping[str, str]] = {
    "null model": "torque_error_null",
    "mean torque": "torque_error_mean",
    "zero torque": "",
    "floor: repetition": "torque_error_floor",
    "floor: best fit": "torque_error_best",
}
"""Label in the place of an estimator -> field of the rows of an experiment."""

CAPTION: Final = (
    "Null model: bodies of the model file (of a simulated robot: of its prior) with fitted joint "
    "terms; an answer above it identified nothing. Floors: the training torque, played again where "
    "a test repeats its motion, and the model fitted to the tests themselves."
)


_NULL: Final = BASELINES["null model"]
_SHARED: Final = {*LABELS, "repeat", "experiment"}
"""Fields of the row of a method that its baselines have as well."""


def with_baselines(cells: pd.DataFrame) -> pd.DataFrame:
    """The cells, and rows of the baselines of each of their experiments with a label in the place
    of the estimator; none where rows do not name a null model."""
    if not {_NULL, "experiment"} <= {*cells.columns}:
        return cells
    # Estimators of one experiment share its baselines.
    first = cells[cells[_NULL].notna()].drop_duplicates(["experiment"])
    shared = first[[name for name in first.columns if name in _SHARED]].assign(status="ok")
    parts = [cells]
    for label, field in BASELINES.items():
        # No torque at all errs by the torque itself.
        errors = first.get(field) if field else pd.Series(1.0, first.index)
        if errors is not None and (known := errors.notna()).any():
            parts.append(shared.assign(estimator=label, **{ERROR: errors})[known])
    return pd.concat(parts, ignore_index=True) if len(parts) > 1 else cells
