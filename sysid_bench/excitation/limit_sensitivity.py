"""Price of each limit: what the criterion of a design would gain by a wider one.

At the optimum the slope of the criterion is a combination of those of the active limits, with
multipliers lambda >= 0 (Karush, Kuhn, Tucker). A limit that is wider by a share e changes its use
by -e, and so the criterion by -lambda e: to first order, and in the same local optimum. Prices of a
limit at several moments add up.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import nnls

from sysid_bench.excitation.design_cost import DesignCost
from sysid_bench.types import Array

_ACTIVE: Final = 0.95
"""Use above which a limit may be active: a search stops a little inside."""

_SHARPNESS: Final = 1000.0
"""Exponent of the smooth maxima, .3 % above the true ones."""

_LEAST: Final = 1e-3
"""Price below which a limit costs nothing."""


@dataclass(frozen=True)
class LimitSensitivity:
    """Prices by "kind name", the largest first, and the `balance`: the share of the squared slope
    of the criterion that the active limits oppose. It is one at an optimum; less before it, and
    where two singular values are the smallest together, so that the criterion has no one slope."""

    prices: Mapping[str, float]
    balance: float


NONE: Final = LimitSensitivity({}, 0.0)
"""No active limit."""


def limit_sensitivity(evaluation: DesignCost, C: Array) -> LimitSensitivity:
    """Return the decrease of the criterion per relative widening of each active limit at the
    coefficients C (m, k) of an optimum.

    Of ln cond it is -d ln cond / d ln limit: .5 for a limit that is 10 % wider and a condition that
    is 5 % smaller.
    """
    values, slopes = evaluation.smooth_limits(C, _SHARPNESS)
    active = values > _ACTIVE
    if not active.any():
        return NONE
    # Coefficients of fast joints would otherwise outweigh those of slow ones.
    v = evaluation.space.brief.v[evaluation.space.dofs]
    scale = np.tile(v, evaluation.shape[0])
    slope = -evaluation.gradient(C).ravel() * scale
    try:
        multipliers, left = nnls((slopes[active] * scale).T, slope)
    except RuntimeError:  # more iterations than it takes
        return NONE
    names = [name for name, keeps in zip(evaluation.names(), active, strict=True) if keeps]
    found: dict[str, float] = {}
    for name, price in zip(names, (multipliers * values[active]).tolist(), strict=True):
        found[name] = found.get(name, 0.0) + price  # of all moments
    found = {name: price for name, price in found.items() if price > _LEAST}
    balance = 1.0 - (left / max(float(np.linalg.norm(slope)), 1e-300)) ** 2
    return LimitSensitivity(dict(sorted(found.items(), key=lambda item: -item[1])), float(balance))
