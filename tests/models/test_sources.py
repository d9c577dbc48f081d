"""Robots named by the package they lie in, and the base that a suite decides about."""

import sys
import types
from pathlib import Path

import pytest

from sysid_bench import package_folders
from sysid_bench.commands.crosscheck import crosscheck
from sysid_bench.commands.list import show
from sysid_bench.errors import ModelError, UsageError
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.suite.load_suite import parse_suite, suite_text
from sysid_bench.models.manifest import find_manifest
from tests.robots import urdf_files

FILE = "ur_description/urdf/ur5_robot.urdf"


@pytest.mark.parametrize("file", urdf_files())
def test_every_file_of_a_package_is_a_source(file: str) -> None:
    manifest = find_manifest(f"example-robot-data:{file}")
    assert manifest.path == package_folders.robot_data_folder() / file
    assert manifest.name == Path(file).stem


def test_an_unknown_file_of_a_package_names_the_nearest() -> None:
    with pytest.raises(UsageError, match=r"Did you mean 'ur_description/urdf/ur5_robot\.urdf'"):
        find_manifest("example-robot-data:ur_description/urdf/ur5_robt.urdf")


def test_a_robot_description_is_a_source(monkeypatch: pytest.MonkeyPatch) -> None:
    module = types.ModuleType("robot_descriptions.my_description")
    module.URDF_PATH = str(package_folders.robot_data_folder() / FILE)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "robot_descriptions", types.ModuleType("robot_descriptions"))
    monkeypatch.setitem(sys.modules, "robot_descriptions.my_description", module)
    manifest = find_manifest("robot_descriptions:my_description")
    assert (manifest.name, manifest.path) == ("my", package_folders.robot_data_folder() / FILE)
    with pytest.raises(ModelError, match="not installed or not known"):
        find_manifest("robot_descriptions:absent_description")


@pytest.mark.parametrize("source", ["random:3", f"example-robot-data:{FILE}"])
def test_verbs_take_them(source: str) -> None:
    [verdict] = crosscheck(source, samples=5)
    assert verdict["ok"]
    assert show(source)["name"] in source


SUITE = """
schema = 1
name   = "bases"
[[robot]]
use = {use}
{base}
[[estimator]]
use = "ols"
"""


def specs(base: str, use: str = '"ur5"') -> list[ExperimentSpec]:
    return list(cells_of_suite(parse_suite(SUITE.format(use=use, base=base))).spec_list)


def test_a_base_that_is_not_given_leaves_the_id_alone() -> None:
    (plain,), (fixed,), (free,) = specs(""), specs("free_base = false"), specs("free_base = true")
    assert "free_base" not in plain.to_json()
    assert len({plain.id, fixed.id, free.id}) == 3
    for spec in (plain, fixed, free):
        assert ExperimentSpec.from_json(spec.to_json()) == spec


def test_a_robot_may_come_on_both_bases() -> None:
    text = SUITE.format(use='["ur5", "solo12"]', base="free_base = true")
    text += '[[robot]]\nuse = ["ur5", "solo12"]\nfree_base = false\n'
    suite = parse_suite(text)
    assert parse_suite(suite_text(suite)) == suite
    cells = cells_of_suite(suite).cells
    labels = [cell.labels["robot"] for cell in cells]
    assert labels == [f"{r} ({b} base)" for b in ("free", "fixed") for r in ("ur5", "solo12")]
    assert [cell.facts["robot.free_base"] for cell in cells] == [True, True, False, False]
    chosen = cells_of_suite(suite).select('robot == "ur5" and robot.free_base')
    assert [cell.labels["robot"] for cell in chosen] == ["ur5 (free base)"]


@pytest.mark.parametrize(("base", "nv"), [(None, 18), (True, 18), (False, 12)])
def test_the_suite_decides_whether_the_base_floats(base: bool | None, nv: int) -> None:
    assert loaded_robot("solo12", "none", None, None, base).robot.nv == nv


def test_a_base_is_yes_or_no() -> None:
    with pytest.raises(UsageError, match="free_base"):
        specs('free_base = "yes"')


@pytest.mark.parametrize("name", ["_cache", "loaders.pinocchio", "", "a b"])
def test_what_is_no_description_is_not_imported(name: str) -> None:
    with pytest.raises(ModelError, match="not installed or not known"):
        find_manifest(f"robot_descriptions:{name}")


def test_a_description_that_cannot_be_fetched_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "robot_descriptions").mkdir()
    for name, text in (
        ("__init__", ""),
        ("far_description", "raise OSError('git clone\\nfailed\\n' * 99)"),
        ("hand_description", "PACKAGE_PATH = 'x'"),
    ):
        (tmp_path / "robot_descriptions" / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "robot_descriptions", raising=False)
    for name, words in (("far", "could not be downloaded.*internet"), ("hand", "neither a URDF")):
        with pytest.raises(ModelError, match=words) as refusal:
            find_manifest(f"robot_descriptions:{name}_description")
        assert "\n" not in str(refusal.value)
        assert len(str(refusal.value)) < 500


def test_an_unknown_file_lists_a_few() -> None:
    with pytest.raises(UsageError, match=r"ur5_robot\.urdf") as refusal:
        find_manifest("example-robot-data:ur5.urdf")
    assert len(str(refusal.value)) < 400


def test_no_exception_takes_the_other_verdicts_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def breaks(robot: object, samples: int) -> object:
        raise ZeroDivisionError("by chance")

    monkeypatch.setattr("sysid_bench.evaluation.crosscheck.crosscheck", breaks)
    first, second = crosscheck("random:1", "random:2", samples=2)
    for verdict in (first, second):
        assert not verdict["ok"]
        assert verdict["reason"] == "ZeroDivisionError: by chance"
