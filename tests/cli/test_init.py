"""Law of init: what it writes is accepted by the next command, and nothing is written over."""

import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from sysid_bench import init_estimator, init_log, init_model, init_suite, plan
from sysid_bench.commands.check_plugin import check_plugin
from sysid_bench.commands.main import main
from sysid_bench.errors import SysidBenchError, UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.sources import package_file
from sysid_bench.signals.log import read_log
from sysid_bench.signals.log_description import read_description
from tests.robots import named_robot
from tests.signals.logs import recorded

TWO = """<robot name="two"><link name="base"/><link name="a"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j1" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="0" velocity="1"/></joint></robot>"""

FORMATS = ("csv", "csv deg", "csv ms", "bare", "npz", "parquet")


def written(folder: Path, kind: str) -> Path:
    """A recording of ur5 in a usual layout."""
    log = recorded(named_robot("ur5"), period=2.0)
    scale, unit = (180 / np.pi, 1e3 if kind == "csv ms" else 1.0)
    q, v = (log.q, log.v) if kind != "csv deg" else (log.q * scale, log.v * scale)
    table = np.column_stack([log.t * unit, q, v, log.tau])
    words = {"csv": ("q_{}", "v_{}", "tau_{}"), "csv deg": ("pos{}", "vel{}", "torque{}")}
    signals = words.get(kind, ("{}_position", "{}_velocity", "{}_effort"))
    joints = range(1, 7) if kind == "csv deg" else log.joints
    names = ["time", *(signal.format(joint) for signal in signals for joint in joints)]
    if kind == "npz":
        np.savez(folder / "run.npz", t=log.t, qpos=q, qvel=v, torque=log.tau)
        return folder / "run.npz"
    if kind == "parquet":
        pd.DataFrame(table, columns=names).to_parquet(folder / "run.parquet")
        return folder / "run.parquet"
    header = "" if kind == "bare" else ",".join(names)
    np.savetxt(folder / "run.csv", table, delimiter=",", header=header, comments="")
    return folder / "run.csv"


def test_a_line_that_broke_off_is_said(tmp_path: Path) -> None:
    file = written(tmp_path, "csv")
    file.write_text(file.read_text()[:-60])
    result = init_log(file, "ur5")
    assert "the last line is incomplete" in result.doubts[-1]
    assert "--accept" not in result.next


@pytest.mark.parametrize("kind", FORMATS)
def test_a_guessed_description_is_accepted(kind: str, tmp_path: Path) -> None:
    file = written(tmp_path, kind)
    result = init_log(file, "ur5")
    path = tmp_path / "run.toml"
    assert result.file == str(path)
    log = read_log(read_description(path), named_robot("ur5"))
    source = recorded(named_robot("ur5"), period=2.0)
    np.testing.assert_allclose(log.recording.tau, source.tau, atol=1e-6 * np.abs(source.tau).max())
    np.testing.assert_allclose(log.recording.q, source.q, atol=1e-6)
    assert [finding for finding in log.findings if finding.contradiction] == []
    keys = tomllib.loads(path.read_text())
    assert keys["q"]["unit"] == ("deg" if kind == "csv deg" else "rad")
    with pytest.raises(UsageError, match=r"exists.*-o, or remove it"):
        init_log(file, "ur5")
    init_log(file, "ur5", force=True)


def test_doubts_are_written_and_printed(tmp_path: Path) -> None:
    log = recorded(named_robot("ur5"), period=2.0)
    names = [f"{s}{j}" for s in ("q", "current") for j in range(1, 7)]
    frame = pd.DataFrame(np.hstack([log.q, log.tau]), columns=names)
    frame.to_csv(tmp_path / "run.csv", index=False)
    command = ["init", "log", str(tmp_path / "run.csv"), "--model", "ur5"]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 0, result.output
    assert "doubt: rate: neither stamps nor v give it" in result.output
    assert "doubt: tau: currents" in result.output
    text = (tmp_path / "run.toml").read_text()
    assert text.count("# DOUBT: ") == 2
    assert "gain" not in tomllib.loads(text)["tau"]
    with pytest.raises(UsageError, match=r"current in A: write gain = .*--task payload"):
        read_log(read_description(tmp_path / "run.toml"), named_robot("ur5"))
    (tmp_path / "run.toml").write_text(text.replace('unit = "A"', 'unit = "A", gain = 1.0'))
    got = read_log(read_description(tmp_path / "run.toml"), named_robot("ur5"))
    np.testing.assert_allclose(got.recording.tau, log.tau[: len(got.recording)], atol=1e-9)


