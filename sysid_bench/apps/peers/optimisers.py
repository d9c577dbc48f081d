"""Optimisers of the extra `peers`: CMA-ES by the package `cma`, and that of `mujoco.sysid`."""

import io
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.identification.optimisers import STEP, Search, SearchStatus, load_optimiser
from sysid_bench.types import Array


@dataclass(frozen=True)
class CmaEs:
    """`cma.CMAEvolutionStrategy` (Hansen 2016) with its default population and tolerances, from
    the first deviation `sigma` of every coordinate and the `seed` of its draws."""

    sigma: float = 0.1
    seed: int = 1

    def run(self, search: Search) -> SearchStatus:
        """Search from the start."""
        cost = search.cost
        options = {"bounds": [cost.low, cost.high], "seed": self.seed, "verbose": -9}
        strategy = load_optimiser("cma").CMAEvolutionStrategy(cost.start, self.sigma, options)
        while not strategy.stop():
            points = strategy.ask()
            found = search.evaluate_many([np.asarray(x) for x in points])
            values = [float(np.sum(residuals**2)) for residuals in found]
            strategy.tell(points, values)
            search.iterations += 1
        reasons = ", ".join(f"{key} = {value:g}" for key, value in strategy.stop().items())
        return SearchStatus(
            bool(strategy.stop().keys() & {"tolx", "tolfun", "tolfunhist"}), reasons
        )


MOST: Final = 10_000
"""Most iterations: the toolbox stops at 200 unless it is given another number."""


@dataclass(frozen=True)
class MujocoSysid:
    """`mujoco.sysid.optimize` with its default optimiser, box-constrained Gauss-Newton with
    Levenberg-Marquardt damping (`mujoco.minimize`), and its default tolerances.

    The residuals are those of the cost, not of a rollout of the toolbox, so that all optimisers
    have one simulator.
    """

    def run(self, search: Search) -> SearchStatus:
        """Search from the start; raises UnsupportedError without the extra of the toolbox."""
        sysid, cost = load_optimiser("mujoco.sysid"), search.cost
        if not hasattr(sysid, "optimize"):
            # Without its extra the toolbox is a module without any names.
            raise UnsupportedError(
                "This method needs mujoco.sysid with its extra: pip install 'sysid-bench[peers]'."
            )
        parameters = sysid.ParameterDict()
        parameters.add(sysid.Parameter("x", cost.start, cost.low, cost.high))

        def residuals(x: Array, _: Any) -> tuple[list[Array], None, None]:
            return [_columns(search, x)], None, None

        # The toolbox prints its iterations unless their stream is another.
        sysid.optimize(
            parameters, residuals, verbose=False, max_iters=MOST, eps=STEP, output=io.StringIO()
        )
        return SearchStatus(True, "its tolerances, or no further improvement")


def _columns(search: Search, x: Array) -> Array:
    """Return the residuals (M,) of x (d,), or (M, k) of the columns of x (d, k)."""
    # The toolbox asks for a point, or for all nudged points of a Jacobian at once.
    if x.ndim == 1:
        return search.evaluate(x)
    search.iterations += x.shape[1] > 1
    return np.stack(list(search.evaluate_many(list(x.T))), axis=1)
