"""Gain, encoder bias and friction that grows with the load: found where they are, and simulated."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sysid_bench
from sysid_bench.apps.actuators.bounded_fit import holds
from sysid_bench.apps.actuators.commands.actuators_result import ActuatorsResult
from sysid_bench.apps.actuators.commands.servo_result import MORE_NAMES
from sysid_bench.apps.actuators.drive_estimate import DriveEstimate, identify_recordings
from sysid_bench.apps.actuators.drive_rows import DriveRows, drive_rows
from sysid_bench.apps.actuators.rollout import simulated_positions
from sysid_bench.errors import EstimationError, SimulationError, UnsupportedError, UsageError
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.signals.position_control import mean_of_held
from sysid_bench.types import Array
from tests.actuators.leg import JOINTS, MODEL, RATE, Case, leg

TRUTHS = {"gain": 1.15, "bias": 0.06, "load": 0.12}
DEVIATIONS = {"gain": 0.03, "bias": 0.03, "load": 0.06}
"""Errors that are allowed of the joint that carries the most, the thigh."""

SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, 10))]


def case_of(name: str, seed: int) -> Case:
    """A recording of a leg with one of the further values, by slow friction and much gravity."""
    return Case(seed, delay=0.004, more=((name, TRUTHS[name]),), disturbance=0.03)


def found_in(case: Case, more: tuple[str, ...], shared: tuple[str, ...] = ()) -> DriveEstimate:
    """The actuators of a case at its delay, with further unknowns."""
    log = case.log()

    def rows_at(bias: Array | None) -> DriveRows:
        return drive_rows(leg(), log, JOINTS, more=more, bias=bias)

    return identify_recordings(rows_at, shared, case.delay)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", TRUTHS)
def test_a_further_value_is_found(name: str, seed: int) -> None:
    case = case_of(name, seed)
    found = found_in(case, (name,))
    thigh = JOINTS.index("thigh")
    assert found.other_values[name][thigh] == pytest.approx(TRUTHS[name], abs=DEVIATIONS[name])
    assert 0.0 < found.fit.more_std[thigh, 0] < DEVIATIONS[name]
    # Without it, the torque is explained less well.
    plain = found_in(case, ())
    assert (found.fit.errors <= plain.fit.errors + 1e-9).all()
    armature = np.abs(found.fit.values[thigh, 0] / case.values[thigh, 0] - 1.0)
    assert armature < 0.12


def test_joints_of_one_pattern_share_gain_and_load(tmp_path: Path) -> None:
    found = found_in(case_of("gain", 1), ("load", "gain", "bias"), ("[th]*",))
    for name in ("gain", "load"):
        assert (
            found.other_values[name][0]
            == found.other_values[name][1]
            != found.other_values[name][2]
        )
    assert found.other_values["bias"][0] != found.other_values["bias"][1]
    assert found.fit.more.shape == (len(JOINTS), 3)
    assert holds("FL_calf_joint", "*_calf_*")
    assert not holds("FL_calf_joint", "calf_*")


@pytest.mark.parametrize("name", TRUTHS)
def test_the_simulation_has_the_further_value(name: str) -> None:
    case = case_of(name, 2)
    commands, part = case.log().commands, slice(200, 800)
    assert commands is not None
    drives = case.drives
    errors = [
        np.sqrt(np.mean((simulated_positions(leg(), one, commands, part) - commands.q[part]) ** 2))
        for one in (drives, type(drives)(JOINTS, case.values, case.delay))
    ]
    assert errors[0] < 0.7 * errors[1]


def test_identify_takes_further_unknowns(tmp_path: Path) -> None:
    case, file = case_of("gain", 3), tmp_path / "leg.xml"
    file.write_text(MODEL, encoding="utf-8")
    commands = case.log().commands
    assert commands is not None
    pd = {"q_des": "q_des", "kp": "kp", "kd": "kd", "delay": "4 ms"}
    data = {name: getattr(commands, name) for name in ("q", "q_des", "kp", "kd")}
    keys = {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": pd}}
    log = sysid_bench.log_of(data, keys)

    def identified(also: str, out: str) -> ActuatorsResult:
        result = sysid_bench.identify(
            file, task="actuators", log=log, also=also.split(","), model_out=tmp_path / out
        )
        assert isinstance(result, ActuatorsResult)
        return result

    result = identified("gain,bias", "out.xml")
    assert set(result.terms) >= {"gain", "bias"}
    assert result.written is not None
    assert result.written["gap"] < 1e-6
    assert "torque over that of the stated gains" in result.summary()
    with pytest.raises(UnsupportedError, match="load"):
        identified("load", "other.xml")
    with pytest.raises(UsageError, match="gains"):
        identified("gains", "other.xml")


@pytest.fixture(scope="module")
def leg_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("leg") / "leg.xml"
    file.write_text(MODEL, encoding="utf-8")
    return file


def log_with(case: Case, signs: Array, **pd: object) -> LogDescription:
    """The recording with its commands times signs (3,)."""
    commands = case.commands()
    data = {name: getattr(commands, name) for name in ("q", "q_des", "kp", "kd")}
    data["q_des"] = data["q_des"] * signs
    controller = {"q_des": "q_des", "kp": "kp", "kd": "kd", "delay": "4 ms", **pd}
    return sysid_bench.log_of(
        data, {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": controller}}
    )


def test_further_values_of_several_recordings_have_deviations(leg_file: Path) -> None:
    logs = [log_with(case_of("gain", seed), np.ones(3)) for seed in range(3)]
    result = sysid_bench.identify(leg_file, task="actuators", log=logs, also=["gain"])
    assert isinstance(result, ActuatorsResult)
    assert result.std_from == "files"
    assert result.joints["thigh"]["std"]["gain"] > 0.0
    assert result.files is not None
    between = result.files["joints"]["thigh"]["gain"]
    # Legs of other seeds have other friction: only what each file gives is one gain.
    assert between["mean"] == pytest.approx(TRUTHS["gain"], abs=DEVIATIONS["gain"])
    assert between["low"] < between["mean"] < between["high"]
    assert MORE_NAMES["gain"] in result.summary()


@pytest.mark.parametrize("joint", range(3))
def test_commands_that_drive_a_joint_away_are_refused(leg_file: Path, joint: int) -> None:
    signs = np.where(np.arange(3) == joint, -1.0, 1.0)
    log = log_with(Case(0, delay=0.004, disturbance=0.03), signs, limit=50.0)
    with pytest.raises(EstimationError, match=rf"gains.*{JOINTS[joint]}"):
        sysid_bench.identify(leg_file, task="actuators", log=log, also=["gain"], accept=ACCEPTED)


ACCEPTED = ["columns", "delay", "direction", "gain", "sign"]


@pytest.mark.parametrize("joint", range(3))
def test_a_limit_without_any_torque_is_refused(joint: int) -> None:
    case = Case(0, delay=0.0)
    commands = case.log().commands
    assert commands is not None
    limit = np.where(np.arange(3) == joint, 1e-30, 50.0)
    with pytest.raises(SimulationError, match=rf"{JOINTS[joint]}.*limit"):
        simulated_positions(leg(), case.drives, replace(commands, limit=limit), slice(0, 100))


@pytest.mark.parametrize("shift", [-2.3, -1.0, -0.6])
def test_commands_ahead_of_their_stamps_hold_the_last_one(shift: float) -> None:
    x = np.arange(5.0)[:, None]
    mean = mean_of_held(x, shift)
    assert mean[-1] == x[-1]
    assert (np.diff(mean, axis=0) >= 0).all()


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("also", [["gain"], pytest.param(["gain", "bias"], marks=pytest.mark.long)])
@pytest.mark.parametrize("joint", range(3))
def test_joints_without_motion_and_command_leave_no_warning(
    leg_file: Path, joint: int, also: list[str]
) -> None:
    case = Case(0, delay=0.004, seconds=4.0)
    commands = case.commands()
    data = {name: getattr(commands, name).copy() for name in ("q", "q_des", "kp", "kd")}
    data["q"][:, joint] = data["q_des"][:, joint] = 0.0
    pd = {"q_des": "q_des", "kp": "kp", "kd": "kd", "delay": "profile"}
    log = sysid_bench.log_of(data, {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": pd}})
    result = sysid_bench.identify(
        leg_file, task="actuators", log=[log] * 3, also=also, accept=[*ACCEPTED, "worse"]
    )
    assert isinstance(result, ActuatorsResult)
    # Joints with one stated kp have one gain, which those that move give.
    (gain,) = {one["gain"] for one in result.joints.values()}
    assert 0.5 < gain < 2.0
    assert np.isfinite([one["Ia"] for one in result.joints.values()]).all()