@pytest.mark.parametrize(
    ("words", "chosen"), [(("con", "meas"), "meas"), (("filt", "raw"), "filt")]
)
def test_measured_columns_are_preferred_and_others_are_named(
    words: tuple[str, str], chosen: str, tmp_path: Path
) -> None:
    """Where no name says what was measured, the choice is a doubt."""
    log = recorded(named_robot("ur5"), period=2.0)
    names = [
        "t",
        *(f"{s}{j}" for s in ("q", *(f"tau_{word}" for word in words)) for j in range(1, 7)),
    ]
    table = np.column_stack([log.t, log.q, log.tau, log.tau])
    pd.DataFrame(table, columns=names).to_csv(tmp_path / "run.csv", index=False)
    doubts = init_log(tmp_path / "run.csv", "ur5").doubts
    text = (tmp_path / "run.toml").read_text()
    assert tomllib.loads(text)["tau"]["columns"] == [f"tau_{chosen}{j}" for j in range(1, 7)]
    [other] = set(words) - {chosen}
    assert f"tau_{other}1" in text
    assert any("fit as well" in doubt for doubt in doubts) == (chosen == "filt")


@pytest.mark.parametrize("order", ["aqvt", "qavt", "qvat", "qvta", "vaqt", "qva", "aqv", "qa"])
@pytest.mark.parametrize("named", [True, False])
def test_accelerations_are_never_offered_as_torques(
    order: str, named: bool, tmp_path: Path
) -> None:
    """Columns without names, and accelerations by the name of torques."""
    log = recorded(named_robot("ur5"), period=2.0)
    a = np.gradient(log.v, log.t, axis=0)
    blocks = {"q": log.q, "v": log.v, "a": a, "t": log.tau}
    table = np.column_stack([log.t, *(blocks[kind] for kind in order)])
    words = {"q": "q", "v": "v", "a": "a" if "t" in order else "effort", "t": "tau"}
    names = ["t", *(f"{words[kind]}_{joint}" for kind in order for joint in log.joints)]
    file = tmp_path / "run.csv"
    pd.DataFrame(table, columns=names).to_csv(file, index=False, header=named)
    result = init_log(file, "ur5")
    keys = tomllib.loads((tmp_path / "run.toml").read_text())
    first = {kind: 2 + 6 * i for i, kind in enumerate(order)}
    for signal, kind in (("q", "q"), ("v", "v"), ("tau", "t")):
        wanted = [*range(first[kind], first[kind] + 6)] if kind in order else None
        if named and wanted is not None:
            wanted = names[wanted[0] - 1 : wanted[0] + 5]
        assert keys.get(signal, {}).get("columns") == wanted
    at = first["a"]
    unused = names[at - 1 : at + 5] if named else [f"{at} to {at + 5}"]
    assert result.unused == unused
    assert unused[0] in result.summary()


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("value", [np.inf, np.nan, 1e200])
@pytest.mark.parametrize("joint", [0, 3, 5])
@pytest.mark.parametrize("bare", [True, False])
def test_numbers_that_are_not_measurements_leave_no_warning(
    value: float, joint: int, bare: bool, tmp_path: Path
) -> None:
    log = recorded(named_robot("ur5"), period=2.0)
    table = np.column_stack([log.q, log.v, log.tau])
    table[3, [joint, 6 + joint, 12 + joint]] = value
    names = [f"{signal}_{joint}" for signal in ("q", "v", "tau") for joint in log.joints]
    pd.DataFrame(table, columns=names).to_csv(tmp_path / "run.csv", index=False, header=not bare)
    result = init_log(tmp_path / "run.csv", "ur5")
    assert result.joints == list(log.joints)


