"""Laws of commands with third-party code: what hangs, crashes or exits at its import is listed with
its error; an interrupt leaves what the command has so far."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from sysid_bench import plugin_names
from sysid_bench.commands import catalogue
from sysid_bench.commands.main import main
from tests.faults.runners import left_behind, wait_for

SOUND = '''
from dataclasses import dataclass

print("imported")

@dataclass(frozen=True)
class Thing:
    """A sound thing. More of it."""

    weight: float = 2.0
    odd: object = object
'''
BROKEN = {
    "raises": ("raise RuntimeError('boom')", "RuntimeError: boom"),
    "exits": ("raise SystemExit(0)", "SystemExit"),
    "aborts": ("import os; os.abort()", "SIGABRT"),
    "hangs": ("import time; time.sleep(1e6)", "longer than the limit of 10 s"),
    "lacks": ("", "has no 'Thing'"),
}
OWN_TASK = """
from sysid_bench.experiments.tasks.definitions import RobotTask

class OwnTask(RobotTask): ...
"""
SEARCH = (
    *("excite", "scara", "--task", "file:own_task.py:OwnTask", "--iterations", "1000000"),
    *("--harmonics", "2", "--period", "2", "-o", "motion.csv"),
)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Names of installed estimators: a sound one before, among and after broken ones."""
    names = ["sound1", "raises", "exits", "sound2", "aborts", "hangs", "lacks", "sound3"]
    for name in names:
        text = BROKEN[name][0] if name in BROKEN else SOUND
        (tmp_path / f"own_{name}.py").write_text(text)
    points = "".join(f"{name} = own_{name}:Thing\n" for name in names)
    folder = tmp_path / "own-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: own\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(f"[sysid_bench.estimators]\n{points}")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(catalogue, "SECONDS", 10.0)
    plugin_names._installed.cache_clear()
    yield names
    plugin_names._installed.cache_clear()


def command(*words: str) -> Result:
    return CliRunner().invoke(main, words)


def test_names_of_installed_packages_that_cannot_be_imported(installed: list[str]) -> None:
    modules = set(sys.modules)
    listed = command("list", "estimators", "--json")
    assert (listed.exit_code, listed.stderr) == (0, "")
    titles = {entry["name"]: entry["title"] for entry in json.loads(listed.stdout)}
    assert list(titles)[-len(installed) :] == installed
    for name in installed:
        if name in BROKEN:
            assert titles[name].startswith("cannot be imported: ")
            assert BROKEN[name][1] in titles[name]
        else:
            assert titles[name] == "A sound thing."
    shown = json.loads(command("show", "sound2", "--json").stdout)
    assert shown["settings"] == {"weight": 2.0, "odd": "<class 'object'>"}
    assert "SIGABRT" in json.loads(command("show", "aborts", "--json").stdout)["title"]
    assert command("show", "ols").exit_code == 0
    assert not any(name.startswith("own_") for name in set(sys.modules) - modules)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_search_of_third_party_code(
    tmp_path: Path, token: str, number: signal.Signals
) -> None:
    """It shows its progress on a terminal, and writes the best motion so far."""
    (tmp_path / "own_task.py").write_text(OWN_TASK)
    terminal, stderr = os.openpty()
    path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    with subprocess.Popen(
        [sys.executable, "-m", "sysid_bench", *SEARCH],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE, stderr=stderr, text=True,
    ) as running:  # fmt: skip
        os.close(stderr)
        shown = b""
        while b"evaluations" not in shown:
            shown += os.read(terminal, 1000)
        running.send_signal(number)
        output, _ = running.communicate()
    os.close(terminal)
    assert running.returncode == 130
    assert "interrupted: this is the best feasible motion so far" in output
    assert (tmp_path / "motion.csv").stat().st_size > 0
    assert wait_for(lambda: not left_behind(token)), left_behind(token)


def test_the_table_of_a_paper_for_a_third_party_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_task.py").write_text(OWN_TASK)
    monkeypatch.chdir(tmp_path)
    own = command("basis", "scara", "--paper", "--task", "file:own_task.py:OwnTask")
    assert own.exit_code == 0, own.stderr
    assert own.stdout == command("basis", "scara", "--paper").stdout
