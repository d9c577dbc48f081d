"""Payload identification by the torque difference with and without the payload."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.identification.linear.normal_qr import solve
from sysid_bench.identification.simulation_based.gauss_newton import (
    covariance,
    floor_of,
    regressor_of,
    residual_factor,
    rows_of,
    sigmas,
)
from sysid_bench.types import Array, Estimate, Experiment, Recording


@dataclass(frozen=True)
class Difference:
    """W beta = mean(tau with payload) - mean(tau without), W the payload's regressor.

    W is taken along the loaded motion; rows of joint j are divided by sigma_j, from the residuals
    of a first fit. The arm's own dynamics cancel where it moves alike with and without the payload;
    where it does not, its known parameters correct the difference. Recordings in the order without,
    with, with, without ("ABBA") cancel linear drift. Closed form by QR. Assumes W exact and white
    noise per joint.
    """

    def fit(self, experiment: Experiment) -> Estimate:
        """Return beta and its covariance; raises UnsupportedError without a recording of each kind,
        EstimationError where the motion does not excite every direction."""
        loaded = [run.recording for run in experiment.runs if run.loaded]
        bare = [run.recording for run in experiment.runs if not run.loaded]
        if not loaded or not bare:
            raise UnsupportedError(
                "The method needs the same motion without the payload: set "
                'signals = { runs = "AB" }, or "ABBA", and the task "payload".'
            )
        W = _mean([regressor_of(experiment, one.motion) for one in loaded])
        b = _mean([_left(experiment, one) for one in loaded])
        b = b - _mean([_left(experiment, one) for one in bare])
        sigma = np.ones(b.shape[1])
        for _ in range(2):
            R = residual_factor(W / sigma[:, None], b / sigma)
            beta = solve(R)
            sigma = sigmas(b - W @ beta, floor_of(b))
        return Estimate(beta, covariance=covariance(R))


def _left(experiment: Experiment, recording: Recording) -> Array:
    """Measured torque (N, rows) minus that of the known parameters."""
    return np.asarray(rows_of(experiment, recording.tau) - experiment.known(recording.motion))


def _mean(arrays: list[Array]) -> Array:
    return np.asarray(np.mean(arrays, axis=0))