@pytest.mark.parametrize("kind", FORMATS)
def test_a_recording_without_torques_is_guessed_but_for_them(kind: str, tmp_path: Path) -> None:
    """The rest is written as with torques, what is missing is said, and tau alone completes it."""
    whole, bare = tmp_path / "whole", tmp_path / "bare"
    for folder in (whole, bare):
        folder.mkdir()
        written(folder, kind)
    init_log(recording(whole), "ur5")
    without_torques(recording(bare), kind)
    result = init_log(recording(bare), "ur5")
    assert "positions without torques" in result.doubts[0]
    assert result.next.startswith(f"complete tau in {bare / 'run.toml'}, then: sysid-bench")
    text = (bare / "run.toml").read_text()
    assert "# tau = {" in text
    keys = tomllib.loads((whole / "run.toml").read_text())
    assert tomllib.loads(text) == {k: x for k, x in keys.items() if k not in ABSENT[kind]}
    with pytest.raises(UsageError, match="tau is missing: write tau = "):
        read_description(bare / "run.toml")


ABSENT = dict.fromkeys(FORMATS, ("tau",)) | {"bare": ("tau", "v")}
"""Keys that recordings without torques do not have; of columns without names only q is known."""


def recording(folder: Path) -> Path:
    return next(folder.glob("run.*"))


def without_torques(file: Path, kind: str) -> None:
    """The same file without its torques, and for columns without names without velocities."""
    if kind == "npz":
        kept = {name: x for name, x in np.load(file).items() if name != "torque"}
        np.savez(file, **kept)
        return
    if kind == "parquet":
        pd.read_parquet(file).iloc[:, :13].to_parquet(file)
        return
    table = pd.read_csv(file, header=None if kind == "bare" else 0)
    table.iloc[:, : 7 if kind == "bare" else 13].to_csv(file, index=False, header=kind != "bare")


def test_a_recording_without_positions_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", t=np.arange(50.0), torque=np.zeros((50, 6)))
    with pytest.raises(UsageError, match=r"no positions can be found.*t, torque"):
        init_log(tmp_path / "run.npz", "ur5")
    assert not (tmp_path / "run.toml").exists()


def test_one_of_several_files_is_refused_with_the_others(tmp_path: Path) -> None:
    """Files of one signal each are found in any order, whatever the number of the model's joints;
    one of them alone is refused, and so is a guess that cannot be read, by the recorded file."""
    log = recorded(named_robot("ur5"), period=2.0)
    signals = {"q": log.q[:, :4], "v": log.v[:, :4], "tau": log.tau[:, :4], "time": log.t}
    files = [tmp_path / f"log_{name}.txt" for name in signals]
    for file, x in zip(files, signals.values(), strict=True):
        np.savetxt(file, np.ravel(x))
    with pytest.raises(UsageError, match=r"no torques or currents.*log_tau\.txt \(torque\)"):
        init_log(files[0], "ur5")
    with pytest.raises(UsageError, match=r"no positions can be found.*log_q\.txt \(position\)"):
        init_log(files[2], "ur5")
    result = init_log([files[3], files[2], files[0]], "ur5", tmp_path / "a.toml")
    assert result.joints == list(log.joints[:4])
    got = read_log(read_description(tmp_path / "a.toml"), named_robot("ur5"))
    np.testing.assert_allclose(got.recording.tau[:, :4], log.tau[:, :4], atol=1e-9)
    np.savetxt(files[3], log.t[:-5])
    with pytest.raises(UsageError, match=r"log_time\.txt: nothing is written.*time stamps for"):
        init_log([files[0], files[2], files[3]], "ur5", tmp_path / "b.toml")
    assert not (tmp_path / "b.toml").exists()


def robots() -> list[Path]:
    """Model files of the package of example robots."""
    file, _ = package_file("example-robot-data:ur_description/urdf/ur5_robot.urdf", "ur5")
    return sorted(file.parents[2].rglob("*.urdf"))


