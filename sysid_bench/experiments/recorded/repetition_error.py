"""Repeatability: test logs that repeat the training motion, and the error of doing so."""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Final

import numpy as np

from sysid_bench.experiments.recorded.process_log import ProcessedLog
from sysid_bench.types import Array

REPEATS: Final = 0.05
"""Largest median distance of test states from training states (q, v in units of their standard
deviation) for the same motion (measured: 0.02 for the same, 0.3 and more for others)."""


def repetition_error(
    training: Sequence[ProcessedLog], test: ProcessedLog, rows: Sequence[str]
) -> dict[str, float] | None:
    """{joint: relative error} of predicting the test torque by the training torque at the nearest
    state: no model of a state can be much better.

    None where the test motion is another one, or has another payload.
    """
    repeated = repetition_torque(training, test, rows)
    if repeated is None:
        return None
    measured = test.recording.tau[:, [test.robot.torque_rows.index(row) for row in rows]]
    errors = np.linalg.norm(repeated - measured, axis=0)
    sizes = np.linalg.norm(measured, axis=0)
    return {row: float(e / s) for row, e, s in zip(rows, errors, sizes, strict=True) if s > 0}


def repetition_torque(
    training: Sequence[ProcessedLog], test: ProcessedLog, rows: Sequence[str]
) -> Array | None:
    """Return the training torque (N, rows) at the state nearest to each test sample; None where the
    test motion is another one, or has another payload."""
    matches = [_nearest(log, test) for log in training if log.payload == test.payload]
    match = min(matches, key=attrgetter("distance"), default=None)
    if match is None or match.distance >= REPEATS:
        return None
    if not set(rows) <= set(test.robot.torque_rows):
        return None  # the wrench of a sensor
    return np.asarray(match.tau[:, [test.robot.torque_rows.index(row) for row in rows]])


@dataclass(frozen=True, eq=False)
class _Match:
    """Median distance of the states of a test log from the nearest ones of a training log, and the
    torque (N, n) of the latter."""

    distance: float
    tau: Array


def _nearest(one: ProcessedLog, other: ProcessedLog) -> _Match:
    """The states (q, v) of one log that are nearest to those of another."""
    from scipy.spatial import cKDTree

    # rad, m and rad/s have no common norm: each coordinate is in units of its deviation.
    spread = np.concatenate([one.recording.q.std(axis=0), one.recording.motion.v.std(axis=0)])
    moves = spread > 0  # a joint that stands still has no unit

    def states(log: ProcessedLog) -> Any:
        motion = log.recording.motion
        x = np.concatenate([motion.q, motion.v], axis=1)
        return x[:, moves] / spread[moves]

    tree: cKDTree = cKDTree(states(one))
    distance, near = tree.query(states(other))
    # Per coordinate, so that the threshold does not depend on the number of joints.
    return _Match(float(np.median(distance / np.sqrt(moves.sum()))), one.recording.tau[near])
