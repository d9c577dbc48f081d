"""Baselines on the command line: save, gate, update, and runs that are gated."""

import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import pytest

import sysid_bench

from .conftest import one_sentence, small_suite

ROBOT = """
<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
 <body><joint name="j1" axis="0 0 1" range="-2 2"/>
  <inertial mass="3" pos="0.1 0 0" diaginertia="0.02 0.03 0.03"/>
  <body name="arm" pos="0.3 0 0"><joint name="j2" axis="0 1 0" range="-2 2"/>
   <inertial mass="1.5" pos="0.1 0 0.02" diaginertia="0.01 0.02 {izz}"/>
  </body></body></worldbody></mujoco>
"""
Cli = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a robot of one's own, and its baseline; tests work on a copy."""
    folder = tmp_path_factory.mktemp("gated")
    (folder / "arm.xml").write_text(ROBOT.format(izz=0.02))
    (folder / "s.toml").write_text(small_suite(("file:arm.xml",)))
    sysid_bench.run(folder / "s.toml", folder / "run", jobs=1)
    sysid_bench.baseline_save(folder / "run", folder / "b.json")
    return folder


@pytest.fixture
def saved(made: Path, tmp_path: Path) -> Path:
    """Baseline in the folder of the command line, beside its run, suite and robot."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return tmp_path / "b.json"


@pytest.mark.long
def test_the_same_code_keeps_its_baseline(cli: Cli, saved: Path, tmp_path: Path) -> None:
    done = cli("run", "s.toml", "-o", "again", "-j", "1", "--baseline", "b.json")
    assert done.returncode == 0, done.stdout
    assert "keeps the baseline" in done.stdout
    part = cli("run", "s.toml", "-o", "part", "--limit", "1", "--baseline", "b.json")
    assert part.returncode == 0, part.stdout
    whole = cli("gate", "part", "--baseline", "b.json")
    assert whole.returncode == 1
    assert "cells without a row" in whole.stdout
    assert cli("baseline", "update", "again", "-o", "b.json").returncode == 0
    assert "0 changes taken over" in cli("baseline", "update", "run", "-o", "b.json").stdout


def test_an_inertia_that_moves_by_a_percent_is_found(cli: Cli, saved: Path, tmp_path: Path) -> None:
    before = saved.read_text()
    (tmp_path / "arm.xml").write_text(ROBOT.format(izz=0.0202))
    done = cli("run", "s.toml", "-o", "later", "--baseline", "b.json")
    assert done.returncode == 1
    assert "arm" in done.stdout
    answer = json.loads(cli("gate", "later", "--baseline", "b.json", "--json").stdout)
    assert not answer["ok"]
    assert {change["robot"] for change in answer["parameters"]} == {"arm"}
    assert answer["parameters"][0]["before"] != answer["parameters"][0]["after"]
    words = ("--junit", "j.xml", "--markdown", "m.md", "--annotations")
    told = cli("gate", "later", "--baseline", "b.json", *words).stdout
    assert "::error file=b.json,title=sysid-bench gate::arm base parameters: " in told
    cases = list(ElementTree.parse(tmp_path / "j.xml").iter("testcase"))
    assert sum(case.find("failure") is not None for case in cases) >= 1
    assert len(cases) >= answer["cells"]
    assert "True base parameters that changed" in (tmp_path / "m.md").read_text()
    taken = cli("baseline", "update", "later", "-o", "b.json")
    assert taken.returncode == 0, taken.stderr
    assert saved.read_text() != before
    assert cli("gate", "later", "--baseline", "b.json").returncode == 0


def test_a_tolerance_is_kept_by_an_update(cli: Cli, saved: Path) -> None:
    words = ("--metrics", "rank,torque_error", "--tolerance", "torque_error=1.5")
    assert cli("baseline", "save", "run", "-o", "own.json", *words).returncode == 0
    assert cli("baseline", "update", "run", "-o", "own.json").returncode == 0
    kept = json.loads((saved.parent / "own.json").read_text())
    assert kept["metrics"] == ["rank", "torque_error"]
    assert kept["tolerances"]["torque_error"]["ratio"] == 1.5


@pytest.mark.parametrize(
    "words",
    [
        ("gate", "run", "--baseline", "arm.xml"),
        ("gate", "run", "--baseline", "absent.json"),
        ("gate", "absent", "--baseline", "b.json"),
        ("run", "s.toml", "-o", "other", "--baseline", "arm.xml"),
        ("baseline", "save", "run", "-o", "c.json", "--metrics", "torque_eror"),
        ("baseline", "save", "run", "-o", "c.json", "--tolerance", "seconds=2"),
        ("baseline", "save", "run", "-o", "c.json", "--tolerance", "torque_error=small"),
        ("baseline", "save", "run", "-o", "c.json", "--tolerance", "torque_error=0.5"),
    ],
)
def test_wrong_words_are_one_sentence(cli: Cli, saved: Path, words: tuple[str, ...]) -> None:
    done = cli(*words)
    assert done.returncode == 2, done.stdout
    one_sentence(done)
    assert not (saved.parent / "c.json").exists()
    assert not (saved.parent / "other").exists()


def test_two_runs_are_compared(cli: Cli, saved: Path, tmp_path: Path) -> None:
    same = cli("compare", "run", "b.json")
    assert same.returncode == 0, same.stderr
    assert ", 0 changed." in same.stdout
    assert not json.loads(cli("compare", "run", "b.json", "--format", "json").stdout)["changes"]
    text = saved.read_text()
    saved.write_text(text.replace('"numpy": "', '"numpy": "0').replace('"ok",', '"failed",', 1))
    answer = json.loads(cli("compare", "b.json", "run", "--format", "json").stdout)
    assert [change["metric"] for change in answer["changes"]] == ["status"]
    assert answer["equal"] == answer["cells"] - 1
    assert "numpy" in {entry[0] for entry in answer["origin"]}
    done = cli("compare", "b.json", "run", "--html", "c.html", "--format", "csv")
    assert done.stdout.startswith("metric,")
    page = (tmp_path / "c.html").read_text()
    assert "failed" in page
    assert "http" not in page
    assert "\\toprule" in cli("compare", "b.json", "run", "--format", "latex").stdout
    assert "did you mean" in cli("compare", "b.json", "run", "--format", "lates").stderr.lower()
    assert "sysid-bench run run " in cli("compare", "b.json", "run").stdout
    assert "reproduce" not in cli("compare", "run", "b.json").stdout
    done = cli("compare", "b.json", "run", "--metrics", "seconds")
    assert "no metric is in both" in one_sentence(done)
