"""Problem of an experiment with the torque as measured, for methods that model its noise."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sysid_bench.types import Array, Experiment, Factor, Problem, RowBlock


def raw_problem(experiment: Experiment) -> Problem:
    """Return W beta = b with W along the measured, filtered motion and b the raw torque less that
    of the known parameters, at the samples of the filtered recording."""
    problem, raw, recording = experiment.problem, experiment.raw, experiment.recording
    # Half a step earlier: rounding of the times cannot select the next sample.
    samples = np.searchsorted(raw.t, recording.t - 0.5 / raw.rate)
    columns = [raw.rows.index(row) for row in problem.rows]
    motion = recording.motion
    b = raw.tau[samples][:, columns] - experiment.known(motion)

    def blocks() -> Iterator[RowBlock]:
        start = 0
        for W in experiment.regress(motion):
            yield W, b[start : start + len(W)]
            start += len(W)

    W = np.concatenate([block for block, _ in blocks()])
    factors = tuple(_factor(factor, W[:, j], b[:, j]) for j, factor in enumerate(problem.factors))
    return replace(problem, blocks=blocks, factors=factors, samples=len(b))


def _factor(factor: Factor, W: Array, b: Array) -> Factor:
    """R factor of all samples of one row."""
    rows = np.column_stack([W[:, factor.columns], b])
    return replace(factor, R=np.asarray(np.linalg.qr(rows, mode="r")), samples=len(b))
