"""SciPy's trust-region reflective least squares."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from sysid_bench.identification.optimisers.search import Search, SearchStatus, residual_jacobian
from sysid_bench.types import Array


@dataclass(frozen=True)
class LeastSquares:
    """`scipy.optimize.least_squares`, method "trf" (Branch, Coleman, Li 1999), with its default
    tolerances, columns scaled by the Jacobian, and forward differences."""

    def run(self, search: Search) -> SearchStatus:
        """Search from the start."""
        cost, last = search.cost, [search.cost.start, search.residuals]

        def residuals(x: Array) -> Array:
            # SciPy asks for the start again, which is known.
            if not np.array_equal(x, last[0]):
                last[:] = x.copy(), search.evaluate(x)
            return last[1]

        def jacobian(x: Array) -> Array:
            return residual_jacobian(search, x, residuals(x))

        found = least_squares(
            residuals, cost.start, jacobian, (cost.low, cost.high), x_scale="jac", method="trf"
        )
        return SearchStatus(bool(found.status > 0), str(found.message).rstrip("."))
