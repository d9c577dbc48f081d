"""Columns that are not what they are declared as: sizes, turns, derivatives; and columns that only
look like it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid_bench.diagnosis.channel_checks import (
    copied_channels,
    recorded_findings,
    spikes,
    touches,
    wrapped_channels,
)
from sysid_bench.diagnosis.contradictions import SURE, contradictions
from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import ERROR, WARNING, Finding
from sysid_bench.diagnosis.hypothesis import first_hypothesis
from sysid_bench.diagnosis.joint_checks import unsigned_torque
from sysid_bench.diagnosis.run_checks import diagnose
from sysid_bench.diagnosis.torque_candidates import torque_magnitude
from sysid_bench.errors import UsageError
from sysid_bench.signals.log import read_log
from sysid_bench.signals.log_checks import check_rates
from sysid_bench.signals.log_description import read_description
from sysid_bench.types import Array
from tests.diagnosis.test_diagnosis import evidence, log_of
from tests.robots import named_robot
from tests.signals.logs import Recorded, write

FIRST_MIDDLE_LAST = (0, 2, 5)


def errors(found: list[Finding]) -> list[Finding]:
    return [one for one in found if one.severity == ERROR]


def first_second(log: Recorded) -> Recorded:
    return Recorded(log.joints, log.t[:200], log.q[:200], log.v[:200], log.tau[:200])


def only(x: Array, j: int, changed: Array) -> Array:
    """Columns x with that of joint j changed."""
    x = x.copy()
    x[:, j] = changed
    return x


@pytest.mark.parametrize(
    ("name", "joint"),
    [("ur5", 0), ("ur5", 2), ("ur5", 5), ("xarm7", 0), ("xarm7", 3), ("xarm7", 6), ("z1", None),
     ("ur5", None), ("scara", None)],
)  # fmt: skip
def test_torques_without_sign_are_named(tmp_path: Path, name: str, joint: int | None) -> None:
    log, robot = log_of(name), named_robot(name)
    size = np.abs(log.tau)
    tau = size if joint is None else only(log.tau, joint, size[:, joint])
    found = errors(diagnose(evidence(tmp_path, replace(log, tau=tau), robot)))
    assert found[0].name == "magnitude"
    assert found[0].joints == (robot.rows if joint is None else (robot.rows[joint],))
    assert "columns" in found[0].edit


@pytest.mark.parametrize("joint", [1, pytest.param(5, marks=pytest.mark.long)])
def test_a_torque_without_sign_is_named_where_it_hardly_turns(tmp_path: Path, joint: int) -> None:
    """In one second the joint's own columns explain its torque with any signs."""
    log, robot = first_second(log_of("panda")), named_robot("panda")
    tau = only(log.tau, joint, np.abs(log.tau[:, joint]))
    made = evidence(tmp_path, replace(log, tau=tau), robot)
    assert not list(unsigned_torque(made))
    first = contradictions(made)[0]
    assert (first.name, first.joints, first.is_error) == ("magnitude", (robot.rows[joint],), True)


@pytest.mark.parametrize("joint", FIRST_MIDDLE_LAST)
def test_spikes_do_not_take_the_sign_of_a_torque(tmp_path: Path, joint: int) -> None:
    log, robot = log_of("ur5"), named_robot("ur5")
    x = log.tau[:, joint] - log.tau[:, joint].min()
    x[100::150] = 20 * np.sqrt((x**2).mean())
    assert touches(x) <= 1
    made = evidence(tmp_path, replace(log, tau=only(log.tau, joint, x)), robot)
    assert not list(unsigned_torque(made))


