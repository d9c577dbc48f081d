"""Covariance matrix adaptation evolution strategy, by the package `cma` of its author."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.identification.optimisers.search import Search, SearchStatus, load_optimiser


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
            values = [float(np.sum(search.evaluate(np.asarray(x)) ** 2)) for x in points]
            strategy.tell(points, values)
            search.iterations += 1
        reasons = ", ".join(f"{key} = {value:g}" for key, value in strategy.stop().items())
        return SearchStatus(
            bool(strategy.stop().keys() & {"tolx", "tolfun", "tolfunhist"}), reasons
        )
