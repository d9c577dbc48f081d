"""What makes a motion worth recording: criteria on the base regressor, with their slopes.

All but one are functions of the singular values of W S, rows W (M, r) and a fixed S (r, r), so one
decomposition of the R factor serves: with W S = U s V', the slope by W is W S V diag(f'(s) / s) V'
S'. All are logarithms to be made small, so that they can be added up.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.regressors.qr_accumulation import upper_factor
from sysid_bench.types import Array

SpectralFunction = Callable[[Array], tuple[float, Array]]
"""Singular values s (r,), the largest first, to f and f' (r,)."""


def _condition(s: Array) -> tuple[float, Array]:
    slope = np.zeros_like(s)
    slope[0] += 1 / s[0]
    slope[-1] -= 1 / s[-1]
    return float(np.log(s[0] / s[-1])), slope


def _d(s: Array) -> tuple[float, Array]:
    return float(-2 * np.log(s).mean()), -2 / (len(s) * s)


def _a(s: Array) -> tuple[float, Array]:
    total = (s**-2.0).sum()
    return float(np.log(total)), -2 * s**-3.0 / total


def _e(s: Array) -> tuple[float, Array]:
    slope = np.zeros_like(s)
    slope[-1] = -2 / s[-1]
    return float(-2 * np.log(s[-1])), slope


CRITERIA: Final[Mapping[str, str]] = {
    "cond": "log of the condition number, SI columns",
    "cond-unit": "log of the condition number, unit columns",
    "D": "minus log det of the information matrix, per parameter",
    "A": "log of the summed variance of the base parameters, SI columns",
    "E": "minus log of the information about the worst direction, SI columns: its smallest "
    "eigenvalue, the square of the smallest singular value",
    "predict": "log of the predicted variance of the torques of other motions",
}
"""Names of criteria; all of them are made small."""

_SPECTRAL: Final[Mapping[str, SpectralFunction]] = {
    "cond": _condition, "D": _d, "A": _a, "E": _e, "predict": _a
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Criterion:
    """A weighted sum of criteria on rows W (M, r).

    `known` (k, r) are rows that were recorded before (an R factor will do): the next motion is
    judged together with them. `whiten` (r, r) is the S of `predict`: the inverse of the R factor of
    the motions whose torques are to be predicted.
    """

    weights: Mapping[str, float]
    known: Array
    whiten: Array

    def value(self, W: Array) -> float:
        """The sum; infinity where the rows do not tell every parameter."""
        return self._evaluate(W, slope=False)[0]

    def gradient(self, W: Array) -> Array:
        """Its slope by W (M, r)."""
        return self._evaluate(W, slope=True)[1]

    def _evaluate(self, W: Array, slope: bool) -> tuple[float, Array]:
        total, by_W = 0.0, np.zeros_like(W) if slope else W
        rows = np.concatenate([self.known, W])
        R = upper_factor([rows])
        for name, weight in self.weights.items():
            unit = name == "cond-unit"
            norms = np.linalg.norm(R, axis=0) if unit else np.ones(W.shape[1])
            if len(R) < R.shape[1] or not norms.all():
                return np.inf, by_W
            S = np.diag(1 / norms) if unit else self.whiten if name == "predict" else None
            _, s, Vt = np.linalg.svd(R if S is None else R @ S)
            if not s[-1] > 1e-12 * s[0]:
                return np.inf, by_W
            f, df = _SPECTRAL["cond" if unit else name](s)
            total += weight * f
            if slope:
                core = (Vt.T * (df / s)) @ Vt
                if unit:
                    # The norms change with W: what a longer column would change is taken away.
                    scaled = W / norms
                    by_scaled = scaled @ core
                    all_scaled = rows / norms
                    along = (all_scaled * (all_scaled @ core)).sum(axis=0)
                    by_W += weight * (by_scaled - scaled * along) / norms
                else:
                    by_W += weight * (W @ (core if S is None else S @ core @ S.T))
        return total, by_W


def criterion_weights(objective: str | Mapping[str, float]) -> dict[str, float]:
    """Criteria and their weights, of a name or a table {D = 1, cond = 0.1}; raises UsageError."""
    table = {objective: 1.0} if isinstance(objective, str) else dict(objective)
    for name, weight in table.items():
        if name not in CRITERIA:
            raise unknown_name("objective", name, CRITERIA)
        good = isinstance(weight, (int, float)) and not isinstance(weight, bool)
        if not (good and np.isfinite(weight) and weight > 0):
            raise UsageError(f"The objective {name!r} needs a positive weight; got {weight!r}.")
    if not table:
        raise UsageError(f"An objective needs a name; there are: {', '.join(CRITERIA)}.")
    return table
