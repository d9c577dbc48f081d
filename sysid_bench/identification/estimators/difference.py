"""The payload from two recordings of one motion: loaded less bare."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.identification.linear.normal_qr import solve
from sysid_bench.identification.simulation_based.gauss_newton import (
    accumulated_factor,
    covariance,
    floor_of,
    regressor_along,
    rows_of,
    sigmas,
)
from sysid_bench.types import Array, Estimate, Experiment, Recording


@dataclass(frozen=True)
class Difference:
    """W beta = mean of the loaded torques - mean of the bare ones, W the payload's regressor along
    the loaded motion; rows of joint j divided by sigma_j (as `wls`).

    The arm drops out, whatever is known of it, where it moves alike with and without the payload;
    where a controller lets it move a little differently, what is known of it corrects for that.
    Recordings in the order bare, loaded, loaded, bare (ABBA) cancel what drifts linearly.
    """

    def fit(self, experiment: Experiment) -> Estimate:
        """The estimate; raises UnsupportedError without a bare recording."""
        loaded = [run.recording for run in experiment.runs if run.loaded]
        bare = [run.recording for run in experiment.runs if not run.loaded]
        if not loaded or not bare:
            raise UnsupportedError(
                "The difference needs the same motion without the payload: ask for it with "
                'signals = { runs = "AB" }, or "ABBA", and the task "payload".'
            )
        W = _mean([regressor_along(experiment, one.motion) for one in loaded])
        b = _mean([_left(experiment, one) for one in loaded])
        b = b - _mean([_left(experiment, one) for one in bare])
        sigma = np.ones(b.shape[1])
        for _ in range(2):
            R = accumulated_factor(W / sigma[:, None], b / sigma)
            beta = solve(R)
            sigma = sigmas(b - W @ beta, floor_of(b))
        return Estimate(beta, covariance=covariance(R))


def _left(experiment: Experiment, recording: Recording) -> Array:
    """Torque (N, rows) less that of what is known."""
    return rows_of(experiment, recording.tau) - experiment.known(recording.motion)


def _mean(arrays: list[Array]) -> Array:
    return np.asarray(np.mean(arrays, axis=0))
