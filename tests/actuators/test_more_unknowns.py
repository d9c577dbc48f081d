"""Gain, encoder bias and friction that grows with the load: found where they are, and simulated."""

from pathlib import Path

import numpy as np
import pytest

import sysid_bench
from sysid_bench.apps.actuators.bounded_fit import holds
from sysid_bench.apps.actuators.drive_estimate import DriveEstimate, identify_recordings
from sysid_bench.apps.actuators.drive_rows import DriveRows, drive_rows
from sysid_bench.apps.actuators.rollout import simulated_positions
from sysid_bench.errors import UnsupportedError, UsageError
from sysid_bench.types import Array
from sysid_bench.verbs.identify.actuators_result import ActuatorsResult
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
