"""Coulomb friction in closed loop: `sign(v)` leaves sticking unexplained, and nothing else."""

import numpy as np
import pytest

from tests.experiments.experiment_world import ready

GUARD = 20
"""Samples around a slow one that may still be under its spell."""


@pytest.mark.parametrize(
    "robot", [pytest.param("dvrk_psm", marks=pytest.mark.long), "dvrk_mtm", "scara", "tx40"]
)
def test_moving_joints_obey_the_model(robot: str) -> None:
    """Residuals at the true parameters, over the joint's RMS torque: at most 0.06 %."""
    made = ready(
        robot=robot,
        simulation={"use": "closed-loop"},
        noise={},
        rate=1000.0,
        excitation={"use": "fourier", "harmonics": 3, "period": "5 s"},
        signals={"derivatives": "exact", "filter": "none"},
    )
    problem = made.problem
    W, b = problem.stacked
    assert problem.torque is not None
    beta = problem.base.K @ made.source.truth.theta
    left = (b - W @ beta).reshape(-1, len(problem.rows)) / problem.torque
    v = made.experiment.recording.v
    assert v is not None
    slow = (np.abs(v) < 0.01).any(axis=1)
    moving = np.convolve(slow, np.ones(2 * GUARD + 1), "same") == 0
    assert moving.mean() > 0.3
    assert np.sqrt((left[moving] ** 2).mean(axis=0)).max() <= 6e-4
