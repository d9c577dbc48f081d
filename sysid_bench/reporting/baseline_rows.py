"""Rows of null models and floors beside those of methods, in tables and rankings of the error."""

from collections.abc import Collection, Mapping
from typing import Final

import pandas as pd

from sysid_bench.words import BASELINE_LABELS, LABELS

ERROR: Final = "torque_error"
"""The metric that baselines have."""

_NULL, _FLOOR = BASELINE_LABELS

BASELINES: Final[Mapping[str, tuple[str, ...]]] = {
    _NULL: ("torque_error_null",),
    _FLOOR: ("torque_error_floor", "torque_error_best"),
}
"""Label in the place of an estimator -> fields of the rows of an experiment, the lowest counts."""

ROUNDING: Final = 1e-9
"""Errors of a model that explains the tests exactly: no floor of what can be identified."""

_CAPTIONS: Final = (
    "Null model: bodies of the model file (of a simulated robot: of its prior) with fitted joint "
    "terms; an answer above it identified nothing.",
    "Floor: the lower of the training torque, played again where a test repeats its motion, and of "
    "the model fitted to the tests themselves; none where that is exact.",
)


def captions(shown: Collection[str]) -> list[str]:
    """Sentences on the baselines with these labels."""
    return [text for name, text in zip(BASELINES, _CAPTIONS, strict=True) if name in shown]


_SHARED: Final = {*LABELS, "repeat", "experiment"}
"""Fields of the row of a method that its baselines have as well."""


def with_baselines(cells: pd.DataFrame) -> pd.DataFrame:
    """The cells, and rows of the baselines of each of their experiments with a label in the place
    of the estimator; none where rows do not name a null model."""
    (null,) = BASELINES[_NULL]
    if not {null, "experiment"} <= {*cells.columns}:
        return cells
    # Estimators of one experiment share its baselines.
    first = cells[cells[null].notna()].drop_duplicates(["experiment"])
    shared = first[[name for name in first.columns if name in _SHARED]].assign(status="ok")
    parts = [cells]
    for label, fields in BASELINES.items():
        known = first[[name for name in fields if name in first]]
        # Absent values of a column of texts are the text "none".
        errors = known.apply(pd.to_numeric, errors="coerce").min(axis=1)
        if (is_there := errors > ROUNDING).any():
            parts.append(shared.assign(estimator=label, **{ERROR: errors})[is_there])
    return pd.concat(parts, ignore_index=True) if len(parts) > 1 else cells
