"""Settings after the source of a robot, and the options of the commands that write them."""

import json
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner

import sysid_bench
from sysid_bench.commands.main import main
from sysid_bench.errors import ModelError, UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.payload import parse_payload
from sysid_bench.models.sources import source_settings, with_settings


def test_settings_stand_for_keys_of_the_manifest(tmp_path: Path) -> None:
    source = with_settings("solo12", {"tool": "FL_FOOT", "free_base": False, "assets": None})
    assert source_settings(source) == ("solo12", {"tool": "FL_FOOT", "free_base": False})
    box = parse_payload("box-2kg")
    fixed, floating = load_robot(source, box), load_robot("solo12", box)
    assert (fixed.nv, floating.nv) == (12, 18)
    assert fixed.body_names[fixed.tool_body] == "FL_FOOT" != floating.body_names[floating.tool_body]
    again = with_settings(source, {"free_base": True, "assets": tmp_path})
    assert source_settings(again)[1] == {"tool": "FL_FOOT", "free_base": True, "assets": tmp_path}
    assert with_settings("ur5", {"tool": None}) == "ur5"


def test_a_file_with_a_question_mark_is_a_file(tmp_path: Path) -> None:
    file = tmp_path / "arm?tool=hand.xml"
    file.write_text("<mujoco/>")
    assert source_settings(str(file)) == (str(file), {})


@pytest.mark.parametrize(
    ("source", "error", "words"),
    [
        ("ur5?tol=hand", UsageError, "Did you mean 'tool'"),
        ("ur5?free_base=yes", UsageError, "true or false"),
        ("ur5?assets=nowhere", UsageError, "not a folder"),
        ("ur5?tool=hand", ModelError, "No tool body or site is called 'hand'"),
    ],
)
def test_settings_that_do_not_exist_are_refused(
    source: str, error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        load_robot(source)


def test_settings_follow_the_file_in_every_verb(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "quadruped.urdf"
    file.write_bytes(find_manifest("solo12").path.read_bytes())
    source = f"{file}?tool=FL_FOOT&free_base=true&assets={tmp_path}"

    def called(*words: str) -> str:
        done = CliRunner().invoke(main, words)
        assert done.exit_code == 0, done.output
        return done.output

    shown = json.loads(called("show", source, "--json"))
    assert (shown["tool"], shown["free_base"]) == ("FL_FOOT", True)
    assert shown["assets"] == str(tmp_path)
    called("init", "robot", source, "-o", "robots/quadruped")
    first = Path("robots/quadruped/robot.toml")
    called("init", "suite", "--robot", source, "-o", "suite.toml")
    used = tomllib.loads(Path("suite.toml").read_text(encoding="utf-8"))["robot"][0]["use"]
    for written in (str(first), used):
        robot = load_robot(written)
        assert (robot.nv, robot.body_names[robot.tool_body]) == (18, "FL_FOOT"), written
        assert find_manifest(written).assets == tmp_path


@pytest.mark.parametrize(
    ("words", "culprit"),
    [
        (("show", "wls?tool=hand"), "'wls' is not a robot: only robots have tool"),
        (("init", "robot", "a.urdf", "--tool", "hand"), "behind the file"),
    ],
)
def test_settings_are_of_models_alone(words: tuple[str, ...], culprit: str) -> None:
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 2
    assert culprit in done.output


def test_verbs_use_the_settings() -> None:
    fixed, floating = (sysid_bench.basis(f"solo12?free_base={word}") for word in ("false", "true"))
    assert fixed.base_parameters < floating.base_parameters == 94
