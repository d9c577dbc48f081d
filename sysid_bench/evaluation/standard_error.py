"""Standard errors of an estimate, and the confidence intervals that they make."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import stdtrit

from sysid_bench.types import Array

LEVEL: Final = 0.95


@dataclass(frozen=True, eq=False)
class StandardError:
    """Covariance (r, r) of an estimate, and the degrees of freedom it was estimated with."""

    covariance: Array
    freedom: float = np.inf

    @property
    def std(self) -> Array:
        """Standard deviations (r,)."""
        return np.sqrt(np.diag(self.covariance))

    def margins(self, level: float = LEVEL) -> Array:
        """Return half of the length (r,) of the confidence interval."""
        return coverage_factor(level, self.freedom) * self.std

    def interval(self, beta: Array, level: float = LEVEL) -> tuple[Array, Array]:
        """Return the confidence interval (low, high), (r,) each, by Student's distribution."""
        half_width = self.margins(level)
        return beta - half_width, beta + half_width


def coverage_factor(level: float, freedom: float) -> float:
    """Return the two-sided quantile of Student's distribution: half of the length of an interval of
    a confidence level, in standard deviations."""
    # stdtrit is not defined for infinity; at 1e9 Student's distribution is the normal one.
    return float(stdtrit(min(freedom, 1e9), 0.5 + 0.5 * level))
