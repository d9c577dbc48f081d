"""Lost and repeated samples of a log."""

from dataclasses import dataclass, field
from typing import ClassVar, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array

ROWS: Final = ("deleted", "held")
"""Rows of lost samples: missing in the log and bridged linearly, as gaps of recorded logs are; or
holding the last sample again under their own stamps."""


@dataclass(frozen=True)
class LostSamples:
    """Loss of the fraction `share` of the samples, in gaps of `burst` samples on average; `rows`
    says what the log has in their place, "deleted" or "held".

    Buses and loggers under load lose 0.1 to 1 % (to be verified).
    """

    share: float = field(default=0.005, metadata={"unit": "%"})
    burst: float = field(default=1.0, metadata={"unit": "1"})
    rows: str = "held"
    sizes: ClassVar[tuple[str, ...]] = ("share",)

    def __post_init__(self) -> None:
        """Raise UsageError for impossible shares and gaps, and for other rows."""
        if not (0 <= self.share <= 0.5 and self.burst >= 1):
            raise UsageError(
                f"share = {self.share!r} and burst = {self.burst!r} of the sensor error "
                "'lost-samples': give a share from 0 to 50 %, in gaps of 1 sample or more."
            )
        if self.rows not in ROWS:
            raise unknown_name("kind of rows of the sensor error 'lost-samples'", self.rows, ROWS)

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> "_Loss | None":
        """Return the stage; None where nothing is lost."""
        return _Loss(self.share, self.burst, self.rows == "held") if self.share else None


@dataclass(frozen=True, eq=False)
class _Loss:
    share: float
    burst: float
    held: bool

    def stored(self, count: int, rng: np.random.Generator) -> Array:
        """Return the sample of each row (count,), -1 where it is deleted; the first and the last
        one are never lost."""
        lost = self._lost(count, rng.random(count))
        rows = np.arange(count)
        if not self.held:
            return np.where(lost, -1, rows)
        # The last sample that was not lost, which the row repeats.
        return np.asarray(np.maximum.accumulate(np.where(lost, 0, rows)))

    def _lost(self, count: int, u: Array) -> Array:
        """Mask (count,) of a two-state chain (Gilbert 1960) with this share and mean gap."""
        end, begin = 1.0 / self.burst, self.share / (1.0 - self.share) / self.burst
        lost = np.zeros(count, dtype=bool)
        for k in range(1, count - 1):
            lost[k] = u[k] >= end if lost[k - 1] else u[k] < begin
        return lost
