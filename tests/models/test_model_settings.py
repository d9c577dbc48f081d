"""Settings after the source of a robot, and the options of the commands that write them."""

import json
import re
import tomllib
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

import sysid_bench
from sysid_bench.commands.main import main
from sysid_bench.commands.request import Request, model
from sysid_bench.commands.shell import click_command
from sysid_bench.errors import ModelError, UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.payload import parse_payload
from sysid_bench.models.sources import source_settings, with_settings
from sysid_bench.reference.command_page import commands


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


def _takes_a_model(command: click.Command) -> bool:
    """Test for a parameter that says so by its words: MODEL, ROBOT, --model, --robot."""
    return any(
        {"--model", "--robot"} & set(item.opts)
        or re.search(r"\b(MODEL|ROBOT)\b", str(item.metavar))
        or (isinstance(item, click.Argument) and item.name in ("robot", "model"))
        for item in command.params
    )


def test_every_command_that_takes_a_model_takes_the_options() -> None:
    taking = {words: c for words, c in commands(main) if _takes_a_model(c) or words == "show"}
    assert len(taking) >= 12
    for words, command in taking.items():
        names = {option for item in command.params for option in item.opts}
        assert {"--assets", "--tool", "--free-base"} <= names, words


def test_show_and_first_files_keep_the_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "quadruped.urdf"
    file.write_bytes(find_manifest("solo12").path.read_bytes())
    options = ["--tool", "FL_FOOT", "--free-base", "--assets", str(tmp_path)]

    def called(*words: str) -> str:
        done = CliRunner().invoke(main, [*words, *options])
        assert done.exit_code == 0, done.output
        return done.output

    shown = json.loads(called("show", str(file), "--json"))
    assert (shown["tool"], shown["free_base"]) == ("FL_FOOT", True)
    assert shown["assets"] == str(tmp_path)
    called("init", "robot", str(file), "-o", "robots/quadruped")
    called("init", "suite", "--robot", str(file), "-o", "suite.toml")
    used = tomllib.loads(Path("suite.toml").read_text(encoding="utf-8"))["robot"][0]["use"]
    for source in ("robots/quadruped/robot.toml", used):
        robot = load_robot(source)
        assert (robot.nv, robot.body_names[robot.tool_body]) == (18, "FL_FOOT"), source
        assert find_manifest(source).assets == tmp_path
    done = CliRunner().invoke(main, ["show", "wls", "--tool", "hand"])
    assert done.exit_code == 2
    assert "'wls' is no robot: only robots have tool" in done.output
    done = CliRunner().invoke(main, ["init", "robot", "--dh", "dh.csv", "--tool", "hand"])
    assert done.exit_code == 2
    assert "--tool: of a model alone" in done.output


def test_options_become_settings_of_all_models(tmp_path: Path) -> None:
    class Verb(Request[None]):
        """A verb of models."""

        models: tuple[str, ...] = model("MODEL...", several=True)

        def shell(self, as_json: bool) -> int:
            click.echo(" ".join(self.models))
            return 0

    verb = click_command(Verb, "verb")
    done = CliRunner().invoke(verb, ["ur5", "x.xml", "--tool", "hand", "--free-base"])
    assert done.output == "ur5?tool=hand&free_base=true x.xml?tool=hand&free_base=true\n"
    assert CliRunner().invoke(verb, ["ur5"]).output == "ur5\n"


def test_verbs_use_the_settings() -> None:
    fixed, floating = (sysid_bench.basis(f"solo12?free_base={word}") for word in ("false", "true"))
    assert fixed.base_parameters < floating.base_parameters == 94
