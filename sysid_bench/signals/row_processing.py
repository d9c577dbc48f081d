"""Processing of the rows W beta = b once the motion is known: filter, decimation, standstill."""

from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import Joint
from sysid_bench.signals.filter import Filter, NoFilter
from sysid_bench.types import Array, Recording

STANDSTILL: Final = 0.1
"""Rate below which a joint stands still, as a share of its RMS rate: static friction then balances
any torque up to its limit, and sign(v) has no meaning."""


@dataclass(frozen=True)
class RowProcessing:
    """Weights of slow rows, then one filter for all columns of W and b, then every `step`-th row.

    Each operation is linear in time and the same for W and b, so that F W beta = F b holds for the
    beta of W beta = b, at the ends too. Rows of a joint slower than `standstill` times its RMS
    rate count with `weight`; 0 leaves them out, before the filter spreads them over others.
    """

    filter: Filter = field(default_factory=NoFilter)
    step: int = 1
    standstill: float = 0.0
    weight: float = 0.0

    def __post_init__(self) -> None:
        """Raise UsageError for a share or a weight that is impossible."""
        if not (0.0 <= self.standstill < 1.0 and 0.0 <= self.weight <= 1.0):
            raise UsageError(
                f"standstill = {self.standstill:g} with weight {self.weight:g}: give a share of "
                "the RMS rate from 0 (all rows count alike) to below 1, and a weight from 0 to 1."
            )

    @property
    def is_plain(self) -> bool:
        """True where rows stay as they are."""
        return isinstance(self.filter, NoFilter) and self.step == 1 and self.standstill == 0.0

    def weights(self, v: Array) -> Array:
        """Return the weight of each row (N, k) from the rates v (N, k) of its joints; NaN rates
        belong to rows without a joint of one degree of freedom, which never stand still."""
        limit = self.standstill * np.sqrt((v**2).mean(axis=0))
        return np.where(np.abs(v) < limit, self.weight, 1.0)

    def apply(self, x: Array, weights: Array, rate: float) -> Array:
        """Return columns x (N, k) of rows with weights (N,) as processed, (M, k)."""
        weighted = x if (weights == 1.0).all() else x * weights[:, None]
        return self.filter.smooth(weighted, rate)[:: self.step]

    def count(self, weights: Array) -> int:
        """Return the number of processed rows that the rows with a weight (N,) amount to."""
        return round(int(np.count_nonzero(weights)) / self.step)


MOVING: Final = RowProcessing(standstill=STANDSTILL)
"""Rows at which joints move: those of the score `torque_error_moving`."""


@dataclass(frozen=True, eq=False)
class ProcessedSignals:
    """A recording with v and a at its own rate, and what is to be done with its rows; `margin`
    samples on either side of a disturbed one have its position in their v and a."""

    recording: Recording
    rows: RowProcessing = field(default_factory=RowProcessing)
    margin: int = 0


class Pipeline(Protocol):
    """Signal pipeline of simulated and recorded data, the same code for both.

    `ideal_rates`: it reads v and a of ideal sensors where a simulation offers them.
    """

    @property
    def ideal_rates(self) -> bool: ...

    def process(self, recording: Recording, joints: tuple[Joint, ...]) -> ProcessedSignals: ...
