"""Cramer-Rao bound of predictions at the noise that a repeated motion shows."""

from dataclasses import replace

import numpy as np

from sysid_bench.apps.twins.recorded_robot import Posed, RecordedRobot
from sysid_bench.apps.twins.residual_figures import residual_correlation_time
from sysid_bench.evaluation.cramer_rao import torque_bound
from sysid_bench.experiments.recorded.prepare import prepare_recordings
from sysid_bench.experiments.recorded.source import repetition_torque
from sysid_bench.types import Array


def repeat_bound(recorded: RecordedRobot) -> float | None:
    """Return the smallest torque error with which an unbiased fit of the training recordings can
    predict the test, were noise the only error; None where the test repeats no training motion.

    The noise of a joint is the difference of its torque at equal states of both recordings, over
    sqrt(2), taken as a first-order process. RMS over joints of the deviation of the prediction over
    the RMS torque.
    """
    posed = prepare_recordings(
        recorded.manifest,
        recorded.training,
        recorded.tests,
        replace(recorded.options, pipeline=None),
    )
    noise = _noise(posed)
    if noise is None:
        return None
    std, correlation = noise
    covariance = torque_bound((W for W, _ in posed.problem.blocks()), np.diag(std**2), correlation)
    if covariance is None:
        return None
    test = next(iter(posed.held_out.values()))
    variances = np.concatenate(
        [np.einsum("nij,jk,nik->ni", W, covariance, W) for W, _ in test.blocks()]
    )
    assert test.torque is not None
    return float(np.sqrt(np.mean(variances.mean(axis=0) / test.torque**2)))


def _noise(posed: Posed) -> tuple[Array, float] | None:
    """Standard deviations (rows,) and the correlation of consecutive samples; None without a
    repetition."""
    source, rows = posed.source, posed.problem.rows
    test = next(iter(source.tests.values()), None)
    found = None if test is None else repetition_torque(source.training, test, rows)
    if test is None or found is None:
        return None
    apart = (
        found - test.recording.tau[:, [test.robot.torque_rows.index(r) for r in rows]]
    ) / 2**0.5
    rate = test.recording.rate
    times = [residual_correlation_time(column, rate) for column in apart.T]
    seconds = float(np.exp(np.mean(np.log(times))))
    return np.maximum(apart.std(axis=0), 1e-9), float(np.exp(-1.0 / (rate * seconds)))
