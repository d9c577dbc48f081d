"""`identify --task actuators`: its answer, its files, its refusals, and recorded robots."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import sysid_bench
from sysid_bench.apps.actuators.commands.actuators_result import CONFOUNDED, SILENT, ActuatorsResult
from sysid_bench.commands.main import main
from sysid_bench.errors import UnsupportedError, UsageError
from sysid_bench.signals.log_data import log_of
from sysid_bench.signals.log_description import LogDescription
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
    written = folder / "out.xml"
    words = ["identify", str(folder / "leg.xml"), "--log", str(folder / "run.toml")]
    words += ["--task", "actuators", "--model-out", str(written)]
    found = CliRunner().invoke(main, words)
    assert found.exit_code == 0, found.output
    assert CONFOUNDED in found.output
    result = json.loads(CliRunner().invoke(main, [*words, "--json"]).stdout)
    assert set(result["joints"]) == set(JOINTS)
    for joint in result["joints"].values():
        assert {"Ia", "fv", "fc", "offset", "at_bound"} <= joint.keys()
    assert 0.0 <= result["delay"] <= 0.02
    assert {"parameters", "direction"} == result["confounded"][0].keys()
    assert result["written"]["gap"] < 1e-6
    assert result["rollout_error"] < 0.05
    assert result["rollout_error"] < min(
        result["rollout_error_null"], result["rollout_error_command"]
    )
    assert result["beaten_by"] == ""
    first = found.output.splitlines()[0]
    assert f"err by {1e3 * result['rollout_error']:.2f} mrad" in first
    assert f"themselves {1e3 * result['rollout_error_command']:.2f})" in first
    low, high = result["delay_interval"]
    assert low <= result["delay"] <= high
    for name, joint in result["joints"].items():
        for term in joint["at_bound"]:
            assert f"{name}.{term}" in found.output


def test_values_worse_than_those_of_the_file_are_a_failure(folder: Path) -> None:
    """The file of the true robot is not improved by a recording whose gains are wrong."""
    model, wrong = folder / "leg.xml", in_memory(SLOW, kp=3.0)
    found = sysid_bench.identify(model, task="actuators", log=wrong)
    assert found.beaten_by
    assert found.failure == found.warnings[0]
    assert found.summary().startswith(f"warning: {found.failure}")
    passed = sysid_bench.identify(model, task="actuators", log=wrong, accept=("worse",))
    assert passed.failure is None
    assert passed.beaten_by == found.beaten_by


def test_two_sets_of_gains_are_not_confounded(folder: Path) -> None:
    result = identified(folder / "leg.xml", Case(5, delay=0.006))
    assert result.confounded == []
    assert CONFOUNDED not in result.summary()
    assert not any("counts as zero" in warning for warning in result.warnings)


def test_other_tasks_warn_of_an_unknown_delay(folder: Path) -> None:
    log = in_memory(Case(5, delay=0.006, seconds=6.0))
    result = sysid_bench.identify(folder / "leg.xml", log=log, accept=["gain", "sign", "robot"])
    assert any("counts as zero" in warning for warning in result.warnings)


def test_several_recordings_have_ranges_between_files(folder: Path) -> None:
    values = Case(6, delay=0.004)
    runs = [Case(6, delay=0.004, noise=n * 5e-5, seconds=6.0) for n in (1, 2, 3)]
    result = identified(folder / "leg.xml", *runs)
    assert result.std_from == "files"
    assert result.files is not None
    assert result.files["count"] == 3
    for name, joint in result.joints.items():
        between = result.files["joints"][name]
        assert joint["std"] == {term: of_term["std"] for term, of_term in between.items()}
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


def test_a_short_recording_is_judged(folder: Path) -> None:
    short = in_memory(Case(5, delay=0.006, seconds=1.0))
    result = sysid_bench.identify(folder / "leg.xml", task="actuators", log=short)
    assert isinstance(result, ActuatorsResult)
    assert result.judged[0]["to"] - result.judged[0]["from"] > 0.3
    whole = sysid_bench.identify(
        folder / "leg.xml", task="actuators", log=in_memory(Case(5, delay=0.006, seconds=12.0))
    )
    assert isinstance(whole, ActuatorsResult)
    assert whole.judged[0]["to"] == pytest.approx(12.0 - 60.0 / RATE)


def test_still_joints_have_values_of_their_own_and_no_torque_error(folder: Path) -> None:
    case = Case(7, delay=0.004, seconds=6.0)
    commands = case.commands()
    tau, q = commands.torque(case.delay), commands.q.copy()
    q[:, :2] = tau[:, :2] = 0.0
    log = log_of({"q": q, "tau": tau}, {"joints": list(JOINTS), "rate": RATE})
    given: dict[str, Any] = {"log": log, "accept": ["held", "lost"]}
    result = sysid_bench.identify(_plain(folder), task="actuators", **given)
    assert result.parameters == 12
    errors = [joint["torque_error"] for joint in result.joints.values()]
    assert errors[0] is None
    assert errors[2] is not None
    assert result.torque_error is not None
    assert result.torque_error < 10.0
    together = sysid_bench.identify(_plain(folder), task="actuators", share=["h"], **given)
    assert together.parameters == 9  # hip and thigh share three values
    assert isinstance(together, ActuatorsResult)
    bound = [set(joint["at_bound"]) for joint in together.joints.values()]
    assert bound[0] == bound[1]
    assert together.rank == 9 - len(bound[0]) - len(bound[2])


def _plain(folder: Path) -> Path:
    """The leg with a hip that is not loaded by gravity."""
    file = folder / "plain.xml"
    text = MODEL.replace("<mujoco>", '<mujoco><option gravity="0 0 0"/>')
    file.write_text(text, encoding="utf-8")
    return file


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


@pytest.mark.parametrize("smooth", [False, True])
def test_commands_that_are_stamped_late_are_reported(folder: Path, smooth: bool) -> None:
    commands = Case(3, delay=0.0, seconds=6.0, smooth=smooth).commands()
    pd = {"q_des": "q_des", "kp": "kp", "kd": "kd", "delay": "profile"}
    for late in (0, 2, 4):
        count = len(commands) - late
        behind = {name: getattr(commands, name)[late:] for name in ("q", "kp", "kd")}
        behind["q_des"] = commands.q_des[:count]
        log = log_of(behind, {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": pd}})
        result = sysid_bench.identify(folder / "leg.xml", task="actuators", log=log)
        warned = any("stamped later than it acts" in warning for warning in result.warnings)
        assert warned == (late > 0)


@pytest.mark.parametrize("early", [4, 12])
def test_commands_that_come_too_early_extend_the_delays(folder: Path, early: int) -> None:
    commands = Case(5, delay=0.018).commands()
    pd = {"q_des": "q_des", "kp": "kp", "kd": "kd", "delay": "profile"}
    ahead = {name: getattr(commands, name)[:-early] for name in ("q", "kp", "kd")}
    ahead["q_des"] = commands.q_des[early:]
    log = log_of(ahead, {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": pd}})
    accept = ["worse", "columns", "direction", "gain", "sign"]
    result = sysid_bench.identify(folder / "leg.xml", task="actuators", log=log, accept=accept)
    assert isinstance(result, ActuatorsResult)
    assert not any("longest that was tried" in text for text in result.warnings)
    assert result.delay == pytest.approx(0.018 + early / RATE, abs=2e-3)


def test_a_velocity_column_that_was_never_filled_is_not_used(folder: Path) -> None:
    commands = Case(5, delay=0.004).commands()
    pd = {"q_des": "q_des", "kp": "kp", "kd": "kd", "delay": "profile"}
    data = {name: getattr(commands, name) for name in ("q", "q_des", "kp", "kd")}
    keys = {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": pd}}
    path = folder / "leg.xml"
    plain = sysid_bench.identify(path, task="actuators", log=log_of(data, keys))
    data["v"] = np.zeros_like(data["q"])
    zeros = sysid_bench.identify(
        path, task="actuators", log=log_of(data, {**keys, "v": {"columns": "v"}})
    )
    assert any("v is constant" in warning for warning in zeros.warnings)
    assert zeros.scores["rollout_error"] == plain.scores["rollout_error"]


def test_constant_commands_say_nothing_of_the_delay(folder: Path) -> None:
    found = in_memory(Case(1, delay=0.004, seconds=6.0, disturbance=2.0, still=True))
    result = sysid_bench.identify(folder / "leg.xml", task="actuators", log=found)
    assert isinstance(result, ActuatorsResult)
    assert result.delay_open is None
    assert result.confounded == [{"parameters": ["delay"], "direction": {}}]
    assert SILENT in result.summary()
    assert result.delay_interval == [0.0, 0.02]
    json.dumps(result.to_dict(), allow_nan=False)


def test_coupled_robots_have_values_without_a_rollout(folder: Path) -> None:
    model, out = folder / "coupled.xml", folder / "coupled-out.xml"
    pair = '<equality><joint joint1="calf" joint2="thigh" polycoef="0 1 0 0 0"/></equality>'
    model.write_text(MODEL.replace("  <actuator>", f"  {pair}<actuator>"), encoding="utf-8")
    commands = Case(5, delay=0.006, seconds=6.0).commands()
    data = {"q": commands.q[:, :2], "q_des": commands.q_des[:, :2]}
    pd = {"q_des": "q_des", "kp": 30.0, "kd": 0.8, "delay": "6 ms"}
    log = log_of(data, {"joints": list(JOINTS[:2]), "rate": RATE, "tau": {"pd": pd}})
    result = sysid_bench.identify(model, task="actuators", log=log)
    assert isinstance(result, ActuatorsResult)
    assert set(result.joints) == set(JOINTS[:2])
    assert result.rollout_error is None
    assert result.torque_error is not None
    assert any("coupled joints" in warning for warning in result.warnings)
    with pytest.raises(UnsupportedError, match="--model-out"):
        sysid_bench.identify(model, task="actuators", log=log, model_out=out)
    assert not out.exists()


FRAME = {
    "free": ('<freejoint name="base"/>', "joints are locked"),
    "pull": ("", "differs by"),
}
"""What a model adds at its trunk, and what the answer says of its written file."""


@pytest.mark.parametrize("kind", FRAME)
def test_a_written_model_that_is_not_checked_or_differs_is_reported(
    folder: Path, kind: str
) -> None:
    joint, said = FRAME[kind]
    text = MODEL.replace(
        '<body name="trunk_side">',
        f'<body name="trunk">{joint}<geom size=".1"/><body name="trunk_side">',
        1,
    )
    text = text.replace("  </worldbody>", "</body></worldbody>")
    if kind == "pull":  # a position servo of a tendon pulls the calf to zero
        cord = '<tendon><fixed name="cord"><joint joint="calf" coef="1"/></fixed></tendon>'
        servo = '<position name="pull" tendon="cord" kp="5"/>'
        text = text.replace("<actuator>", f"{cord}<actuator>{servo}")
    model = folder / f"{kind}.xml"
    model.write_text(text, encoding="utf-8")
    out = folder / f"{kind}-out.xml"
    log = in_memory(Case(5, delay=0.006, seconds=6.0))
    result = sysid_bench.identify(model, task="actuators", log=log, model_out=out)
    assert isinstance(result, ActuatorsResult)
    assert said in result.summary()
    held = any("base is held fixed" in warning for warning in result.warnings)
    assert held == (kind == "free")
    warned = any("does not repeat the simulation" in warning for warning in result.warnings)
    assert warned == (kind == "pull")


def test_options_of_other_fits_are_refused(folder: Path) -> None:
    given: dict[str, Any] = {
        "estimator": "ols", "choose": ["play"], "moving": 0.1, "prior": "none",
        "feasible": "bodies",
    }  # fmt: skip
    with pytest.raises(UsageError, match="bounded") as refused:
        sysid_bench.identify(folder / "leg.xml", task="actuators", log=folder / "run.toml", **given)
    assert all(f"--{name}" in str(refused.value) for name in given)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"share": ["hpi"]}, "No word of --share is called 'hpi'"),
        ({"seed": 3}, "--seed"),
        ({"share": ["hip"], "task": "robot"}, "--share"),
    ],
)
def test_options_without_effect_are_refused(
    folder: Path, options: dict[str, Any], said: str
) -> None:
    with pytest.raises(UsageError, match=said):
        sysid_bench.identify(
            folder / "leg.xml", log=folder / "run.toml", **{"task": "actuators", **options}
        )


def test_simulated_robots_have_the_task_as_well() -> None:
    result = sysid_bench.identify("ur5", task="actuators", noise={"tau": "0.5 %"})
    assert result.rank == result.parameters == 24
    assert result.bodies == {}
    assert result.torque_error is not None
    assert result.torque_error < 0.01
