"""Kalman filters: a step of six joints, and the compiled pass against the one in Python."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from sysid_bench.identification.estimators.filters import EKF, UKF
from sysid_bench.identification.simulation_based.compiled_filters import filters_library
from sysid_bench.simulation.plant_batch import lanes_library
from tests.experiments.experiment_world import SMOOTH, ready

Compare = Callable[..., dict[str, float]]
Line = Callable[..., None]


def test_filter_steps(compare: Compare, line: Line) -> None:
    if isinstance(lanes_library(), str) or filters_library() is None:
        pytest.skip("nothing is compiled")
    made = ready(
        robot=SMOOTH, rate=500.0, simulation={"use": "closed-loop", "rate": "1 kHz"},
        noise={"q": 2e-6, "tau_relative": 0.02},
        excitation={"use": "fourier", "period": "2 s", "cycles": 1},
        signals={"filter": "butter 4 20 Hz zero-phase", "derivatives": "from q"},
    )  # fmt: skip
    plain = replace(made.experiment, forward=None)
    functions = {}
    for name, method in (("EKF", EKF()), ("UKF", UKF())):
        functions[name] = lambda method=method: method.fit(made.experiment)
        functions[f"{name} in Python"] = lambda method=method: method.fit(plain)
    seconds = compare(functions, 4)
    for name, must in (("EKF", 6.0), ("UKF", 12.0)):
        step = 1e6 * seconds[name] / len(made.experiment.recording)
        parameters = made.problem.base.rank
        line(f"{name} step, six joints, {parameters} parameters, all of a fit", step, 50.0, 50.0,
             unit="us")  # fmt: skip
        line(f"{name} in Python / compiled", seconds[f"{name} in Python"] / seconds[name],
             must, must, True)  # fmt: skip
