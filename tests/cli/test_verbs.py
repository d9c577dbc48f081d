"""Each command, with its output and exit code as the contract has them."""

import csv
import io
import json
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from sysid_bench.models.load import load_robot

from .conftest import Run, one_sentence, rows_of, small_suite

FIELDS = {
    "robot", "file", "ok", "reason", "nq", "nv", "bodies", "joints", "gap", "closure",
    "native_gap", "native_reason", "simulation_gap", "simulation_reason", "engine",
    "base_parameters", "near_degenerate", "rank_gap",
    "coupling", "repairs",
}  # fmt: skip


def test_crosscheck_prints_the_fields_of_the_contract(program: Run) -> None:
    done = program("crosscheck", "ur5", "solo12", "--json")
    assert done.returncode == 0, done.stderr
    ur5, solo12 = json.loads(done.stdout)
    assert set(ur5) == FIELDS == set(solo12)
    assert ur5["ok"]
    assert ur5["base_parameters"] == 36
    assert ur5["nv"] == 6
    assert ur5["gap"] <= 1e-12
    assert ur5["closure"] <= 1e-11
    if ur5["engine"] == "pinocchio":
        assert ur5["native_gap"] <= 1e-12
    else:
        assert ur5["native_reason"]
    assert solo12["nv"] == 18
    assert solo12["joints"][0] == {"name": "root", "type": "free"}


def test_free_base_is_a_word_of_the_command_line(cli: Run) -> None:
    done = cli("crosscheck", "ur5", "--free-base", "--json")
    (verdict,) = json.loads(done.stdout)
    assert verdict["ok"]
    assert verdict["nv"] == 12
    assert verdict["nq"] == 13


def test_crosscheck_of_a_broken_file_is_a_verdict(cli: Run, tmp_path: Path) -> None:
    (tmp_path / "broken.urdf").write_text('<robot name="x"><link name="a"></robot>')
    done = cli("crosscheck", "broken.urdf", "ur5")
    assert done.returncode == 1
    assert "broken.urdf" in one_sentence(done)
    assert "ur5: agrees" in done.stdout


@pytest.mark.parametrize(
    ("name", "kind"),
    [("panda", "robot"), ("box-2kg", "payload"), ("ols", "estimator"), ("ok", "status")],
)
def test_show_states_the_kind(cli: Run, name: str, kind: str) -> None:
    assert json.loads(cli("show", name, "--json").stdout)["kind"] == kind


@pytest.mark.parametrize("kind", ["log-readers", "log-reader", "log_reader", "log_readers"])
def test_a_kind_is_singular_or_plural(cli: Run, kind: str) -> None:
    listed = cli("list", kind)
    assert listed.returncode == 0, listed.stderr
    first = listed.stdout.splitlines()[0]
    assert first.endswith("Lines of numbers separated by comma, semicolon, tab or blanks.")
    assert first in cli("show", kind).stdout.splitlines()


def test_plan_counts_and_refuses_with_lines(cli: Run, tmp_path: Path) -> None:
    counted = json.loads(cli("plan", "smoke", "--json").stdout)
    assert counted["cells"] == 120
    assert counted["errors"] == []