@pytest.mark.parametrize("name", ["ur5", "xarm7", "kinova", "z1", "rv2sq", "so100"])
@pytest.mark.parametrize("lift", [0.0, 1.0])
def test_a_torque_that_gravity_keeps_to_one_side_has_a_sign(
    tmp_path: Path, name: str, lift: float
) -> None:
    """Springs keep each torque positive, in two ways that come near zero: `lift` RMS above it."""
    log, robot = log_of(name), named_robot(name)
    rms = np.sqrt((log.tau**2).mean(axis=0))
    tau = log.tau - log.tau.min(axis=0) + (0.3 + lift) * rms
    made = evidence(tmp_path, replace(log, tau=tau), robot)
    assert not list(unsigned_torque(made))
    before = first_hypothesis(made)
    assert not [one for one in torque_magnitude(before) if one.evidence(before) > SURE]


@pytest.mark.parametrize("joint", FIRST_MIDDLE_LAST)
@pytest.mark.parametrize("ratio", [1.0, -50.0])
@pytest.mark.parametrize("with_v", [True, False])
def test_positions_within_one_turn_are_named(
    tmp_path: Path, joint: int, ratio: float, with_v: bool
) -> None:
    log, robot = log_of("ur5"), named_robot("ur5")
    motor = log.q[:, joint] * ratio
    wrapped = np.mod(motor - np.quantile(motor, 0.3), 2 * np.pi)
    changed = replace(log, q=only(log.q, joint, wrapped))
    ratios = np.where(np.arange(6) == joint, ratio, 1.0).tolist()
    given: dict[str, Any] = {} if with_v else {"v": None}
    path = write(tmp_path, changed, q={"ratio": ratios}, **given)
    first = errors(diagnose(DiagnoseInput(read_log(read_description(path), robot), robot)))[0]
    assert (first.name, first.joints) == ("wrapped", (robot.rows[joint],))
    assert first.edit == "q = { unwrap = true }"


def test_fast_and_spiking_positions_are_not_wrapped(tmp_path: Path) -> None:
    log, robot = log_of("ur5"), named_robot("ur5")
    spike = only(log.q, 1, log.q[:, 1] + 7.0 * (np.arange(len(log.q)) == 100))
    degrees = log.q * 180 / np.pi
    for q in (spike * 3, degrees, log.q + 2 * np.pi):
        made = evidence(tmp_path, replace(log, q=q, v=np.gradient(q, log.t, axis=0)), robot)
        assert not list(wrapped_channels(made))


@pytest.mark.parametrize("joint", FIRST_MIDDLE_LAST)
def test_velocities_that_are_positions_are_named(tmp_path: Path, joint: int) -> None:
    log, robot = log_of("ur5"), named_robot("ur5")
    rng = np.random.default_rng(joint)
    noisy = log.q[:, joint] + 1e-3 * rng.normal(size=len(log.q))
    found = list(
        copied_channels(evidence(tmp_path, replace(log, v=only(log.v, joint, noisy)), robot))
    )
    assert [one.joints for one in errors(found)] == [(robot.rows[joint],)]
    assert "v can be left out" in found[0].edit


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("noise", [0.01, 0.5])
def test_derivatives_of_the_motion_are_no_torques(tmp_path: Path, order: int, noise: float) -> None:
    log, robot = log_of("ur5"), named_robot("ur5")
    x = log.v if order == 1 else np.gradient(log.v, log.t, axis=0)
    noisy = x + noise * x.std(axis=0) * np.random.default_rng(0).normal(size=x.shape)
    (found,) = errors(list(copied_channels(evidence(tmp_path, replace(log, tau=noisy), robot))))
    assert found.joints == robot.rows
    assert ("accelerations" if order == 2 else "velocities") in found.message


@pytest.mark.parametrize("joint", FIRST_MIDDLE_LAST)
def test_a_constant_velocity_exchanges_no_columns(tmp_path: Path, joint: int) -> None:
    log, robot = log_of("ur5"), named_robot("ur5")
    still = replace(log, v=only(log.v, joint, 0.0 * log.t))
    assert not errors(diagnose(evidence(tmp_path, still, robot)))


