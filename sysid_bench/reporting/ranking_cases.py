"""Cases in which methods are compared: robot, payload, motion, noise, ... and repeat, that is,
everything but the method."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import pandas as pd

from sysid_bench.errors import UsageError
from sysid_bench.reporting.selection import label
from sysid_bench.types import Array, Metric
from sysid_bench.words import LABELS

_CASE: Final = (*(name for name in LABELS if name != "estimator"), "repeat")
_OK: Final = "ok"


@dataclass(frozen=True, eq=False)
class RankingCases:
    """Cells by case and method. `errors` (cases, methods) are NaN where a cell has no row or no
    error, `status` (cases, methods) is "" where it has no row; `converged` is True where a row does
    not say otherwise. Noise-free cases are a law that an answer keeps or breaks, and have no ratio;
    nor have those whose prior is the truth."""

    robots: tuple[str, ...]  # of each case, in order
    methods: tuple[str, ...]
    errors: Array
    status: Array
    converged: Array
    noise_free: Array  # (cases,)
    told: Array  # (cases,), the prior is the truth
    floor: float  # errors up to it are rounding
    reasons: Mapping[str, str]  # the most frequent one of each method that failed

    @cached_property
    def with_ratio(self) -> Array:
        """Cases (cases,) that a ratio may come from."""
        return np.asarray(~(self.noise_free | self.told))

    @property
    def has_row(self) -> Array:
        """Cells (cases, methods) that have a row, whatever its status."""
        return np.asarray(self.status != "")


def ranking_cases(cells: pd.DataFrame, metric: Metric) -> RankingCases:
    """The cases of some cells. Raises UsageError where there are fewer than two methods."""
    names = [name for name in _CASE if name in cells.columns]
    lines = (
        cells[names]
        .map(label)
        .assign(
            estimator=cells["estimator"].map(label),
            error=_errors(cells, metric),
            status=cells["status"].map(label),
            converged=_converged(cells),
        )
    )
    methods = list(dict.fromkeys(lines["estimator"]))
    if len(methods) < 2:
        raise UsageError(
            f"A ranking by {metric.name} compares methods, and 'select' leaves "
            f"{', '.join(methods) or 'none'}."
        )
    # In the order of the labels: draws of robots do not depend on which rows came first.
    rows = lines.drop_duplicates([*names, "estimator"]).set_index([*names, "estimator"])
    table = {
        name: rows[name].unstack("estimator")[methods] for name in ("error", "status", "converged")
    }
    cases = table["error"].index.to_frame(index=False)
    return RankingCases(
        robots=tuple(cases.get("robot", ["robot"] * len(cases))),
        methods=tuple(methods),
        errors=table["error"].to_numpy(dtype=float),
        status=table["status"].fillna("").to_numpy(dtype=str),
        # fillna would warn of a change of type: a missing row is not unconverged.
        converged=(table["converged"] != False).to_numpy(dtype=bool),  # noqa: E712
        noise_free=_noise_free(cases),
        told=_is(cases, "prior", "truth"),
        floor=max(metric.floor, float(np.finfo(float).tiny)),
        reasons=_reasons(cells),
    )


def _errors(cells: pd.DataFrame, metric: Metric) -> pd.Series:
    """Errors of the cells, NaN where a cell is not ok or has none."""
    values = cells[metric.name] if metric.name in cells else pd.Series(np.nan, cells.index)
    return pd.to_numeric(values.where(cells["status"] == _OK), errors="coerce")


def _converged(cells: pd.DataFrame) -> list[bool]:
    """False where a row says so; rows without the field have converged."""
    given = cells["converged"] if "converged" in cells else [None] * len(cells)
    return [not _says_no(value) for value in given]


def _says_no(value: Any) -> bool:
    return isinstance(value, (bool, np.bool_, int, float)) and value == 0


def _is(cases: pd.DataFrame, field: str, text: str) -> Array:
    """Cases (cases,) whose label is a text; none where the field is absent."""
    if field not in cases:
        return np.zeros(len(cases), dtype=bool)
    return np.asarray(cases[field] == text, dtype=bool)


def _noise_free(cases: pd.DataFrame) -> Array:
    """Cases (cases,) with exact signals of a plant that the model can match: an error is then one
    of rounding, or a broken law."""
    parts = [_is(cases, "noise", "exact")]
    if "plant" in cases:
        parts.append(_is(cases, "plant", "matched"))
    if "signals" in cases:
        parts.append(np.array(["exact" in text.split(", ") for text in cases["signals"]]))
    return np.asarray(np.logical_and.reduce(parts))


def _reasons(cells: pd.DataFrame) -> dict[str, str]:
    """The most frequent reason of each method with a cell that is not ok."""
    if "reason" not in cells:
        return {}
    lost = cells[(cells["status"] != _OK) & cells["reason"].notna()]
    groups = lost.groupby(lost["estimator"].map(label), sort=False)["reason"]
    return {str(method): str(given.value_counts().index[0]) for method, given in groups}