@pytest.mark.long
def test_a_run_from_the_first_command_to_the_report(cli: Run, program: Run, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(small_suite(payloads=("none", "box-2kg")))
    done = program("run", "s.toml", "-o", "out", "-j", "2")
    assert done.returncode == 0, done.stderr
    assert "12 ok" in done.stdout
    assert "report.html" in done.stdout
    out = tmp_path / "out"
    for name in (
        "run.toml", "plan.jsonl", "env.json", "cells.parquet", "parameters.parquet",
        "joints.parquet", "tables/main.md", "tables/main.csv", "tables/main.tex",
        "tables/numbers.tex", "figures/main.pdf", "report.html",
    ):  # fmt: skip
        assert (out / name).stat().st_size > 0, name
    cells = pd.read_parquet(out / "cells.parquet")
    assert len(cells) == 12
    assert set(cells["status"]) == {"ok"}
    exact = cells[cells["noise"] == "exact"]
    assert (exact["beta_error"] <= 1e-9).all()
    assert (exact["torque_error"] <= 1e-9).all()
    assert json.loads(cli("status", "out", "--json").stdout)["open"] == 0
    row = json.loads(cli("cell", "out", cells["id"][0], "--json").stdout)
    assert row["id"] == cells["id"][0]
    assert row["command"].startswith("sysid-bench run out")
    for form, mark in (
        ("md", "| robot |"),
        ("csv", "robot"),
        ("latex", "\\toprule"),
        ("json", '"entries"'),
    ):
        assert mark in cli("table", "out", "main", "--format", form).stdout
    assert "'main'" in one_sentence(cli("table", "out", "mian"))


def test_a_recording_is_sound(cli: Run, copied: Path) -> None:
    origin = "% made by: sysid-bench run s.toml --set run.timeout=50s\n"
    assert origin in (copied / "run" / "tables" / "errors.tex").read_text()
    done = cli("record", "run", 'repeat == 2 and estimator == "wls"')
    assert done.returncode == 0, done.stderr
    (path,) = done.stdout.split()
    assert f"sysid-bench view run {Path(path).parent.name}\n" in done.stderr
    rerun = Path(sys.executable).with_name("rerun")
    verified = subprocess.run([rerun, "rrd", "verify", copied / path], capture_output=True)
    assert verified.returncode == 0, verified.stderr


def test_doctor_finds_this_machine_fit(cli: Run) -> None:
    done = cli("doctor", "--json")
    findings = json.loads(done.stdout)
    assert done.returncode == 0, done.stderr
    assert findings["ok"], findings
    assert {"packages", "example-robot-data", "robots"} <= {c["name"] for c in findings["checks"]}


def test_the_rows_carry_versions_and_a_fingerprint(cli: Run, copied: Path) -> None:
    rows = rows_of(copied / "run")
    assert all(row["fingerprint"] and row["versions"]["mujoco"] for row in rows)
    assert cli("run", "run", "-j", "1", "--rerun", "stale").returncode == 0
    assert rows_of(copied / "run") == rows


COVERAGE = """
schema = 1
name = "covered"
seed = 5
[run]
repeats = 24
[defaults]
prior = "none"
terms = [["viscous"]]
excitation = { use = "fourier", harmonics = 2, period = "2 s", cycles = 6 }
held_out = [["ptp"]]
rate = "50 Hz"
noise = { tau = "1 %", tau_correlation = 0.95 }
[[robot]]
use = "scara"
[[estimator]]
use = "wls"
[[estimator]]
use = "ar-gls"
order = 1
[[table]]
name = "coverage"
rows = ["noise"]
columns = ["estimator", "std_from"]
cells = { metric = "coverage", stat = "mean", interval = "ci95" }
[[table]]
name = "efficiency"
rows = ["noise"]
columns = ["estimator"]
cells = { metric = "efficiency", interval = "ci95" }
"""


@pytest.mark.long
def test_a_suite_measures_coverage_and_efficiency(cli: Run, tmp_path: Path) -> None:
    (tmp_path / "covered.toml").write_text(COVERAGE)
    done = cli("run", "covered.toml", "-o", "out", "-j", "1")
    assert done.returncode == 0, done.stderr
    lines = (cli("table", "out", name, "--format", "csv") for name in ("coverage", "efficiency"))
    coverage, efficiency = (list(csv.DictReader(io.StringIO(result.stdout))) for result in lines)
    found = {(line["estimator"], line["std_from"]): line for line in coverage}
    kinds = [("wls", kind) for kind in ("periods", "residuals", "textbook")]
    assert set(found) == {*kinds, ("ar-gls", "textbook")}
    for line in found.values():
        assert line["n"] == "24"
        assert 0 <= float(line["low"]) <= float(line["value"]) <= float(line["high"]) <= 1
    textbook, periods = (float(found["wls", kind]["value"]) for kind in ("textbook", "periods"))
    assert textbook < 0.8 < periods
    of = {line["estimator"]: line for line in efficiency}
    assert float(of["wls"]["value"]) < float(of["ar-gls"]["value"])  # of the same noise
    assert 0.6 < float(of["ar-gls"]["value"]) < 1.2
    assert "coverage.svg" in {path.name for path in (tmp_path / "out" / "figures").iterdir()}


def test_gravity_stands_before_the_verb(cli: Run, tmp_path: Path) -> None:
    # Gravity across the first axis shows two more parameters of the first link.
    for gravity, count in (("0,0,9.81", 36), ("9.81 0 0", 38)):
        done = cli("--gravity", gravity, "basis", "ur5", "--json")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["inertial"] == count
    for words, part in (
        (("--gravity", "1,2", "basis", "ur5"), "as 0,0,-9.81"),
        (("--gravity", "0,0,-9.81", "status", str(tmp_path)), "on the line"),
        (("basis", "ur5", "--gravity", "0,0,-9.81"), "before the verb"),
    ):
        done = cli(*words)
        assert done.returncode == 2
        assert part in done.stderr


def test_gravity_of_a_source_is_that_of_the_robot() -> None:
    robot = load_robot("ur5?gravity=0,0,9.81")
    assert robot.mj.opt.gravity.tolist() == [0, 0, 9.81]
    assert robot.manifest.gravity == (0, 0, 9.81)
