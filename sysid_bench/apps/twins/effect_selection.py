"""Selection of effects of a joint by cross-validation over blocks of time."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Final

import numpy as np

from sysid_bench.apps.twins.effect_columns import FOLDS, NOT_NEGATIVE, JointColumns, JointEffects
from sysid_bench.types import Array

SMALLEST: Final = 0.02
"""Share of the mean squared residual on left-out blocks that an effect has to remove."""

MAJORITY: Final = 4
"""Blocks in which it has to be smaller."""

TINY: Final = 1e-12
"""Ridge of the normal equations, relative to the scaled columns."""

LARGEST_LOAD: Final = 0.5
"""Load-dependent friction over the load: a gear with more locks itself."""

SMALLEST_CURVE, LARGEST_CURVE = -0.95, 5.0
"""Change of the viscous friction at the velocity limit over itself: below -1 friction would drive
the joint."""

LARGEST_PEAK: Final = 3.0
"""Stribeck peak over Coulomb friction."""


@dataclass(frozen=True)
class JointLimits:
    """What bounds a joint's effects: its `speed` (rad/s, m/s), the velocity limit or the largest
    recorded one, and the largest recorded `torque` (N m, N), which neither friction nor low
    harmonics exceed."""

    speed: float
    torque: float


@dataclass(frozen=True)
class _Kept:
    """An effect that was kept, and the share of the mean squared residual on left-out blocks that
    it removed when it was added."""

    effect: str
    share: float


@dataclass(frozen=True, eq=False)
class JointFit:
    """Effects of a joint with their coefficients by column, and what they leave of the torque,
    `residual` (N,). `before` and `after`: RMS of the residual of blocks predicted by the others,
    without and with the effects."""

    effects: JointEffects
    values: dict[str, float]
    kept: tuple[_Kept, ...]
    residual: Array
    before: float
    after: float


@dataclass(frozen=True, eq=False)
class _Validated:
    """Effects and the mean squared residual of each left-out block (FOLDS,)."""

    effects: JointEffects
    errors: Array
    residual: Array = field(repr=False)

    @property
    def error(self) -> float:
        return float(np.mean(self.residual**2))

    def improves(self, other: "_Validated") -> bool:
        """True where the error is smaller by SMALLEST, and in the MAJORITY of the blocks."""
        better = int((self.errors < other.errors).sum())
        return self.error < (1.0 - SMALLEST) * other.error and better >= MAJORITY


def select_effects(columns: JointColumns, groups: Collection[str], limits: JointLimits) -> JointFit:
    """Return the effects of a joint out of some groups, added one by one while left-out blocks
    keep them; those whose values no gear can have are left out."""
    folds, speed = columns.blocks, columns.speed
    best = start = _validated(columns, JointEffects(), folds)
    kept: list[_Kept] = []
    while True:
        further = best.effects.candidates(groups, speed)
        options = [_validated(columns, one, folds) for one in further]
        better = [
            one
            for one in options
            if one.improves(best) and is_feasible(_values(columns, one.effects), limits)
        ]
        if not better:
            break
        chosen = min(better, key=attrgetter("error"))
        share = 1.0 - chosen.error / best.error
        kept.append(_Kept(chosen.effects.groups[-1], share))
        best = chosen
    values = _values(columns, best.effects)
    X, y = columns.matrix(best.effects), columns.torque_with_delay(best.effects.delay)
    return JointFit(
        best.effects,
        values,
        tuple(kept),
        y - X @ np.array(list(values.values())),
        float(np.sqrt(start.error)),
        float(np.sqrt(best.error)),
    )


def _values(columns: JointColumns, effects: JointEffects) -> dict[str, float]:
    """Coefficients by column, fitted to all samples."""
    X, y = columns.matrix(effects), columns.torque_with_delay(effects.delay)
    found = _solution(*_normal(X, y), effects.columns)
    return dict(zip(effects.columns, found.tolist(), strict=True))


def is_feasible(values: Mapping[str, float], limits: JointLimits) -> bool:
    """Return True for values (by column) that a gear can have."""
    friction = values["coulomb"] + values.get("stribeck", 0.0)
    curve = values.get("curved", 0.0) * limits.speed
    harmonics = [
        np.hypot(values[f"sin {order}"], values[f"cos {order}"])
        for order in range(1, 4)
        if f"sin {order}" in values
    ]
    return bool(
        max([friction, *harmonics]) <= limits.torque
        and values.get("load", 0.0) <= LARGEST_LOAD
        and values.get("stribeck", 0.0) <= LARGEST_PEAK * values["coulomb"]
        and SMALLEST_CURVE * values["viscous"] <= curve <= LARGEST_CURVE * values["viscous"]
    )


def _validated(columns: JointColumns, effects: JointEffects, folds: Array) -> _Validated:
    """The effects with their residual on each block, predicted by the others."""
    X, y = columns.matrix(effects), columns.torque_with_delay(effects.delay)
    parts = [_normal(X[folds == f], y[folds == f]) for f in range(FOLDS)]
    G, g = (sum(part[i] for part in parts) for i in range(2))
    residual = np.empty_like(y)
    for f, (own, right) in enumerate(parts):
        left_out = folds == f
        beta = _solution(np.asarray(G - own), np.asarray(g - right), effects.columns)
        residual[left_out] = y[left_out] - X[left_out] @ beta
    errors = np.array([np.mean(residual[folds == f] ** 2) for f in range(FOLDS)])
    return _Validated(effects, errors, residual)


def _normal(X: Array, y: Array) -> tuple[Array, Array]:
    return X.T @ X, X.T @ y


def _solution(G: Array, g: Array, names: tuple[str, ...]) -> Array:
    """Coefficients (k,) of normal equations G x = g; those of NOT_NEGATIVE that would be negative
    are zero, and without viscous friction there is none that is curved."""
    free = np.ones(len(g), dtype=bool)
    signed, curved = np.isin(names, NOT_NEGATIVE), np.isin(names, "curved")
    while True:
        x = np.zeros(len(g))
        scale = np.sqrt(np.maximum(np.diag(G)[free], 1e-300))
        scaled = G[np.ix_(free, free)] / np.outer(scale, scale)
        x[free] = np.linalg.solve(scaled + TINY * np.eye(len(scale)), g[free] / scale) / scale
        wrong = free & signed & (x < 0.0)
        if not wrong.any():
            return x
        free &= ~wrong
        free &= ~curved | free[names.index("viscous")]
