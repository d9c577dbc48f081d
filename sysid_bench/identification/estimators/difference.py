"""Payload identification by the torque difference with and without the payload."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.identification.linear.least_squares import solve
from sysid_bench.identification.simulation_based.gauss_newton import (
    covariance,
    error_noise,
    floor_of,
    regressor_of,
    residual_factor,
    rows_of,
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
        loaded, bare = _recordings(experiment, True), _recordings(experiment, False)
        if not loaded or not bare:
            raise UnsupportedError(
                "The method needs the same motion without the payload: set "
                'signals = { runs = "AB" }, or "ABBA", and the task "payload".'
            )
        W = np.mean([regressor_of(experiment, one.motion) for one in loaded], axis=0)
        b = _mean_torque(experiment, loaded) - _mean_torque(experiment, bare)
        sigma = np.ones(b.shape[1])
        for _ in range(2):
            R = residual_factor(W / sigma[:, None], b / sigma)
            beta = solve(R)
            sigma = error_noise(b - W @ beta, floor_of(b))
        return Estimate(beta, covariance=covariance(R))


def _recordings(experiment: Experiment, loaded: bool) -> list[Recording]:
    return [run.recording for run in experiment.runs if run.loaded == loaded]


def _mean_torque(experiment: Experiment, recordings: list[Recording]) -> Array:
    """Measured torque (N, rows) minus that of the known parameters, mean over recordings."""
    parts = [rows_of(experiment, one.tau) - experiment.known(one.motion) for one in recordings]
    return np.asarray(np.mean(parts, axis=0))
