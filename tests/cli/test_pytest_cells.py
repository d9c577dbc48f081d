"""Cells of a suite as items of pytest: collected, run once, judged by a baseline."""

import os
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path
from xml.etree import ElementTree

import pytest

import sysid_bench

from .conftest import rows_of, small_suite

ROOT = Path(__file__).parents[2]
FAILING = """
from dataclasses import dataclass
@dataclass(frozen=True)
class Failing:
    def solve(self, problem):
        raise ArithmeticError("never")
"""


def run_pytest(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """pytest in a repository of its own, with the plug-in."""
    # Installed, the plug-in is found by its entry point; a second name would be an error.
    installed = entry_points(group="pytest11", name="sysid-bench")
    plugin = [] if installed else ["-p", "sysid_bench.pytest_cells"]
    command = [sys.executable, "-m", "pytest", *plugin, "-q", *words]
    kept = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")}
    return subprocess.run(
        command, cwd=folder, env={**kept, "PYTHONPATH": str(ROOT)}, text=True,
        capture_output=True, timeout=300,
    )  # fmt: skip


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A suite, and the configuration of pytest that names it."""
    (tmp_path / "s.toml").write_text(small_suite(("scara",)))
    (tmp_path / "pytest.ini").write_text("[pytest]\nsysid_suites = s.toml\n")
    (tmp_path / "test_own.py").write_text("def test_own():\n    pass\n")
    return tmp_path


@pytest.mark.long
def test_cells_are_collected_beside_other_tests(repository: Path) -> None:
    names = run_pytest(repository, "--collect-only").stdout
    assert "s.toml::scara[exact-ols-0]" in names
    assert "s.toml::scara[tau_1_%-wls-1]" in names
    assert "test_own.py::test_own" in names
    alone = run_pytest(repository, "--collect-only", "--sysid-suite", "s.toml").stdout
    assert "scara[exact-ols-0]" in alone
    assert "test_own" not in alone
    assert "No suite is called" in run_pytest(repository, "--sysid-suite", "smoek").stderr


@pytest.mark.long
@pytest.mark.parametrize("processes", [0, 2])
def test_selected_cells_run_once_and_a_failure_says_how_to_repeat_it(
    repository: Path, processes: int
) -> None:
    (repository / "failing.py").write_text(FAILING)
    suite = small_suite(("scara",), more='[[estimator]]\nuse = "file:failing.py:Failing"\n')
    (repository / "s.toml").write_text(suite)
    words = ("-k", "tau_1 and (wls or Failing)", "--junit-xml", "j.xml", "-n", str(processes))
    done = run_pytest(repository, *words)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "2 failed, 2 passed" in done.stdout
    assert "ArithmeticError: never" in done.stdout
    assert "sysid-bench run " in done.stdout
    ids = [row["id"] for row in rows_of(repository / ".pytest_cache/d/sysid-bench/s")]
    assert len(ids) == len(set(ids)) == 4
    assert len(list(ElementTree.parse(repository / "j.xml").iter("testcase"))) == 4


@pytest.mark.long
def test_cells_need_no_cache_of_pytest(repository: Path) -> None:
    done = run_pytest(repository, "-k", "tau_1 and wls", "-p", "no:cacheprovider")
    assert done.returncode == 0, done.stdout + done.stderr
    assert rows_of(repository / ".pytest-sysid-bench/s")


@pytest.mark.long
def test_a_baseline_judges_every_cell(repository: Path) -> None:
    sysid_bench.run(repository / "s.toml", repository / "run")
    sysid_bench.baseline_save(repository / "run", repository / "b.json")
    kept = run_pytest(repository, "--sysid-suite", "s.toml", "--sysid-baseline", "b.json")
    assert kept.returncode == 0, kept.stdout
    text = (repository / "b.json").read_text()
    (repository / "b.json").write_text(text.replace('"ok",', '"failed",', 1))
    done = run_pytest(
        repository, "--sysid-suite", "s.toml", "--sysid-baseline", "b.json", "-n", "2"
    )
    assert done.returncode == 1
    assert "1 failed" in done.stdout
    assert "Worse than the baseline" in done.stdout
