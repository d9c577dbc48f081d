"""The mass of a load whose position is given, with an interval."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.experiments.recorded.prepared_logs import PreparedLogs, leave_one_fold_out
from sysid_bench.experiments.recorded.unknowns import MASS
from sysid_bench.identification.identify import identify
from sysid_bench.types import Array

CONFIDENCE: Final = 0.95


@dataclass(frozen=True)
class PayloadMass:
    """kg; `parts`: the mass with each part of the motion left out."""

    mass: float
    std: float
    interval: tuple[float, float]
    parts: tuple[float, ...]
    confidence: float = CONFIDENCE


def payload_mass(method: Any, posed: PreparedLogs, beta: Array) -> PayloadMass:
    """What the mass varies by when parts of the motion are left out (jackknife; Tukey 1958):
    residuals are no white noise, and a formal deviation would be too small by an order."""
    from scipy.stats import t

    place = posed.problem.base.names.index(MASS)
    found = []
    for problem in leave_one_fold_out(posed):
        estimate = identify(method, problem)
        if estimate.status != "ok" or estimate.beta is None:
            raise EstimationError(f"With a part of the motion left out: {estimate.reason}")
        found.append(float(estimate.beta[place]))
    n = len(found)
    std = float(np.sqrt((n - 1) / n * np.sum((np.array(found) - np.mean(found)) ** 2)))
    mass = float(beta[place])
    reach = float(t.ppf(0.5 + CONFIDENCE / 2, n - 1)) * std
    return PayloadMass(mass, std, (mass - reach, mass + reach), tuple(found))
