"""Fields of a row about the intervals of an estimate: what they hold, and what they cannot know."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sysid_bench.evaluation.covariance import motion_fit
from sysid_bench.evaluation.interval_figures import (
    TrueValues,
    interval_fields,
    torque_coverage,
)
from sysid_bench.evaluation.intervals import StandardError, held
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.types import Array, Estimate, Row


@dataclass(frozen=True, eq=False)
class IntervalScore:
    """Confidence intervals of `beta` (r,) by kind, and the values that they should hold."""

    beta: Array
    errors: Mapping[str, StandardError]
    targets: TrueValues

    def of_parameter(self, index: int) -> Row:
        """Class of one parameter, and for each kind 1 where its interval holds the value."""
        hits = {
            f"held_{kind}": int(held(error, self.beta, self.targets.values)[index])
            for kind, error in self.errors.items()
        }
        return {"class": str(self.targets.classes[index]), **hits}


def interval_rows(
    intervals: IntervalScore | None, prepared: ExperimentData[Any], estimate: Estimate
) -> Row:
    """Coverage, width and score of the intervals by class of parameters, the share of held-out
    torque inside of prediction intervals (`torque_inside`, and by row `inside`), and the reason
    where several motions give no interval."""
    if intervals is None:
        return {}
    problem = prepared.problem
    row: Row = interval_fields(problem, intervals.beta, intervals.errors, intervals.targets)
    fits = motion_fit(problem, estimate)
    if isinstance(fits, str):
        return row | ({"no_motions_interval": fits} if problem.motions else {})
    if prepared.held_out:
        inside = torque_coverage(fits, prepared.held_out)
        row |= {"torque_inside": float(np.mean(inside)), "inside": inside}
    return row


def with_joints(scores: Mapping[str, Any], fields: Row) -> Row:
    """The scores and further fields, `inside` (rows,) of them among those of the joints."""
    inside = fields.pop("inside", None)
    if inside is None:
        return {**scores, **fields}
    pairs = zip(scores["joints"], inside, strict=True)
    joints = tuple({**joint, "inside": float(share)} for joint, share in pairs)
    return {**scores, **fields, "joints": joints}
