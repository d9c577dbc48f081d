"""The README's blocks run as they are printed, top to bottom, in one empty folder."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FILE = re.compile(r"^# file: (\S+)\n")


def blocks() -> list[tuple[str, str]]:
    """(language, text) of every fenced block."""
    return BLOCK.findall((ROOT / "README.md").read_text(encoding="utf-8"))


def commands() -> list[str]:
    """Every shell line that is not `make`, which other jobs run."""
    lines = [line for kind, text in blocks() if kind == "sh" for line in text.splitlines()]
    return [line for line in lines if line and not line.startswith("make ")]


def execute(words: list[str], folder: Path) -> None:
    """Runs a command in the folder with `sysid-bench` on the path."""
    scripts = folder / ".bin"
    env = {
        **os.environ,
        "PATH": f"{scripts}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
    }
    done = subprocess.run(
        words, cwd=folder, env=env, text=True, capture_output=True, timeout=300, check=False
    )
    assert done.returncode == 0, f"{words}: {done.stdout}\n{done.stderr}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A reader's folder: the files that the README shows, and the command."""
    made = tmp_path_factory.mktemp("reader")
    script = made / ".bin" / "sysid-bench"
    script.parent.mkdir()
    script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m sysid_bench "$@"\n')
    script.chmod(0o755)
    for _, text in blocks():
        named = FILE.match(text)
        if named:
            file = made / named[1]
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8")
    return made


@pytest.mark.long
def test_every_command_of_the_readme_runs(folder: Path) -> None:
    assert len(commands()) >= 8
    for line in commands():
        execute(["sh", "-c", line], folder)
    assert (folder / "reports" / "tour" / "report.html").is_file()


@pytest.mark.long
def test_every_python_block_of_the_readme_runs(folder: Path) -> None:
    scripts = [text for kind, text in blocks() if kind == "python" and not FILE.match(text)]
    assert scripts
    for text in scripts:
        (folder / "block.py").write_text(text)
        execute([sys.executable, "block.py"], folder)


def test_the_make_targets_of_the_readme_exist() -> None:
    named = re.findall(r"^make (\w+)", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert {"smoke", "test"} <= set(named)
    if shutil.which("make") is None:
        pytest.skip("make is not on this machine")
    for target in named:
        dry = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, check=False)
        assert dry.returncode == 0, dry.stderr


def test_what_the_readme_links_to_is_there() -> None:
    for link in re.findall(r"\]\(([^)#:]+)\)", (ROOT / "README.md").read_text()):
        assert (ROOT / link).exists(), link
