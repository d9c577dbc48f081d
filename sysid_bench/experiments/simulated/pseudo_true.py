"""Pseudo-true parameters of a plant that the model does not contain."""

from functools import lru_cache
from typing import Final

from sysid_bench.experiments.pooled_problem import pooled
from sysid_bench.experiments.seed import other_motion_seed
from sysid_bench.experiments.simulated.noise_free import NoiseFreePart
from sysid_bench.identification.linear.least_squares import scaled_fit
from sysid_bench.signals.row_processing import RowProcessing
from sysid_bench.types import Array, Problem

MOTIONS_OF_LIMIT: Final = 20
"""Further motions: many in comparison with those of the training."""

HOW: Final = f"pseudo-true: weighted least squares on exact data of {MOTIONS_OF_LIMIT} motions"


@lru_cache(maxsize=2)
def pseudo_true(noise_free: NoiseFreePart, rows: RowProcessing) -> Array | None:
    """beta (r,) that weighted least squares finds on exact data of many further motions of the
    training's excitation; None where the model contains the plant.

    `rows`: slow rows count as in the training. Neither noise nor a filter of signals is involved.
    """
    if noise_free.simulated.built.is_matched:
        return None
    further = [_exact_problem(noise_free, rows, index) for index in range(MOTIONS_OF_LIMIT)]
    return scaled_fit(pooled(further))[0]


def _exact_problem(noise_free: NoiseFreePart, rows: RowProcessing, index: int) -> Problem:
    spec, builder = noise_free.spec, noise_free.builder
    seed = other_motion_seed(spec, index)
    motion, measured = noise_free.exact(noise_free.simulated.along(spec.excitation, seed))
    slow = RowProcessing(standstill=rows.standstill, weight=rows.weight)
    return builder.build(motion, measured, rows=builder.rows_along(motion, slow))
