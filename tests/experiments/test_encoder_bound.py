"""The bound with noisy encoders stands beside that of torque noise where both are known."""

from itertools import pairwise

import numpy as np
import pytest

from sysid_bench.experiments.simulated.source import SimulatedSource
from tests.experiments.experiment_world import ready


def source(robot: str = "ur5", repeat: int = 0, **noise: float) -> SimulatedSource:
    return ready(robot=robot, repeat=repeat, noise={"tau_relative": 0.01, **noise}).source


@pytest.mark.parametrize("robot", ["ur5", "z1"])
def test_noisier_encoders_never_lower_the_bound(robot: str) -> None:
    made = [source(robot, q=q) for q in (1e-9, 1e-5, 1e-4, 1e-3)]
    ratios = []
    for one in made:
        assert one.bound is not None
        assert one.encoder_bound is not None
        ratios.append(one.encoder_bound / one.bound)
    # Without encoder noise: that of torque noise, but for the first and the last sample.
    assert (ratios[0] > 1.0).all()
    assert np.median(ratios[0]) < 1.02
    for less, more in pairwise(ratios):
        assert (more > less).all()


def test_it_is_left_out_where_it_does_not_hold() -> None:
    assert source().encoder_bound is None  # exact encoders
    assert source(q=1e-5, quantum=1e-5).encoder_bound is None
    assert source(q=1e-5, tau_correlation=0.5).encoder_bound is None
    assert source(repeat=1, q=1e-5).encoder_bound is None
    assert ready(robot="ur5", noise={"q": 1e-5}).source.encoder_bound is None
