"""Limits as shares of the allowed value: the largest use along a motion, its moment and its slopes.

A limit maps a motion to uses (N, m), 1 at the limit itself. The search keeps smooth maxima of them
below one; the report takes the true maxima on a finer grid.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sysid_bench.models.coupling.pullback import Slopes
from sysid_bench.types import Array, Trajectory

Split = Literal["together", "by column", "by moment", "by joint"]
"""Constraints of the search from uses (N, m): one for all; one per column; one per column, which
can be evaluated at any samples; one per column, which depends on one joint alone."""


@dataclass(frozen=True, eq=False)
class Limit:
    """Limit of one kind on m quantities `names` in `units`.

    `use` (motion): uses (N, m); `value` (motion): the same in units; `allowed` (values): the limit
    on their side (N, m). `slopes` (motion, G (N, m)): derivatives of sum(G * use) by q, v, a.
    `label` names quantities without a constant name. The search evaluates one sample of `every`.
    """

    kind: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    use: Callable[[Trajectory], Array]
    value: Callable[[Trajectory], Array]
    allowed: Callable[[Array], Array]
    slopes: Callable[[Trajectory, Array], Slopes]
    split: Split = "together"
    every: int = 1
    label: Callable[[Trajectory, int, int], str] | None = None  # name at sample k, column j


@dataclass(frozen=True)
class LimitUse:
    """Largest use of one kind of limit: `margin` = |limit - value|, negative beyond the limit."""

    kind: str
    name: str
    unit: str
    value: float
    limit: float
    margin: float
    use: float  # share; above 1 the limit is violated
    time: float  # s

    def to_json(self) -> dict[str, float | str]:
        """Return the fields as `excite --json` prints them."""
        return {
            "at": self.name,
            "value": self.value,
            "limit": self.limit,
            "margin": self.margin,
            "unit": self.unit,
            "share": self.use,
            "time": self.time,
        }


def smooth_bound(use: Array, sharpness: float) -> tuple[Array, Array]:
    """Return an upper bound (m,) of the largest |use| of each column (N, m), and its slope (N, m).

    log sum_k (exp(s u_k) + exp(-s u_k)) / s, at most log(2 N) / s too large (Kreisselmeier &
    Steinhauser 1979).
    """
    top = np.abs(use).max(axis=0)  # subtracted before exp, against overflow
    up, down = np.exp(sharpness * (use - top)), np.exp(sharpness * (-use - top))
    total = (up + down).sum(axis=0)
    return top + np.log(total) / sharpness, (up - down) / total


def largest_use(limit: Limit, motion: Trajectory) -> LimitUse:
    """Return the moment of a motion with the largest use of a limit."""
    use = np.abs(limit.use(motion))
    k, j = np.unravel_index(int(np.argmax(use)), use.shape)
    values = limit.value(motion)
    value, allowed = float(values[k, j]), float(limit.allowed(values)[k, j])
    share = float(use[k, j])
    return LimitUse(
        kind=limit.kind,
        name=limit.names[j] if limit.label is None else limit.label(motion, int(k), int(j)),
        unit=limit.units[j],
        value=value,
        limit=allowed,
        margin=float(np.copysign(abs(allowed - value), 1.0 - share)),
        use=share,
        time=float(motion.t[k]),
    )
