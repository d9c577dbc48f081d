"""Experiments whose simulations are limited by a budget."""

from dataclasses import replace

from sysid_bench.identification.optimisers.budget import BudgetUse, parse_budget
from sysid_bench.types import Experiment


def with_budget(experiment: Experiment, budget: str | None) -> Experiment:
    """Return an experiment whose simulation raises BudgetError after a budget, "10 s" of CPU time
    from now on, or "500 simulations"; None: no limit. Raises UsageError for another text."""
    if budget is None:
        return experiment
    return replace(
        experiment, simulate=BudgetUse(parse_budget(budget)).with_count(experiment.simulate)
    )
