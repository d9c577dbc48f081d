"""Laws of the samples along which models are run on recordings."""

from dataclasses import replace

import numpy as np
import pytest

from sysid_bench.identification.linear.least_squares import RMS_TORQUE, row_std, torque_rms
from sysid_bench.identification.simulation_based.measured_motion import is_of_terms, mean_torque
from sysid_bench.signals.log_controller import CONTROL_RATE, control_steps
from tests.closeness import assert_close

from ..robots import named_robot
from .test_least_squares import noisy


@pytest.mark.parametrize("step", [1, 2, 3, 4, 5, 10])
def test_an_average_does_not_delay(step: int) -> None:
    ramp = np.column_stack([np.arange(100.0), 3.0 - 2.0 * np.arange(100.0)])
    found = mean_torque(ramp, step)
    assert found.shape == ramp[::step].shape
    inner = slice(1, -1)  # beyond the ends there is nothing to average
    np.testing.assert_allclose(found[inner], ramp[::step][inner], atol=1e-12)


@pytest.mark.parametrize("step", [2, 3, 4, 8])
def test_an_average_of_white_noise_has_less_of_it(step: int) -> None:
    noise = np.random.default_rng(0).normal(size=(40_000, 1))
    assert mean_torque(noise, step).var() == pytest.approx(1.0 / step, rel=0.3)


@pytest.mark.parametrize("rate", [50.0, 100.0, 125.0, 200.0, 250.0, 400.0, 500.0, 1000.0])
def test_the_control_rate_does_not_depend_on_the_last_digit_of_a_stamp(rate: float) -> None:
    t = np.arange(5000) / rate
    stamped = 1.0 / float(np.median(np.diff(t)))
    epoch = 1.0 / float(np.median(np.diff(np.round(1.7e9 + t, 6))))
    exact = int(np.ceil(CONTROL_RATE / rate))
    assert {control_steps(one) for one in (rate, stamped, epoch)} == {exact}


def test_a_rate_above_that_of_control_is_its_own() -> None:
    assert control_steps(2000.0) == 1
    assert control_steps(900.0) == 2


def test_friction_due_to_another_joint_is_viscous() -> None:
    robot = named_robot("ur5")
    one, other = robot.rows[:2]
    viscous = [f"{one}.fv", f"{one}.fv.{other}"]
    assert all(is_of_terms(name, ("fv",)) for name in viscous)
    assert not any(is_of_terms(name, ("fc", "k", "Ia")) for name in viscous)
    assert not is_of_terms(f"{one}.offset", ("fv", "fc"))


def test_an_idle_joint_changes_no_weight_of_the_others() -> None:
    problem = noisy()
    idle = replace(problem.factors[-1], R=0.0 * problem.factors[-1].R)
    changed = replace(problem, factors=(*problem.factors[:-1], idle))
    assert torque_rms(changed)[-1] == 0.0
    found = row_std(changed, RMS_TORQUE)
    torque = torque_rms(changed)[:-1]
    assert_close(found[:-1] / torque, found[0] / torque[0])
    assert (found > 0).all()
