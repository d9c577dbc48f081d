"""Whether a test log goes where the training went, and how well the robot repeats itself there."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.experiments.recorded.preprocess import ProcessedLog
from sysid_bench.types import Array

if TYPE_CHECKING:
    pass

REPEATS: Final = 0.05
"""A test motion whose states (q, v in units of their spread) lie nearer than this to training
states, in the median, is the training motion again (measured: 0.02 against 0.3 and more)."""


def repeatability_error(
    training: Sequence[ProcessedLog], test: ProcessedLog, rows: Sequence[str]
) -> dict[str, float] | None:
    """{joint: relative error} of the training torque at the nearest state of the training, in place
    of a model: what no model of a state can be much better than. None where the test goes
    elsewhere, or with another load."""
    same = [log for log in training if log.payload == test.payload]
    if not same:
        return None
    found = [_nearest(log, test) for log in same]
    distance, near, log = min(
        ((float(np.median(d)), i, log) for (d, i), log in zip(found, same, strict=True)),
        key=lambda one: one[0],
    )
    if distance >= REPEATS:
        return None
    at = [test.robot.torque_rows.index(row) for row in rows]
    measured = test.recording.tau[:, at]
    errors = np.linalg.norm(log.recording.tau[near][:, at] - measured, axis=0)
    sizes = np.linalg.norm(measured, axis=0)
    return {row: float(e / s) for row, e, s in zip(rows, errors, sizes, strict=True) if s > 0}


def _nearest(one: ProcessedLog, other: ProcessedLog) -> tuple[Array, Array]:
    """Distance of every state (q, v) of another log from the nearest of this one, and its place."""
    from scipy.spatial import cKDTree

    spread = np.concatenate([one.recording.q.std(axis=0), one.recording.motion.v.std(axis=0)])
    moves = spread > 0

    def states(log: ProcessedLog) -> Any:
        motion = log.recording.motion
        x = np.concatenate([motion.q, motion.v], axis=1)
        return x[:, moves] / spread[moves]

    tree: cKDTree = cKDTree(states(one))
    distance, near = tree.query(states(other))
    return distance / np.sqrt(moves.sum()), np.asarray(near)
