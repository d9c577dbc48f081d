"""`identify --task actuators`: its answer, its files, its refusals, and recorded robots."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import sysid_bench
from sysid_bench.cli import main
from sysid_bench.errors import UsageError
from sysid_bench.signals.log_data import log_of
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.verbs.actuators_result import CONFOUNDED, ActuatorsResult
from tests.actuators.leg import JOINTS, MODEL, RATE, Case

SLOW = Case(0, delay=0.004, gains=((1.0, 1.0),), smooth=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model and the description of a recording, in files."""
    folder = tmp_path_factory.mktemp("leg")
    (folder / "leg.xml").write_text(MODEL, encoding="utf-8")
    commands = SLOW.commands()
    np.savez(folder / "run.npz", q=commands.q, q_des=commands.q_des)
    (folder / "run.toml").write_text(
        f'file = "run.npz"\nrate = "{RATE:g} Hz"\njoints = {json.dumps(JOINTS)}\n'
        'q = { columns = "q", unit = "rad" }\n'
        'tau = { pd = { q_des = "q_des", kp = 30, kd = 0.8, delay = "profile" } }\n',
        encoding="utf-8",
    )
    return folder


def in_memory(case: Case, **pd: object) -> LogDescription:
    """A recording without files."""
    commands = case.commands()
    data = {"q": commands.q, "q_des": commands.q_des, "kp": commands.kp, "kd": commands.kd}
    controller = {"q_des": "q_des", "kp": "kp", "kd": "kd", "delay": "profile", **pd}
    keys = {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": controller}}
    return log_of(data, keys, f"seed{case.seed}")


def identified(model: Path, *cases: Case, **pd: object) -> ActuatorsResult:
    """The answer to recordings in memory."""
    logs = [in_memory(case, **pd) for case in cases]
    result = sysid_bench.identify(model, task="actuators", log=logs)
    assert isinstance(result, ActuatorsResult)
    return result


def test_the_command_prints_and_writes_what_its_contract_says(folder: Path) -> None:
    written, answer = folder / "out.xml", folder / "out.json"
    words = ["identify", str(folder / "leg.xml"), "--log", str(folder / "run.toml")]
    words += ["--task", "actuators", "--model-out", str(written), "--json-out", str(answer)]
    found = CliRunner().invoke(main, words)
    assert found.exit_code == 0, found.output
    assert CONFOUNDED in found.output
    result = json.loads(answer.read_text(encoding="utf-8"))
    assert set(result["joints"]) == set(JOINTS)
    for joint in result["joints"].values():
        assert {"Ia", "fv", "fc", "offset", "at_bound"} <= joint.keys()
    assert 0.0 <= result["delay"] <= 0.02
    assert {"parameters", "direction"} == result["confounded"][0].keys()
    assert result["written"]["gap"] < 1e-6
    assert result["rollout_error"] < 0.05
    low, high = result["delay_interval"]
    assert low <= result["delay"] <= high
    for name, joint in result["joints"].items():
        for term in joint["at_bound"]:
            assert f"{name}.{term}" in found.output


def test_two_sets_of_gains_are_not_confounded(folder: Path) -> None:
    result = identified(folder / "leg.xml", Case(5, delay=0.006))
    assert result.confounded == []
    assert CONFOUNDED not in result.summary()


def test_several_recordings_have_ranges_between_files(folder: Path) -> None:
    values = Case(6, delay=0.004)
    runs = [Case(6, delay=0.004, noise=n * 5e-5, seconds=6.0) for n in (1, 2, 3)]
    result = identified(folder / "leg.xml", *runs)
    assert result.std_from == "files"
    assert result.files is not None
    assert result.files["count"] == 3
    for j, name in enumerate(JOINTS):
        ranges = result.files["joints"][name]
        for term in ("Ia", "fv", "fc", "offset"):
            assert ranges[term]["low"] <= ranges[term]["mean"] <= ranges[term]["high"]
        low, high = result.files["mjcf"][name]["armature"]
        assert 0.0 <= low <= high
        assert result.joints[name]["Ia"] == pytest.approx(values.values[j, 0], rel=0.1)


def test_a_stated_delay_is_taken_as_it_is(folder: Path) -> None:
    result = identified(folder / "leg.xml", SLOW, delay="4 ms")
    assert result.delay == pytest.approx(0.004)
    assert result.confounded == []
    assert result.profile == []


def test_a_measured_torque_has_no_delay(folder: Path) -> None:
    case = Case(7, delay=0.004, seconds=6.0)
    commands = case.commands()
    data = {"q": commands.q, "tau": commands.torque(case.delay)}
    log = log_of(data, {"joints": list(JOINTS), "rate": RATE})
    result = sysid_bench.identify(folder / "leg.xml", task="actuators", log=log)
    assert isinstance(result, ActuatorsResult)
    assert result.delay_interval is None
    assert result.rollout_error is None
    for j, name in enumerate(JOINTS):
        assert result.joints[name]["Ia"] == pytest.approx(case.values[j, 0], rel=0.1)
    with pytest.raises(UsageError, match="position actuators"):
        sysid_bench.identify(
            folder / "leg.xml", task="actuators", log=log, model_out=folder / "no.xml"
        )


def test_commands_that_come_too_early_are_reported(folder: Path) -> None:
    commands = Case(5, delay=0.018).commands()
    pd = {"q_des": "q_des", "kp": "kp", "kd": "kd", "delay": "profile"}
    ahead = {name: getattr(commands, name)[:-4] for name in ("q", "kp", "kd")}
    ahead["q_des"] = commands.q_des[4:]
    log = log_of(ahead, {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": pd}})
    result = sysid_bench.identify(folder / "leg.xml", task="actuators", log=log)
    assert any("longest that was tried" in warning for warning in result.warnings)


@pytest.mark.parametrize("option", [{"estimator": "ols"}, {"choose": ["play"]}, {"moving": 0.1}])
def test_options_of_other_fits_are_refused(folder: Path, option: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="bounded"):
        sysid_bench.identify(
            folder / "leg.xml", task="actuators", log=folder / "run.toml", **option
        )


def test_simulated_robots_have_the_task_as_well() -> None:
    result = sysid_bench.identify("ur5", task="actuators", noise={"tau": "0.5 %"})
    assert result.rank == result.parameters == 24
    assert result.bodies == {}
    assert result.torque_error is not None
    assert result.torque_error < 0.01


TARGETS = {
    ("go2", 0): 4.10, ("go2", 1): 3.78, ("go2", 2): 3.72, ("go2", 3): 3.47, ("go2", 4): 3.47,
    ("go2", 5): 3.30, ("aliengo", 0): 6.57,
}  # fmt: skip
"""mrad: least squares without held commands and filtered friction, at whole samples of delay."""


@pytest.mark.data
@pytest.mark.parametrize(
    ("robot", "run"),
    [pytest.param(*t, marks=pytest.mark.long if 0 < t[1] < 5 else ()) for t in TARGETS],
)
def test_recorded_legs(data_folder: Path, tmp_path: Path, robot: str, run: int) -> None:
    data = data_folder / robot
    with np.load(data / f"run_{run}.npz") as recorded:
        joints, kp, kd = (recorded[name].tolist() for name in ("joints", "kp", "kd"))
    file = tmp_path / "run.toml"
    file.write_text(
        f'file = {json.dumps(str(data / f"run_{run}.npz"))}\nrate = "200 Hz"\n'
        f"joints = {json.dumps(joints)}\n"
        'q = { columns = "q", unit = "rad" }\nv = { columns = "v", unit = "rad/s" }\n'
        f'tau = {{ pd = {{ q_des = "q_des", kp = {kp}, kd = {kd}, delay = "profile" }} }}\n',
        encoding="utf-8",
    )
    result = sysid_bench.identify(data / f"{robot}.xml", task="actuators", log=file)
    assert isinstance(result, ActuatorsResult)
    assert result.rollout_error is not None
    assert 1e3 * result.rollout_error <= TARGETS[robot, run]
    assert result.confounded
    assert CONFOUNDED in result.summary()
    assert all(joint["Ia"] >= 0.0 for joint in result.joints.values())
