"""Price of each limit: what the criterion of a design would gain by a wider one.

At the optimum the slope of the criterion is a combination of those of the active limits, with
multipliers lambda >= 0 (Karush, Kuhn, Tucker). A limit that is wider by a share e changes its use
by -e, and so the criterion by -lambda e.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np
from scipy.optimize import nnls

from sysid_bench.excitation.design_evaluation import DesignEvaluation
from sysid_bench.types import Array

_ACTIVE: Final = 0.95
"""Use above which a limit may be active: a search stops a little inside."""

_SHARPNESS: Final = 1000.0
"""Exponent of the smooth maxima, .3 % above the true ones."""

_LEAST: Final = 1e-3
"""Price below which a limit costs nothing."""


def limit_prices(evaluation: DesignEvaluation, C: Array) -> dict[str, float]:
    """Return the decrease of the criterion per relative widening of each active limit, the largest
    first, by "kind name", at the coefficients C (m, k) of an optimum.

    Of ln cond it is -d ln cond / d ln limit: .5 for a limit that is 10 % wider and a condition that
    is 5 % smaller.
    """
    values, slopes = evaluation.smooth_limits(C, _SHARPNESS)
    active = values > _ACTIVE
    if not active.any():
        return {}
    # Coefficients of fast joints would otherwise outweigh those of slow ones.
    v = evaluation.space.brief.v[evaluation.space.dofs]
    scale = np.tile(v, evaluation.shape[0])
    multipliers, _ = nnls((slopes[active] * scale).T, -evaluation.gradient(C).ravel() * scale)
    names = [name for name, keeps in zip(_names(evaluation), active, strict=True) if keeps]
    found = {
        name: float(price)
        for name, price in zip(names, multipliers * values[active], strict=True)
        if price > _LEAST
    }
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def _names(evaluation: DesignEvaluation) -> Iterator[str]:
    """Names of the constraints, in the order of `smooth_limits`."""
    for limit in evaluation.limits:
        if limit.split == "together":
            yield limit.kind
        else:
            yield from (f"{limit.kind} {name}" for name in limit.names)
