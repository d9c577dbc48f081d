"""Laws of `plan --no-code`: no line of third-party code runs, and what is absent is found."""

import sys
from pathlib import Path

import pytest

import sysid_bench
from sysid_bench.errors import UsageError

SUITE = """
schema = 1
name = "static"
[[robot]]
use = "scara"
[[estimator]]
use = "{estimator}"
{more}
"""
RUNS = "raise RuntimeError('this code must not run')\n"
METRIC = (
    '[[metric]]\nuse = "file:mine.py:own"\n[[table]]\nname = "t"\ncells = { metric = "own_m" }\n'
)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "mylab").mkdir()
    (tmp_path / "mylab" / "__init__.py").write_text(RUNS)
    (tmp_path / "mylab" / "methods.py").write_text(f"{RUNS}from other import Imported\n")
    (tmp_path / "mine.py").write_text(
        f"{RUNS}from sysid_bench.types import Metric\n"
        "if True:\n    class Inside: ...\n"
        "first, second = object(), object()\n"
        "def own():\n    return Metric('own_m', 'Own', unit='N m', compute=abs)\n"
        "def unknown(name):\n    return Metric(name, 'Own')\n"
    )
    (tmp_path / "broken.py").write_text("def f(:\n")
    (tmp_path / "any.py").write_text(f"{RUNS}from other import *\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def plan(folder: Path, estimator: str, more: str = "") -> sysid_bench.PlanResult:
    file = folder / "suite.toml"
    file.write_text(SUITE.format(estimator=estimator, more=more))
    return sysid_bench.plan(file, no_code=True)


@pytest.mark.parametrize(
    "name",
    [
        *("file:mine.py:Inside", "file:mine.py:first", "file:mine.py:second"),
        *("mylab.methods:Imported", "file:any.py:Whatever"),
    ],
)
def test_a_plan_without_code(name: str, folder: Path) -> None:
    modules = set(sys.modules)
    result = plan(folder, name)
    assert len(result.cells) == 1
    (note,) = [note for note in result.notes if note.startswith("Not imported")]
    assert f"estimator {name}" in note
    assert result.code == ""
    new = set(sys.modules) - modules
    assert not [module for module in new if module.startswith(("mylab", "sysid_bench_file"))]


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("file:mine.py:Outside", "No object in .* is called 'Outside'"),
        ("file:absent.py:Thing", "The file of the estimator .* does not exist"),
        ("file:broken.py:f", "not valid Python"),
        ("mylab.absent:Thing", "The file of the estimator .* does not exist"),
        ("nolab:Thing", "The file of the estimator .* does not exist"),
        ("olz", "Did you mean 'ols'"),
    ],
)
def test_an_absent_plugin(name: str, reason: str, folder: Path) -> None:
    with pytest.raises(UsageError, match=rf"estimator\[0\]: .*{reason}"):
        plan(folder, name)


def test_a_metric_is_read_from_its_literals(folder: Path) -> None:
    assert len(plan(folder, "ols", METRIC).cells) == 1
    with pytest.raises(UsageError, match="are not literals of Metric"):
        plan(folder, "ols", METRIC.replace(":own", ":unknown"))


def test_only_third_party_plugins_are_noted(folder: Path) -> None:
    assert not [note for note in plan(folder, "ols").notes if "Not imported" in note]