@pytest.mark.parametrize("part", [0, 1, pytest.param(None, marks=pytest.mark.long)])
def test_every_example_robot_is_written_or_refused_with_advice(
    part: int | None, tmp_path: Path
) -> None:
    chosen = robots() if part is None else robots()[part::30]
    refusals = [text for i, file in enumerate(chosen) if (text := refusal(file, tmp_path / str(i)))]
    known = ("no moving joint", "no <link>", "xacro")
    assert [text for text in refusals if not any(words in text for words in known)] == []
    assert len(refusals) < len(chosen)


def refusal(file: Path, folder: Path) -> str:
    """Why no robot was written; "" for one that was, and loads with its joints."""
    try:
        result = init_model(file, folder)
    except SysidBenchError as error:
        return str(error)
    assert list(load_robot(find_manifest(str(folder))).torque_rows) == result.joints
    return ""


def test_limits_macros_and_meshes_are_met_with_advice(tmp_path: Path) -> None:
    file = tmp_path / "two.urdf"
    file.write_text(TWO)
    result = init_model(file, tmp_path / "two")
    assert any('effort="0" stands for an absent limit' in text for text in result.warnings)
    with pytest.raises(UsageError, match="exists"):
        init_model(file, tmp_path / "two")
    heavy = TWO.replace('mass value="1"', 'mass value="1e6"').replace('upper="1"', 'upper="180"')
    file.write_text(heavy)
    doubts = " ".join(init_model(file, tmp_path / "two", force=True).warnings)
    assert "masses in kg" in doubts
    assert "in degrees" in doubts
    macro = tmp_path / "two.urdf.xacro"
    macro.write_text(TWO)
    with pytest.raises(UsageError, match=r"write it out with ROS, xacro two\.urdf\.xacro"):
        init_model(macro, tmp_path / "macro")
    mjcf = tmp_path / "two.xml"
    mjcf.write_text(
        '<mujoco><asset><mesh name="m" file="absent.stl"/></asset><worldbody><body><joint/>'
        '<geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
    )
    with pytest.raises(UsageError, match="put the mesh files beside the model"):
        init_model(mjcf, tmp_path / "mesh")


def test_a_suite_and_an_estimator_pass_their_checks(tmp_path: Path) -> None:
    assert len(plan(init_suite("scara", tmp_path / "first.toml").file).cells) == 8
    model = tmp_path / "two.urdf"
    model.write_text(TWO)
    for folder, use in ((".", "file:two.urdf"), ("suites", "file:../two.urdf"), ("a/b", model)):
        suite = init_suite(model, tmp_path / folder / "own.toml").file
        assert f'{str(use).removeprefix("file:")}"' in Path(suite).read_text(encoding="utf-8")
        assert len(plan(suite).cells) == 8
    result = init_estimator("Mine", tmp_path / "mine.py")
    answer = check_plugin(f"file:{result.file}:Mine", kind="estimator")
    assert answer.broken == []
    with pytest.raises(UsageError, match="cannot be its name"):
        init_estimator("2 words", tmp_path / "x.py")
    with pytest.raises(UsageError, match="exists"):
        init_suite("scara", tmp_path / "first.toml")


SETS = {
    "ur10/ur10_exciting_trajectory.csv": "ur10",
    "ur10_cb3/ur10_exciting_trajectory.db3": "ur10",
    "fer/panda_exciting_trajectory.db3": "panda",
    "tiago/tiago_position.csv tiago/tiago_velocity.csv tiago/tiago_effort.csv": (
        "robots/pal_tiago__tiago.xml"
    ),
    "tx40/pos_read_data.csv tx40/curr_data.csv": "tx40",
    "panda_gaz/exciting_traj_positions.txt panda_gaz/exciting_traj_velocity.txt "
    "panda_gaz/exciting_traj_torques.txt panda_gaz/exciting_traj_time.txt": (
        "robots/franka_emika_panda__panda_nohand.xml"
    ),
    "dvrk/psm_train.csv": "dvrk_psm",
    "dvrk/mtm_train.csv": "dvrk_mtm",
    "kr300/traj_A.parquet": "ur10",
    "kr300/traj_A.mat": "ur10",
    "ur10e/ur-20_02_10-30sec_12harm.csv": "robots/universal_robots_ur10e__ur10e.xml",
}
"""Recorded files of one robot, and a model with its joints."""

