"""Limits of servos, backlash, resolution and sizes of currents: named where they are, and not where
they are not."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sysid_bench
from sysid_bench.apps.actuators.backlash import load_steps
from sysid_bench.apps.actuators.commands.actuators_result import ActuatorsResult
from sysid_bench.apps.actuators.commands.excite_actuators import CommandsRequest
from sysid_bench.apps.actuators.commands.file_ranges import unit_fields
from sysid_bench.apps.actuators.drive_estimate import identify_drives
from sysid_bench.apps.actuators.drive_rows import SERVO, drive_rows
from sysid_bench.apps.actuators.rollout import Drives, simulated_positions
from sysid_bench.errors import UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.signals.position_control import Commands
from sysid_bench.types import Array
from tests.actuators.leg import JOINTS, MODEL, RATE, Case, leg

KP = 30.0
SIZES = {"torque-limit": 3.0, "speed-limit": 0.6, "dead-band": 0.03}


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The leg of `tests.actuators.leg` in a file."""
    file = tmp_path_factory.mktemp("leg") / "leg.xml"
    file.write_text(MODEL, encoding="utf-8")
    return file


def identified(
    model: Path, case: Case, size: Array | None = None, also: Sequence[str] = ()
) -> ActuatorsResult:
    """The answer to a recording in memory, with the `size` of a current."""
    commands = case.commands()
    data = {"q": commands.q, "q_des": commands.q_des}
    pd: dict[str, object] = {"q_des": "q_des", "kp": [KP], "kd": [0.8], "delay": "4 ms"}
    if size is not None:
        data["size"], pd["magnitude"] = size, "size"
    keys = {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": pd}}
    log = sysid_bench.log_of(data, keys)
    accept = ["worse", "gain", "sign", "direction", "robot", "units"]
    result = sysid_bench.identify(model, task="actuators", log=log, accept=accept, also=also)
    assert isinstance(result, ActuatorsResult)
    return result


@pytest.mark.parametrize(
    ("term", "seed"),
    [
        ("dead-band", 0),
        *(pytest.param(term, seed, marks=pytest.mark.long) for term in SERVO for seed in (1, 2)),
        *(pytest.param(None, seed, marks=pytest.mark.long) for seed in (1, 2, 3)),
    ],
)
def test_a_limit_is_kept_where_it_is(model: Path, term: str | None, seed: int) -> None:
    size = () if term is None else ((term, SIZES[term]),)
    seconds = 12.0 if seed else 6.0
    case = Case(
        seed, delay=0.004, gains=((1.0, 1.0),), disturbance=0.03, more=size, seconds=seconds
    )
    result = identified(model, case, also=["limits"])
    assert result.limits is not None
    kept = {(x["term"], x["joint"]): x["value"] for x in result.limits if x["kept"]}
    assert {name for name, _ in kept} <= {term}
    if term is not None:
        assert kept
        # Values are those of a coarse grid.
        assert all(1 / 1.6 < x / SIZES[term] < 1.6 for x in kept.values())
        without = identified(model, case)
        assert result.rollout_error is not None
        assert without.rollout_error is not None
        assert result.rollout_error < 0.9 * without.rollout_error
        assert f"{term} of" in result.summary()
    else:
        assert "dead-band: none" in result.summary()


def test_limits_need_a_simulation(model: Path) -> None:
    commands = Case(0, delay=0.0).commands()
    keys = {"joints": list(JOINTS), "rate": RATE, "tau": {"columns": "tau"}}
    log = sysid_bench.log_of({"q": commands.q, "tau": commands.torque(0.0)}, keys)
    with pytest.raises(UsageError, match="simulated positions"):
        sysid_bench.identify(model, task="actuators", log=log, also=["limits"])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("width", [0.0, 0.02])
def test_backlash_apart_from_friction(seed: int, width: float) -> None:
    """The load of the calf swings; the gap of its positions follows it, and friction its speed."""
    case = Case(seed, delay=0.004, gains=((1.0, 1.0),), disturbance=0.03)
    rows = drive_rows(leg(), case.log(), JOINTS)
    gap = KP * width / 2.0 * np.tanh(rows.links / 0.3) * rows.features[:, :, 3]
    moved = replace(rows, commanded=lambda *x: rows.commanded(*x) + gap)
    found = identify_drives(moved, delay=0.004)
    step, std = (2.0 * x / KP for x in load_steps(found, np.full(3, KP)))
    known = np.isfinite(step)
    assert known.any()
    # A gap is crossed within loads that are no wider than friction, whose width is not known.
    assert (np.abs(step - width)[known] < 3.0 * std[known] + 0.25 * width).all()
    assert std[known].min() < 0.003


def test_sizes_of_currents_follow_the_torque(model: Path) -> None:
    case = Case(0, delay=0.004, gains=((1.0, 1.0),), disturbance=0.03)
    size = np.abs(case.commands().torque(0.004)) / 2.5
    result = identified(model, case, size)
    assert result.magnitude is not None
    for one in result.magnitude.values():
        assert one["factor"] == pytest.approx(2.5, rel=0.1)
        assert one["correlation"] > 0.95
    assert "over the recorded one" in result.summary()
    wrong = identified(model, case, np.flip(size, axis=1))
    assert wrong.magnitude is not None
    assert wrong.magnitude["hip"]["correlation"] < 0.7


def test_a_step_of_positions_is_named(model: Path) -> None:
    step = 2 * np.pi / 4096
    commands = Case(0, delay=0.004, gains=((1.0, 1.0),)).commands()
    for q, named in ((np.round(commands.q / step) * step, True), (commands.q, False)):
        pd = {"q_des": "q_des", "kp": [KP], "kd": [0.8], "delay": "4 ms"}
        keys = {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": pd}}
        log = sysid_bench.log_of({"q": q, "q_des": commands.q_des}, keys)
        result = sysid_bench.identify(model, task="actuators", log=log, accept=["worse"])
        assert isinstance(result, ActuatorsResult)
        if named:
            assert result.resolution == pytest.approx(dict.fromkeys(JOINTS, step))
        else:
            assert result.resolution is None


def test_the_repetition_stands_beside_the_rollout(model: Path, tmp_path: Path) -> None:
    first, again = (
        Case(0, delay=0.004, gains=((1.0, 1.0),), noise=noise).commands() for noise in (0.0, 1e-3)
    )
    files = []
    for i, commands in enumerate((first, again)):
        np.savez(tmp_path / f"{i}.npz", allow_pickle=False, q=commands.q, q_des=commands.q_des)
        files.append(tmp_path / f"{i}.toml")
        files[-1].write_text(
            f'file = "{i}.npz"\nrate = "{RATE:g} Hz"\njoints = {json.dumps(JOINTS)}\n'
            'q = { columns = "q" }\n'
            f'tau = {{ pd = {{ q_des = "q_des", kp = {KP}, kd = 0.8, delay = "4 ms" }} }}\n',
            encoding="utf-8",
        )
    result = sysid_bench.identify(model, task="actuators", log=files[0], test=[files[1]])
    assert isinstance(result, ActuatorsResult)
    assert result.scores["rollout_error_floor"] == pytest.approx(1e-3, rel=0.1)
    for joint in result.joints.values():
        assert joint["rollout_floor"] == pytest.approx(1e-3, rel=0.2)
        assert joint["rollout"] < min(joint["rollout_command"], joint["rollout_null"])
    whole = np.sqrt(np.mean([x["rollout_command"] ** 2 for x in result.joints.values()]))
    assert whole == pytest.approx(result.scores["rollout_error_command"])
    assert "that the training repeats 1.0" in result.summary()


def test_scatter_between_robots_stands_apart_from_that_between_files() -> None:
    rng = np.random.default_rng(0)
    units, files = 40, 5
    values = rng.normal(size=(units, 1, 3, 4)) * 0.5 + 0.1 * rng.normal(size=(units, files, 3, 4))
    serials = [f"no. {i // files}" for i in range(units * files)]
    terms = ("Ia", "fv", "fc", "offset")
    found = unit_fields(values.reshape(-1, 3, 4), (JOINTS, terms), serials)["units"]
    kinds = {
        kind: [x[t][kind] for x in found.values() for t in terms] for kind in found["hip"]["Ia"]
    }
    assert np.mean(kinds["between_units"]) == pytest.approx(0.5, rel=0.1)
    assert np.mean(kinds["between_files"]) == pytest.approx(0.1, rel=0.1)
    assert not unit_fields(values[0], (JOINTS, terms), serials[:files])
    assert not unit_fields(values[:, 0], (JOINTS, terms), serials[::files])
    assert not unit_fields(values[:2].reshape(-1, 3, 4), (JOINTS, terms), [None, *serials[1:10]])


def test_robots_are_named_by_their_logs(model: Path) -> None:
    logs = []
    for seed in range(4):
        commands = Case(seed, delay=0.004, gains=((1.0, 1.0),), seconds=5.0).commands()
        pd = {"q_des": "q_des", "kp": [KP], "kd": [0.8], "delay": "4 ms"}
        keys = {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": pd}, "serial": str(seed // 2)}
        logs.append(sysid_bench.log_of({"q": commands.q, "q_des": commands.q_des}, keys))
    result = sysid_bench.identify(model, task="actuators", log=logs, accept=["worse"])
    assert isinstance(result, ActuatorsResult)
    assert result.files is not None
    assert set(result.files["units"]) == set(JOINTS)
    assert "between robots of one type" in result.summary()


@pytest.mark.long
@pytest.mark.parametrize(("share", "seed"), [(1.5, 0), (0.5, 2), (2.5, 2), (0.5, 4), (2.5, 4)])
def test_two_designed_motions_are_enough_for_unknown_gains(
    tmp_path: Path, share: float, seed: int
) -> None:
    """The servo has a share of the assumed gains, which nobody knows."""
    file = tmp_path / "servo.xml"
    motors = "".join(f'<motor joint="{x}" ctrlrange="-6 6" ctrllimited="true"/>' for x in JOINTS)
    file.write_text(MODEL.split("<actuator>")[0] + f"<actuator>{motors}</actuator></mujoco>")
    robot, values, files = load_robot(file), Case(seed, 0.0).values, []
    for i in (seed, seed + 1):
        designed = CommandsRequest(
            file, limits={"tau": [6.0]}, out=tmp_path / f"{i}.csv", period=6.0, starts=1,
            iterations=1, seed=i,
        ).design(lambda count, value: None)  # fmt: skip
        assert any("gains of the servo are not known" in text for text in designed.warnings)
        table = np.genfromtxt(tmp_path / f"{i}.csv", delimiter=",", names=True, deletechars="")
        names = ("q_des", "kp", "kd")
        q_des, kp, kd = (np.column_stack([table[f"{x}.{k}"] for x in JOINTS]) for k in names)
        zeros = np.zeros_like(q_des)
        commands = Commands(
            joints=JOINTS, rate=200.0, q=q_des, v=zeros, q_des=q_des, v_des=zeros,
            feedforward=zeros, kp=share * kp, kd=share * kd, limit=np.full(3, np.inf), delay=None,
        )  # fmt: skip
        q = simulated_positions(robot, Drives(JOINTS, values, 0.006), commands, slice(None))
        np.savez(tmp_path / f"{i}.npz", q=q + 1e-4 * np.sin(np.arange(q.size)).reshape(q.shape),
                 q_des=q_des)  # fmt: skip
        files.append(tmp_path / f"{i}.toml")
        files[-1].write_text(
            f'file = "{i}.npz"\nrate = "200 Hz"\njoints = {json.dumps(JOINTS)}\n'
            'q = { columns = "q" }\n'
            f'tau = {{ pd = {{ q_des = "q_des", kp = {kp[0].tolist()}, kd = {kd[0].tolist()}, '
            'delay = "profile" } }\n'
        )
    result = sysid_bench.identify(
        file, task="actuators", log=files[:1], test=files[1:], also=["gain"], accept=["worse"]
    )
    assert isinstance(result, ActuatorsResult)
    assert result.rollout_error is not None
    assert result.rollout_error < 0.4 * result.scores["rollout_error_command"]
    for one in result.gains or []:
        if one["determined"]:
            assert one["gain"] == pytest.approx(share, rel=0.25)
