"""Sampling rate without measured velocities: inertial against gravitational torques."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

from sysid_bench.diagnosis.hypothesis import Candidate, Hypothesis

FACTORS: Final = (0.01, 0.1, 0.2, 0.25, 0.5, 2.0, 4.0, 5.0, 10.0, 100.0)
"""True over declared rate: halved, doubled, tenfold, and what lies between."""
BLIND: Final = "slow motion, whose torques are gravity and friction alone"


def sampling_rate(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates with another rate, for recordings without velocities; the reader checks the
    rate of others."""
    e = before.evidence
    if e.log.measured_rate is not None:
        return
    W = e.regressor(before.motion)
    gravity = e.regressor(replace(before.motion, v=0 * before.motion.v, a=0 * before.motion.a))
    for factor in FACTORS:
        # Inertial and Coriolis torques are quadratic in the rate; gravity does not depend on it.
        columns = gravity + factor**2 * (W - gravity)
        rate = factor * e.rate
        yield Candidate(
            name="rate",
            joints=tuple(range(e.count)),
            hypothesis=before.with_columns(columns, before.motion.with_rate(factor)),
            message=f"inertial torques fit a rate of about {rate:.4g} Hz, not {e.rate:.4g} Hz",
            edit=f'rate = "{rate:.4g} Hz"',
            blind=BLIND,
        )
