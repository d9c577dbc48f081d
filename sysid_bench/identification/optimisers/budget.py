"""Budgets of methods that simulate: CPU time, or a number of simulations.

An answer at the end of a CPU time depends on the clock and does not repeat bit for bit; that at the
end of a number of simulations does.
"""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from sysid_bench.errors import SysidBenchError, UsageError
from sysid_bench.units import quantity

_COUNT = re.compile(r"\s*(\d+)\s+simulations?\s*")


class BudgetError(SysidBenchError):
    """The budget is spent: the best answer so far is the answer."""


@dataclass(frozen=True)
class Budget:
    """Most CPU seconds, or most simulations; None: not limited."""

    seconds: float | None = None
    simulations: int | None = None

    def __str__(self) -> str:
        """Return the budget in words."""
        if self.simulations is not None:
            return f"{self.simulations} simulations"
        return "no limit" if self.seconds is None else f"{self.seconds:g} s of CPU time"


def parse_budget(text: str | None) -> Budget:
    """Return the budget of a text, "10 s" of CPU time or "500 simulations"; None: no limit.

    Raises UsageError for another text, and for a budget that is not positive.
    """
    if text is None:
        return Budget()
    try:
        count = _COUNT.fullmatch(text)
        budget = Budget(simulations=int(count[1])) if count else Budget(quantity(text, "s"))
    except (TypeError, UsageError) as error:
        raise UsageError(_wrong(text)) from error
    if not (budget.seconds or budget.simulations or 0) > 0:
        raise UsageError(_wrong(text))
    return budget


def _wrong(text: object) -> str:
    return f"budget = {text!r}: write a CPU time, '10 s', or a number, '500 simulations'."


@dataclass(eq=False)
class BudgetUse:
    """CPU time and simulations that a method has used since the meter was made."""

    budget: Budget
    simulations: int = 0
    began: float = field(default_factory=time.process_time)

    def count(self) -> None:
        """Count a simulation that is about to run; raises BudgetError where there is none left."""
        seconds, most = self.budget.seconds, self.budget.simulations
        late = seconds is not None and time.process_time() - self.began >= seconds
        if late or (most is not None and self.simulations >= most):
            raise BudgetError(f"the budget of {self.budget}")
        self.simulations += 1

    def with_count(self, simulate: Callable[..., Any]) -> Callable[..., Any]:
        """Return a simulation that counts its calls."""

        def counted(*arguments: Any) -> Any:
            self.count()
            return simulate(*arguments)

        return counted
