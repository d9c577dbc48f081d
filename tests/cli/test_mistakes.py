"""A command that is asked wrongly ends with 2 and one paragraph: what came, and what to do."""

import json
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.robots import named_robot
from tests.signals.logs import recorded, write

from .conftest import Run, one_sentence

RUNS = {
    "gate run --baseline arm.xml": "'arm.xml' is not a baseline (not JSON",
    "gate run --baseline absent.json": "(No such file or directory); write one with",
    "gate run --baseline folder": "(it is a folder); write one with",
    "gate run --baseline empty.json": "'empty.json' is not a baseline (it is empty)",
    "gate run --baseline {}.json": "JSON without schema, suite, origin and 4 more; it is empty",
    "gate run --baseline [].json": "JSON of a list, not of an object",
    "gate run --baseline basis.json": "it has robot, rank",
    "gate run --baseline bytes.json": "(it is not a text file (byte",
    "gate run --baseline /dev/null": "is a device or a pipe, not a file); write one with",
    "gate run --baseline nan.json": "tolerance of gap: {'absolute': nan} is not a tolerance",
    "gate run --baseline rnak.json": "No metric is called 'rnak'. Did you mean 'rank'?",
    "gate run --baseline nothing.json": "it holds no cell",
    "gate absent --baseline b.json": "'absent' is not a run: there is no such folder. Runs: ",
    "gate s.toml --baseline b.json": "'s.toml' is not a run: it is a file. Runs: ",
    "gate unrun --baseline b.json": "'unrun' has no rows yet; run it first: 'sysid-bench run",
    "run s.toml -o other --baseline arm.xml": "'arm.xml' is not a baseline",
    "run s.toml -o other --baseline folder": "(it is a folder)",
    "baseline save unrun -o c.json": "has no row yet; run it",
    "baseline save run -o c.json --metrics torque_eror": "Did you mean 'torque_error'?",
    "baseline save run -o c.json --metrics ,": "names no metric; write --metrics rank,torque_error",
    "baseline save run -o c.json --tolerance seconds=2": "compared are rank, data_rank, gap",
    "baseline save run -o c.json --tolerance torque_error=small": "not a name and a number",
    "baseline save run -o c.json --tolerance torque_error=0.5": "torque_error=0.5 cannot be: ",
    "baseline save run -o c.json --tolerance gap=nan": "gap=nan cannot be: {'absolute': nan}",
    "baseline update run -o empty.json": "'empty.json' is not a baseline (it is empty)",
    "compare run folder": "'folder' is not a run: it has no plan.jsonl. Runs: ",
    "compare run basis.json": "'basis.json' is not a baseline",
    "compare unrun run": "'unrun' has no rows yet",
    "compare run run --metrics rnak": "Did you mean 'rank'?",
    "compare run run --format xml": "There are: csv, json, latex, md.",
    "claims unrun --suite claims/smoke": "'unrun' has no rows yet",
    "claims run --suite claims/smok": "Did you mean 'claims/smoke'?",
    "claims run --suite broken.toml": "broken.toml: not valid TOML",
    "table unrun main": "'unrun' has no rows yet",
    "lint absent.urdf": "The model file 'absent.urdf' does not exist",
    "lint folder": "'folder' holds no robot.toml and no URDF or MJCF model",
    "lint b.json": "'b.json' is not a model file (.urdf, .xml, .mjcf) and not a robot.toml.",
    "lint s.toml": "s.toml is a suite (it has the key schema), not a robot",
    "lint broken.toml": "broken.toml is not valid TOML",
    "cells run --sort torque_eror": "'torque_error'",
    "cells run --show torque_eror": "'torque_error'",
    "table run erors": "'errors'",
    "status nowhere": "'nowhere' is not a run",
    "run s.toml -o other --select 'robt == 1'": "Did you mean 'robot'?",
    "run nowhere.toml": "nowhere.toml",
    "run smok": "'smoke'",
    "plan s.toml --select 'robt == 1'": "'robot'",
    "plan s.toml --set 'defaults.rate=5 m'": "'5 m'",
    "plan s.toml --select 'robot = 1'": "write ==, as in: robot == 1",
    "plan bad.toml": "bad.toml:",
    "run bad.toml -o other": "Did you mean 'wls'",
}
MODELS = {
    "crosscheck pandda": "'panda'",
    "crosscheck ur5 run.toml": "run.toml is the description of a recording (it has the key q)",
    "crosscheck pand.sdf": "its suffix is not of a model file: give a URDF or MJCF file",
    "basis ur5.xacro": "or the robot 'ur5'",
    "bsis ur5": "No verb is called 'bsis'. Did you mean 'basis'?",
    "init lg": "Did you mean 'log'?",
    "show wsl": "'wls'",
    "frames ur5 --at elbow_joint": "--at",
    "frames ur5 --at elbow=0.1": "elbow_joint",
    "basis ur5 --terms viscos": "'viscous'",
    "basis ur5 --task payload --terms viscous": "'payload'",
    "basis ur5 --task wrench --sensor wirst": "'wrist'",
}
SIMULATED = {
    "": "--simulate",
    "--simulate --task termnal": "'terminal'",
    "--simulate --noise tua=1%": "'tau'",
    "--simulate --noise tau": "--noise 'tau=0.5 %",
    "--simulate --noise tau=5": "has no unit; write one of N m, Nm, N·m, mN m, N, kN, %.",
    "--simulate --noise q=1e-4": "has no unit; write one of rad, mrad, deg",
    "--simulate --estimator SDP": "Did you mean 'lmi'?",
    "--simulate --model-out a.txt": "name it *.urdf or *.xml",
    "--simulate --payload '{ mass = '": "TOML",
    "--simulate --contacts detec": "10 s to 25 s",
    "--simulate --contacts '5 s to 4 s'": "ends before it begins",
    "--simulate --contacts '0 s to 100 s'": "leave nothing",
}
RECORDED = {
    "--log wrong.toml": "--accept rate",
    "--log run.toml --accept rtae": "'rate'",
    "--log run.toml --simulate": "--log",
    "--log run.toml --noise 'tau=1 %'": "--simulate",
    "--log run.toml --sensor wrist": "for the task 'wrench' only",
    "--simulate --test run.toml": "--log",
    "--log nowhere.toml": "nowhere.toml",
    "--log run.csv": "file = 'run.csv'",
    "--log run.toml --terms elbow_joint.kk": "elbow_joint.k",
    "--log run.toml --filter 'butter 4 150 Hz'": "150",
    "--log run.toml --estimator wsl": "'wls'",
}
DESIGNED = {
    "--objective C": "No objective is called 'C'",
    "--objective D=x": "not a number",
    "--family taylor": "family",
    "--export dxf -o m": "No export is called 'dxf'",
    "--export csv": "-o FILE",
    "--export can -o m.log": "Which motors",
    "--export can -o m.log --motors DM4310": "1 motor(s) for 6",
    "--export can -o m.log --motors a.toml": "The file 'a.toml' of motors does not exist",
    "--joints elbow": "elbow_joint",
    "--limit w=3": "No limit is called 'w'",
    "--limit v=1,2": "6",
    "--limit v=1,1,1e999,1,1,1": "up to 1e+09",
    "--harmonics 222": "at most 100",
    "--period 1e9": "10,000,000",
    "--box tool0=0:1": "x:x,y:y,z:z",
    "--after nowhere.csv": "nowhere.csv",
    "-o no/such/folder.csv": "The folder 'no/such'",
    "--period '5 kg'": "kg",
}
COMMANDS = {
    **RUNS, **MODELS,
    **{f"identify ur5 {words}": said for words, said in {**SIMULATED, **RECORDED}.items()},
    **{f"excite ur5 {words}": said for words, said in DESIGNED.items()},
    "identify --log run.csv": "sysid-bench identify ur5 --log run.toml",
}  # fmt: skip
"""Command lines with a mistake, and the part of the answer that says what came or what to do."""


