"""Tables of motors: their numbers, their limits in fits and simulations, and their armatures."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sysid_bench
from sysid_bench.apps.actuators.drive_estimate import DriveEstimate, identify_drives
from sysid_bench.apps.actuators.drive_rows import drive_rows
from sysid_bench.errors import UsageError
from sysid_bench.models.motor_table import motor_names, read_motors
from sysid_bench.signals.log import Log, read_log
from sysid_bench.signals.log_data import log_of
from sysid_bench.signals.position_control import Commands
from tests.actuators.leg import JOINTS, MODEL, RATE, Case, leg

SLOW = Case(2, delay=0.004, gains=((1.0, 1.0),), smooth=True)


def test_tables_hold_their_rated_points() -> None:
    motors = motor_names()
    assert len(motors) > 10
    for one in motors.values():
        keys = one.keys
        assert keys.peak_torque <= one.stall_torque
        assert keys.rotor_inertia is not None
        assert one.armature >= keys.rotor_inertia[0] * np.prod(keys.ratio) ** 2 * (1 - 1e-12)
        if keys.rated_torque is not None and keys.rated_speed is not None:
            line = one.stall_torque * (1.0 - keys.rated_speed / one.no_load_speed)
            assert keys.rated_torque <= line * (1 + 1e-12)
    # Two stages: J0 (r1 r2)^2 + J1 r2^2 + J2.
    assert motors["unitree-7520-22"].armature == pytest.approx(
        0.489e-4 * 22.5**2 + 0.109e-4 * 25.0 + 0.738e-4
    )


def table(folder: Path, **motors: dict[str, Any]) -> None:
    """A file of motors in ./motors."""
    (folder / "motors").mkdir()
    lines = [
        f"[motor.{name}]\n" + "\n".join(f"{key} = {value}" for key, value in keys.items())
        for name, keys in motors.items()
    ]
    (folder / "motors" / "own.toml").write_text("\n".join(lines), encoding="utf-8")


def log(commands: Commands, **pd: Any) -> Log:
    """A log of commands with a motor."""
    controller = {"q_des": "q_des", "kp": "kp", "kd": "kd", "delay": "profile", **pd}
    keys = {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": controller}}
    data = {name: getattr(commands, name) for name in ("q", "q_des", "kp", "kd")}
    return read_log(log_of(data, keys), leg())


def found(of: Log) -> DriveEstimate:
    return identify_drives(drive_rows(leg(), of, JOINTS))


def weak_recording(seed: int) -> tuple[Case, Commands]:
    """A recording of motors whose torque falls to zero at 6 rad/s."""
    case = Case(seed, delay=0.004, disturbance=0.03)
    line = np.tile([[9.0], [6.0]], (1, len(JOINTS)))
    weak = replace(case.commands(), limit=np.full(len(JOINTS), 6.0), line=line)
    return case, replace(case.moved(weak, np.random.default_rng(seed)), line=None)


WEAK = {"peak_torque": 6.0, "rated_torque": 4.5, "rated_speed": 3.0, "no_load_speed": 6.0}


@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.long) for n in (1, 2, 3))])
def test_torque_is_limited_along_the_line_of_its_motor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    table(tmp_path, weak=WEAK)
    monkeypatch.chdir(tmp_path)
    case, commands = weak_recording(seed)
    with_line, without = (found(log(commands, **pd)) for pd in ({"motor": "weak"}, {"limit": 6.0}))
    errors = [np.abs(one.fit.values - case.values).max(axis=0) for one in (with_line, without)]
    assert (errors[0][:2] < [0.003, 0.02]).all()
    assert errors[0][1] < 0.5 * errors[1][1]
    assert with_line.delay == pytest.approx(case.delay, abs=1e-3)


def test_a_diagnosis_knows_what_a_motor_can_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table(tmp_path, weak=WEAK, slow={**WEAK, "rated_speed": 1.0, "no_load_speed": 2.0})
    monkeypatch.chdir(tmp_path)
    (tmp_path / "leg.xml").write_text(MODEL, encoding="utf-8")
    commands = Case(0, delay=0.0, disturbance=0.03).commands()

    def messages(name: str) -> str:
        description = log(commands, motor=name).description
        findings = sysid_bench.diagnose(description, tmp_path / "leg.xml").findings
        return " ".join(one["message"] for one in findings if one["name"] == "limits")

    assert "without load" in messages("slow")
    assert "torque limit" in messages("weak")
    assert "motor" not in messages("dm-j8009-2ec-48v")


@pytest.mark.parametrize(
    "seed", [2, *(pytest.param(n, marks=pytest.mark.long) for n in range(3, 9))]
)
def test_the_armature_of_a_table_tells_a_confounded_delay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    case = replace(SLOW, seed=seed)
    keys = {"peak_torque": 1e3, "spread": 0.05}
    table(tmp_path, **{
        name: {**keys, "rotor_inertia": value}
        for name, value in zip(JOINTS, case.values[:, 0], strict=True)
    })  # fmt: skip
    monkeypatch.chdir(tmp_path)
    plain, informed = (found(log(case.commands(), **pd)) for pd in ({}, {"motor": list(JOINTS)}))
    assert plain.separation is not None
    assert plain.separation.is_open
    for one in (plain, informed):
        assert one.fit.values.shape == (len(JOINTS), 4)
    errors = [np.abs(one.fit.values[:, 0] / case.values[:, 0] - 1.0) for one in (plain, informed)]
    assert errors[1].max() < max(0.1, 0.5 * errors[0].max())
    assert np.nanmax(informed.std[:, 0]) < np.nanmax(plain.std[:, 0])


def test_clear_data_outweigh_a_wrong_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = Case(5, delay=0.006)
    wrong = {f"w{j}": {"peak_torque": 1e3, "rotor_inertia": 1.5 * float(value), "spread": 0.5}
             for j, value in enumerate(case.values[:, 0])}  # fmt: skip
    table(tmp_path, **wrong)
    monkeypatch.chdir(tmp_path)
    plain, informed = (
        found(log(case.commands(), **pd)).fit.values[:, 0] for pd in ({}, {"motor": list(wrong)})
    )
    assert (np.abs(informed - plain) < 0.1 * np.abs(1.5 * case.values[:, 0] - plain)).all()


def test_the_answer_and_the_catalogue_name_motors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table(tmp_path, own={"peak_torque": 50.0, "rotor_inertia": 1e-4, "ratio": 10})
    monkeypatch.chdir(tmp_path)
    (tmp_path / "leg.xml").write_text(MODEL, encoding="utf-8")
    description = log(Case(5, delay=0.006, seconds=6.0).commands(), motor=["own", "", "own"])
    result = sysid_bench.identify("leg.xml", task="actuators", log=description.description)
    motors = result.to_dict()["motors"]
    assert set(motors) == {JOINTS[0], JOINTS[2]}
    assert motors[JOINTS[0]] == {"name": "own", "armature": pytest.approx(0.01),
                                 "std": pytest.approx(0.002)}  # fmt: skip
    assert "a prior of the fit" in result.summary()
    assert "own" in [one["name"] for one in sysid_bench.list_("motors")]
    assert sysid_bench.show("own").entry["armature"] == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("pd", "words"),
    [
        ({"motor": "dm-j4310"}, "Did you mean"),
        ({"motor": ["dm-j4310-2ec", "dm-j4310-2ec"]}, "has 2 names"),
    ],
)
def test_motors_that_no_table_has_are_refused(pd: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        log(SLOW.commands(), **pd)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[motor.a]\nratio = 7", "peak_torque"),
        ("[motor.a]\npeak_torque = 1\nratio = [2, 3]\nrotor_inertia = [1, 2]", "2 numbers for 2"),
        ("[motor.a]\npeak_torque = 1\nno_load_speed = '3 V'", "no_load_speed"),
        ("[motor.a]\npeak_torque = 1\nno_load_speed = 3\nrated_speed = 4", "below no_load_speed"),
        ("[motor.a", "not valid TOML"),
    ],
)
def test_tables_with_mistakes_are_refused(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match=words):
        read_motors(file)