INCOMPLETE = {
    "tiago/tiago_position.csv tiago/tiago_velocity.csv tiago/tiago_effort.csv",
    "tx40/pos_read_data.csv tx40/curr_data.csv",
    "dvrk/psm_train.csv",
    "dvrk/mtm_train.csv",
    "kr300/traj_A.parquet",
    "kr300/traj_A.mat",
    "ur10e/ur-20_02_10-30sec_12harm.csv",
}
"""Currents and torques of motors, and coordinates of motors, along which no model is a torque."""


@pytest.mark.data
@pytest.mark.parametrize("files", SETS)
def test_recordings_of_real_robots_are_described(
    files: str, data_folder: Path, tmp_path: Path
) -> None:
    model = SETS[files]
    model = str(data_folder / model) if "/" in model else model
    result = init_log([data_folder / file for file in files.split()], model, tmp_path / "a.toml")
    if result.next.startswith("complete tau in "):
        assert files in INCOMPLETE
        return
    log = read_log(read_description(tmp_path / "a.toml"), load_robot(find_manifest(model)))
    contradictions = {finding.text for finding in log.findings if finding.contradiction}
    assert contradictions <= set(result.doubts)
    assert all(f"--accept {f.name}" in result.next for f in log.findings if f.contradiction)


@pytest.mark.data
@pytest.mark.parametrize("file", ["go2/run_0.npz", "formats_generated/lerobot_v3"])
def test_recordings_of_commands_are_those_of_actuators(
    file: str, data_folder: Path, tmp_path: Path
) -> None:
    result = init_log(data_folder / file, data_folder / "go2" / "go2.xml", tmp_path / "a.toml")
    assert len(result.joints) == 12
    text = (tmp_path / "a.toml").read_text()
    if "lerobot" in file:  # has no place for gains
        assert "write kp and kd" in result.doubts[0]
        assert "# tau = { pd = { q_des = " in text
        return
    assert "--task actuators" in result.next
    assert "kp: gain: by its name" in text
    pd = tomllib.loads(text)["tau"]["pd"]
    assert pd["kp"] == [20, 20, 40] * 4
    assert pd["kd"] == [1, 1, 2] * 4
    assert pd["q_des"]["columns"] == ["q_des"]


@pytest.mark.data
def test_a_folder_of_servos_is_described(data_folder: Path, tmp_path: Path) -> None:
    folder = data_folder / "so101_sage" / "multisine"
    model = data_folder / "robots" / "robotstudio_so101__so101.xml"
    result = init_log(sorted(folder.glob("*.csv")), model, tmp_path / "a.toml")
    assert len(result.joints) == 6
    assert "kp and kd are those of the actuators of the model file" in result.doubts[0]
    assert "--also gain" in result.next
    text = (tmp_path / "a.toml").read_text()
    assert "never negative" in text
    assert 'resample = "previous"' in text
    assert "kp = [998.22, " in text
    log = read_log(read_description(tmp_path / "a.toml"), load_robot(find_manifest(str(model))))
    assert log.commands is not None
    assert len(log.commands) == 6000


@pytest.mark.data
def test_files_of_signals_without_headers_are_described(data_folder: Path, tmp_path: Path) -> None:
    folder = data_folder / "ur5_2013" / "Movement_No6_Acc_slow_Verify_Model"
    result = init_log(sorted(folder.glob("*.csv")), "ur5", tmp_path / "a.toml")
    text = (tmp_path / "a.toml").read_text()
    keys = tomllib.loads(text)
    assert [keys[s]["time"]["column"] for s in ("q", "v", "tau")] == [1, 1, 1]
    assert [keys[s]["columns"] for s in ("q", "v", "tau")] == [list(range(2, 8))] * 3
    assert keys["tau"]["unit"] == "A"
    assert len(result.unused) == 2
    (tmp_path / "a.toml").write_text(text.replace('unit = "A"', 'unit = "A", gain = 10.6'))
    log = read_log(read_description(tmp_path / "a.toml"), named_robot("ur5"))
    assert [finding for finding in log.findings if finding.contradiction] == []