@pytest.fixture(scope="session")
def mistaken(stored: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stored run and its baseline, logs, and files that are something else."""
    folder = tmp_path_factory.mktemp("mistaken")
    shutil.copytree(stored, folder, dirs_exist_ok=True)
    shutil.copytree(
        folder / "run", folder / "unrun", ignore=shutil.ignore_patterns("*.jsonl", "*.parquet")
    )
    shutil.copy(folder / "run" / "plan.jsonl", folder / "unrun")
    (folder / "folder").mkdir()
    known = json.loads((folder / "b.json").read_text())
    texts = {
        "empty": "", "{}": "{}", "[]": "[]", "basis": '{"robot": "ur5", "rank": 48}',
        "nan": json.dumps(known | {"tolerances": {"gap": {"absolute": float("nan")}}}),
        "rnak": json.dumps(known | {"metrics": ["rnak"]}),
        "nothing": json.dumps(known | {"robots": {}}),
    }  # fmt: skip
    for name, text in texts.items():
        (folder / f"{name}.json").write_text(text)
    (folder / "bytes.json").write_bytes(b"\xff\xfe")
    (folder / "broken.toml").write_text('name = "x\n')
    suite = (folder / "s.toml").read_text().replace('"wls"', '"wsl"', 1)
    (folder / "bad.toml").write_text(suite.replace("repeats", "repeatts"))
    write(folder, recorded(named_robot("ur5")))
    write(folder, recorded(named_robot("ur5")), name="wrong", rate="100 Hz")
    return folder


@pytest.mark.parametrize("typed", COMMANDS)
def test_a_mistake_is_one_paragraph_and_leaves_no_file(
    typed: str, mistaken: Path, cli_in: Callable[[Path], Run]
) -> None:
    files = {path for path in mistaken.rglob("*") if path.name != ".lock"}
    done = cli_in(mistaken)(*shlex.split(typed))
    assert done.returncode == 2, done.stdout
    assert COMMANDS[typed] in one_sentence(done)
    assert not done.stdout
    assert {path for path in mistaken.rglob("*") if path.name != ".lock"} == files
