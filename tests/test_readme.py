"""The README's blocks run as they are printed, top to bottom, in one empty folder."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.printed_commands import FILE, blocks, place, run_line, run_python

ROOT = Path(__file__).parents[1]
BLOCKS = blocks((ROOT / "README.md").read_text(encoding="utf-8"))


def commands() -> list[str]:
    """Every shell line that is not `make`, which other jobs run."""
    lines = [line for kind, text in BLOCKS if kind == "sh" for line in text.splitlines()]
    return [line for line in lines if line and not line.startswith("make ")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A reader's folder with the files that the README shows."""
    made = tmp_path_factory.mktemp("reader")
    for _, text in BLOCKS:
        place(made, text)
    return made


@pytest.mark.long
def test_every_command_of_the_readme_runs(folder: Path) -> None:
    assert len(commands()) >= 8
    for line in commands():
        done = run_line(line, folder)
        assert done.returncode == 0, f"{line}: {done.stdout}\n{done.stderr}"
    assert (folder / "reports" / "tour" / "report.html").is_file()


@pytest.mark.long
def test_every_python_block_of_the_readme_runs(folder: Path) -> None:
    scripts = [text for kind, text in BLOCKS if kind == "python" and not FILE.match(text)]
    assert scripts
    for text in scripts:
        done = run_python(text, folder)
        assert done.returncode == 0, f"{text}: {done.stdout}\n{done.stderr}"


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
