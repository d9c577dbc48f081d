"""Baselines on the command line: save, gate, update, and runs that are gated."""

import json
import re
import shutil
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest

import sysid_bench
from sysid_bench.commands.gate import cell_text
from sysid_bench.commands.run_folder import open_run
from sysid_bench.errors import UsageError
from sysid_bench.harness.comparison.baseline import baseline_of, from_text, to_text
from sysid_bench.harness.comparison.speed import EXPERIMENT, KERNEL

from .conftest import ARM, ROBOT, Run, keep_rows, one_sentence


@pytest.fixture(scope="module")
def timed(stored: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A baseline with times of the run, and the run with two repeats alone."""
    folder = Path(shutil.copytree(stored, tmp_path_factory.mktemp("timed"), dirs_exist_ok=True))
    sysid_bench.baseline_save(folder / "run", folder / "timed.json", times=True)
    shutil.copytree(folder / "run", folder / "few")
    keep_rows(folder / "few", lambda row: row["repeat"] < 2)
    return folder


@pytest.fixture
def saved(copied: Path) -> Path:
    return copied / "b.json"


@pytest.mark.long
def test_the_same_code_keeps_its_baseline(cli: Run, saved: Path, tmp_path: Path) -> None:
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


@pytest.mark.long
def test_an_inertia_that_moves_by_a_percent_is_found(cli: Run, saved: Path, tmp_path: Path) -> None:
    suite = saved.with_name("s.toml")
    suite.write_text(suite.read_text().replace(ARM, "file:arm.xml"))
    assert cli("run", "s.toml", "-o", "own").returncode == 0
    assert cli("baseline", "save", "own", "-o", "b.json").returncode == 0
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


def test_a_tolerance_is_kept_by_an_update(cli: Run, saved: Path) -> None:
    words = ["--metrics", "rank,gap,torque_error", "--tolerance", "torque_error=1.5"]
    words += ["--tolerance", "rank=1.1", "--tolerance", "gap=1e-9"]
    assert cli("baseline", "save", "run", "-o", "own.json", *words).returncode == 0
    assert cli("baseline", "update", "run", "-o", "own.json").returncode == 0
    kept = json.loads((saved.parent / "own.json").read_text())
    assert kept["metrics"] == ["rank", "gap", "torque_error"]
    assert kept["tolerances"] == {
        "rank": {"ratio": 1.1}, "gap": {"absolute": 1e-9},
        "torque_error": {"ratio": 1.5, "floor": 1e-11},
    }  # fmt: skip
    refused = cli("baseline", "save", "run", "-o", "no.json", "--tolerance", "torque_eror=2")
    assert "torque_eror" in one_sentence(refused)


def test_two_runs_are_compared(cli: Run, saved: Path, tmp_path: Path) -> None:
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
    assert "<th scope=col class=n>robots</th>" in page
    assert "<td class=n>" in page
    assert "\\toprule" in cli("compare", "b.json", "run", "--format", "latex").stdout
    assert "did you mean" in cli("compare", "b.json", "run", "--format", "lates").stderr.lower()
    assert "sysid-bench run run " in cli("compare", "b.json", "run").stdout
    assert "reproduce" not in cli("compare", "run", "b.json").stdout
    done = cli("compare", "b.json", "run", "--metrics", "seconds")
    assert "no metric is in both" in one_sentence(done)


def test_a_gate_names_the_joint_and_the_quantity(cli: Run, saved: Path) -> None:
    file = saved.parent / "run" / "models.json"
    models = json.loads(file.read_text())
    (robot,) = models
    joint = models[robot]["behaviour"][""]["order of joints"][1]
    models[robot]["behaviour"][joint]["viscous friction"] = [5.0]
    models[robot]["behaviour"][""]["gravity"] = [0, 0, -3.7]
    file.write_text(json.dumps(models))
    done = cli("gate", "run", "--baseline", "b.json", "--junit", "j.xml")
    assert done.returncode == 1
    assert "Joints that changed" in done.stdout
    assert re.search(rf"\| {joint} +\| viscous friction", done.stdout)
    assert re.search(r"\| \(robot\) +\| gravity +\| 0 0 -9.81 +\| 0 0 -3.7", done.stdout)
    assert "2 other quantities of robots" in done.stdout
    answer = json.loads(cli("gate", "run", "--baseline", "b.json", "--json").stdout)
    assert {one["joint"] for one in answer["models"]} == {"", joint}
    assert f"{joint}: viscous friction" in (saved.parent / "j.xml").read_text()
    assert "Joints that changed" in cli("compare", "b.json", "run").stdout
    taken = cli("baseline", "update", "run", "-o", "b.json").stdout
    assert "2 changes taken over (2 quantities of robots)" in taken
    assert cli("gate", "run", "--baseline", "b.json").returncode == 0
    file.unlink()  # a run of an earlier version
    older = cli("gate", "run", "--baseline", "b.json")
    assert older.returncode == 0
    assert f"Joints of {robot} are not compared" in older.stdout


def test_exact_lists_what_moved_and_fails_nothing(cli: Run, saved: Path) -> None:
    done = cli("gate", "run", "--baseline", "b.json", "--exact")
    assert (done.returncode, "no value moved" in done.stdout) == (0, True), done.stdout
    assert "between equal versions" in done.stdout
    known = from_text(saved.read_text(), "b.json")
    cells = dict(known.run.cells)
    name, place = next(iter(cells)), [*known.run.metrics].index("torque_error")
    values = list(cells[name].values)
    values[place] = (values[place] or 0.0) * (1 + 1e-9)
    cells[name] = replace(cells[name], values=tuple(values))
    other = baseline_of(replace(known.run, cells=cells), known.tolerances)
    saved.write_text(to_text(other))
    done = cli("gate", "run", "--baseline", "b.json", "--exact")
    assert (done.returncode, "1 values moved" in done.stdout) == (0, True), done.stdout
    answer = json.loads(cli("gate", "run", "--baseline", "b.json", "--exact", "--json").stdout)
    assert [(one["id"], one["metric"]) for one in answer["moved"]] == [(name, "torque_error")]
    saved.write_text(to_text(replace(other, digits=7)))
    refused = one_sentence(cli("gate", "run", "--baseline", "b.json", "--exact"))
    assert "holds 7 digits" in refused
    words = re.search("'sysid-bench (baseline save RUN -o exact.json)'", refused)
    assert words is not None
    assert cli(*words[1].replace("RUN", "run").split()).returncode == 0
    done = cli("gate", "run", "--baseline", "exact.json", "--exact")
    assert (done.returncode, "no value moved" in done.stdout) == (0, True), done.stdout
    assert cli("gate", "run", "--baseline", "b.json").returncode == 0
    old = json.loads(saved.read_text())
    del old["digits"]
    saved.write_text(json.dumps(old))
    assert from_text(saved.read_text(), "b.json").digits == 7


def with_parts(timed: Path, tmp_path: Path, parts: Collection[str], **names: str) -> Path:
    """The baseline with the speeds of some parts alone, some of them under other `names`."""
    known = from_text((timed / "timed.json").read_text(), "timed.json")
    speeds = {
        (robot, names.get(part, part)): speed
        for (robot, part), speed in known.run.speeds.items()
        if part in parts
    }
    file = tmp_path / "b.json"
    file.write_text(to_text(baseline_of(replace(known.run, speeds=speeds), known.tolerances)))
    return file


def test_a_run_keeps_its_own_times(timed: Path) -> None:
    known = from_text((timed / "timed.json").read_text(), "timed.json")
    assert {part for _, part in known.run.speeds} == {EXPERIMENT, KERNEL, "wls", "prior"}
    found = sysid_bench.gate(timed / "run", timed / "timed.json", times=True)
    assert found.ok
    assert found.speeds
    assert found.untimed == []
    assert sysid_bench.gate(timed / "run", timed / "timed.json").speeds == []


def test_times_that_are_not_there_are_an_error(timed: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no part with three CPU times .*repeats = 3"):
        sysid_bench.baseline_save(timed / "few", tmp_path / "none.json", times=True)
    assert not (tmp_path / "none.json").exists()
    with pytest.raises(UsageError, match="no part with three CPU times"):
        sysid_bench.gate(timed / "few", timed / "timed.json", times=True, partial=True)
    other = with_parts(timed, tmp_path, ("wls",), wls="gone")
    with pytest.raises(UsageError, match=r"in the baseline alone: .* gone"):
        sysid_bench.gate(timed / "run", other, times=True)


def test_parts_of_the_baseline_without_times_are_named(timed: Path, tmp_path: Path) -> None:
    file = with_parts(timed, tmp_path, (EXPERIMENT, "prior", "wls"), wls="gone")
    found = sysid_bench.gate(timed / "run", file, times=True)
    (name,) = found.untimed
    assert name.endswith(" gone")
    assert f"1 parts have times in the baseline alone: {name}" in found.summary()
    without = sysid_bench.gate(timed / "run", file)
    assert without.untimed == []
    assert "gone" not in without.summary()


def test_an_update_keeps_times_or_names_those_that_go(timed: Path, tmp_path: Path) -> None:
    file = with_parts(timed, tmp_path, (EXPERIMENT, "prior", "wls"), wls="gone")
    before = from_text(file.read_text(), "b.json").run.speeds
    taken = sysid_bench.baseline_update(timed / "few", file)
    assert taken.kept
    assert "times are those of before" in taken.summary()
    assert from_text(file.read_text(), "b.json").run.speeds == before
    taken = sysid_bench.baseline_update(timed / "run", file)
    assert not taken.kept
    assert "without times that were there: " in taken.summary()
    assert " gone" in taken.summary()
    assert "wls" in {part for _, part in from_text(file.read_text(), "b.json").run.speeds}
    again = sysid_bench.baseline_update(timed / "run", file)
    assert again.untimed == []


def test_methods_of_all_parameters_keep_the_baseline_of_their_run(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(ROBOT.format(izz=0.02))
    methods = '[[estimator]]\nuse = "lmi"\n[[estimator]]\nuse = "wls"\n'
    suite = tmp_path / "s.toml"
    suite.write_text(f'schema = 1\nname = "s"\n[[robot]]\nuse = "file:arm.xml"\n{methods}')
    sysid_bench.run(suite, tmp_path / "run", jobs=1)
    sysid_bench.baseline_save(tmp_path / "run", tmp_path / "b.json")
    baseline = from_text((tmp_path / "b.json").read_text(), "b.json")
    assert baseline.run.parameters
    run = open_run(tmp_path / "run")
    for cell in sysid_bench.plan(suite).cells:  # each alone, as pytest judges it
        row = run.row(cell.id)
        assert row is not None
        assert not cell_text(cell, row, baseline, run)
    # A run without the method whose true parameters the baseline has.
    part = sysid_bench.run(
        suite, tmp_path / "part", jobs=1, select='estimator == "lmi"', baseline=tmp_path / "b.json"
    )
    assert part.exit_code == 0, part.summary()


@pytest.mark.parametrize("edit", ["none", "value", "status", "model", "parameter", "ids"])
def test_a_cell_alone_is_judged_as_the_gate_judges_it(edit: str, copied: Path) -> None:
    """pytest looks at one row at a time: at its status, values, labels, and at its robot."""
    known = from_text((copied / "b.json").read_text(), "b.json")
    run, cells = open_run(copied / "run"), dict(known.run.cells)
    name = next(key for key, cell in cells.items() if "wls" in cell.labels)
    place = [*known.run.metrics].index("torque_error")
    robot, wrong = cells[name].robot, set[str]()
    if edit in ("value", "ids"):
        errors = [*cells[name].values]
        errors[place] = (errors[place] or 0.0) / 1.5
        cells[name], wrong = replace(cells[name], values=tuple(errors)), {name}
    if edit == "status":
        cells[name], wrong = replace(cells[name], status="unsupported"), {name}
    if edit == "ids":  # those of another version of the model
        cells = {f"old-{key}": cell for key, cell in cells.items()}
    models, parameters = dict(known.run.models), dict(known.run.parameters)
    if edit == "model":
        models[robot] = {**models[robot], "": {**models[robot][""], "gravity": [0.0, 0.0, -3.7]}}
        wrong = {*cells}
    if edit == "parameter":
        ((key, true),) = parameters.items()
        parameters[key] = {**true, next(iter(true)): 77.0}
        wrong = {key for key, cell in cells.items() if "wls" in cell.labels}  # `prior` has others
    values = replace(known.run, cells=cells, models=models, parameters=parameters)
    file = copied / "edited.json"
    file.write_text(to_text(baseline_of(values, known.tolerances)))
    baseline = from_text(file.read_text(), "edited.json")
    found = sysid_bench.gate(run.path, file)
    assert found.ok == (edit == "none")
    if edit not in ("model", "parameter"):  # changes of the robot and not of a cell
        assert {one["id"] for one in found.failures} == wrong
    for cell in run.plan.cells:
        row = run.row(cell.id)
        assert row is not None
        text = cell_text(cell, row, baseline, run)
        assert bool(text) == (cell.id in wrong)
        assert ("Joints that changed" in text) == (edit == "model")


def test_a_row_without_a_baseline_has_to_be_ok_and_cross_checked(stored: Path) -> None:
    run = open_run(stored / "run")
    cell = run.plan.cells[0]
    row = run.row(cell.id)
    assert row is not None
    for changes, first in (
        ({}, ""),
        ({"crosscheck": "passed"}, ""),
        ({"crosscheck": "failed", "reason": None}, "the cross-check failed"),
        ({"crosscheck": "failed", "reason": "a gap of 1e-3"}, "a gap of 1e-3"),
        ({"status": "failed", "reason": "no answer"}, "no answer"),
    ):
        text = cell_text(cell, {**row, **changes}, None, run)
        assert text.partition("\n")[0] == first
        if text:  # with what there is of the row, and nothing that is not
            lines = [line.split() for line in text.splitlines()]
            shown = {line[0]: line[1:] for line in lines if line}
            assert shown["status"] == [{**row, **changes}["status"]]
            assert float(shown["condition"][0]) == row["condition"]
            assert ("reason" in shown) == bool(changes.get("reason"))
        assert bool(text) == (f"--select 'id == \"{cell.id}\"'" in text)