@pytest.mark.parametrize("noisy", FIRST_MIDDLE_LAST)
def test_joints_that_move_alike_are_not_exchanged(tmp_path: Path, noisy: int) -> None:
    """One chirp moves all joints; the velocity of one is little but noise."""
    log, robot = log_of("ur5"), named_robot("ur5")
    chirp = 0.3 * np.sin(2 * np.pi * (0.2 * log.t + 0.1 * log.t**2))
    v = np.tile(np.gradient(chirp, log.t)[:, None], 6)
    rng = np.random.default_rng(noisy)
    v = only(v, noisy, 3 * v.std() * rng.normal(size=len(v)))
    alike = Recorded(log.joints, log.t, np.tile(chirp[:, None], 6), v, log.tau)
    found = read_log(read_description(write(tmp_path, alike)), robot).findings
    assert not [one.text for one in found if one.name == "velocity"]


@pytest.mark.parametrize("joint", FIRST_MIDDLE_LAST)
@pytest.mark.parametrize("stamped", [True, False])
def test_a_column_without_numbers_is_named(tmp_path: Path, joint: int, stamped: bool) -> None:
    log, robot = log_of("ur5"), named_robot("ur5")
    empty = replace(log, tau=only(log.tau, joint, np.full(len(log.t), np.nan)))
    timing: dict[str, Any] = {"time": 1, "rate": None} if stamped else {}
    description = read_description(write(tmp_path, empty, **timing))
    with pytest.raises(UsageError, match=f"tau of '{robot.rows[joint]}' has no numbers"):
        read_log(description, robot)


@pytest.mark.parametrize(("height", "severity"), [(8.0, WARNING), (1e5, ERROR), (1e200, ERROR)])
def test_spikes_that_are_most_of_a_channel_are_errors(
    tmp_path: Path, height: float, severity: str
) -> None:
    log, tau = log_of("ur5"), log_of("ur5").tau[:, 1].copy()
    tau[40::300] = height * np.sqrt((tau**2).mean())
    spiked = evidence(tmp_path, replace(log, tau=only(log.tau, 1, tau)), named_robot("ur5"))
    (found,) = spikes(spiked)
    assert (found.severity, found.joints) == (severity, log.joints[1:2])


@pytest.mark.parametrize(("rows", "severity"), [(6, WARNING), (400, ERROR)])
def test_few_samples_beyond_a_limit_are_no_wrong_unit(
    tmp_path: Path, rows: int, severity: str
) -> None:
    log, robot = log_of("ur5"), named_robot("ur5")
    tau = log.tau.copy()
    tau[100 : 100 + rows, 1] = 5 * robot.limits.tau[1]
    found = recorded_findings(evidence(tmp_path, replace(log, tau=tau), robot))
    assert [one.severity for one in found if one.name == "units"] == [severity]


def test_exchanged_columns_beyond_a_limit_are_exchanged_columns(tmp_path: Path) -> None:
    """The position of a hinge in the place of a slide is beyond its travel."""
    log, robot = log_of("scara"), named_robot("scara")
    order = [0, 2, 1, 3]
    exchanged = replace(log, q=log.q[:, order], v=log.v[:, order])
    first, *others = diagnose(evidence(tmp_path, exchanged, robot))
    assert (first.name, first.is_error) == ("columns", True)
    assert "units" in [one.name for one in others]


def test_velocities_of_other_joints_are_no_wrong_rate() -> None:
    """Two joints that move alike at two speeds, each with the velocity of the other."""
    t = np.arange(2000) / 200
    q = np.column_stack([np.sin(t), 0.5 * np.sin(t + 0.05)])
    v = np.column_stack([np.cos(t), 0.5 * np.cos(t + 0.05)])
    found, rate = check_rates(q, v[:, ::-1], 200.0, ("one", "two"))
    assert found
    assert {one.name for one in found} == {"velocity"}
    assert rate == 200.0
    (wrong,), _ = check_rates(q, 2 * v, 200.0, ("one", "two"))
    assert wrong.name == "rate"
