"""Settings after the source of a robot, and the options of the commands that write them."""

from pathlib import Path

import click
import pytest
from click.testing import CliRunner

import sysid_bench
from sysid_bench.cli import main
from sysid_bench.cli.options import model_options
from sysid_bench.errors import ModelError, UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.models.model_settings import source_settings, with_settings
from sysid_bench.models.payload import parse_payload


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


def test_every_command_that_takes_a_model_takes_the_options() -> None:
    for verb in ("crosscheck", "basis", "lint", "identify", "diagnose", "excite"):
        names = {option for item in main.commands[verb].params for option in item.opts}
        assert {"--assets", "--tool", "--free-base"} <= names, verb


def test_options_become_settings_of_all_models(tmp_path: Path) -> None:
    @click.command()
    @click.argument("models", nargs=-1)
    @model_options("models")
    def verb(models: tuple[str, ...]) -> None:
        click.echo(" ".join(models))

    done = CliRunner().invoke(verb, ["ur5", "x.xml", "--tool", "hand", "--free-base"])
    assert done.output == "ur5?tool=hand&free_base=true x.xml?tool=hand&free_base=true\n"
    assert CliRunner().invoke(verb, ["ur5"]).output == "ur5\n"


def test_verbs_use_the_settings() -> None:
    fixed, floating = (sysid_bench.basis(f"solo12?free_base={word}") for word in ("false", "true"))
    assert fixed.base_parameters < floating.base_parameters == 94
