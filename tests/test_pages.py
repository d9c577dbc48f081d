"""The pages of docs/: each page's files alone make its commands run, top to bottom, in a folder."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

DOCS = Path(__file__).parents[1] / "docs"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FILE = re.compile(r"^(?:#|<!--) file: (\S+)(?: -->)?\n")
ELSEWHERE = {"continuous-integration.md", "index.md"}
"""Run by a test of its own; commands of the first page, which run on other pages."""


def blocks(page: Path) -> list[tuple[str, str]]:
    """(language, text) of every fenced block."""
    return BLOCK.findall(page.read_text(encoding="utf-8"))


def pages() -> list[Path]:
    """Pages with commands or Python."""
    return [
        page
        for page in sorted(DOCS.rglob("*.md"))
        if page.name not in ELSEWHERE and {kind for kind, _ in blocks(page)} & {"sh", "python"}
    ]


def place(files: Path, text: str) -> bool:
    """Write a block that is a file; return whether it is one."""
    named = FILE.match(text)
    if named:
        file = files / named[1]
        file.parent.mkdir(parents=True, exist_ok=True)
        # A comment before an XML document stands on no line of its own in the file.
        file.write_text(text if text.startswith("#") else text[named.end() :], encoding="utf-8")
    return named is not None


def environment(folder: Path) -> dict[str, str]:
    """`sysid-bench` of this interpreter on the path."""
    script = folder / ".bin" / "sysid-bench"
    script.parent.mkdir()
    script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m sysid_bench "$@"\n')
    script.chmod(0o755)
    path = f"{script.parent}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "PYTHONPATH": str(DOCS.parent)}


def steps(page: Path, folder: Path) -> list[list[str]]:
    """Commands of a page in their order, once its files are written."""
    found = []
    for kind, text in blocks(page):
        is_file = place(folder, text)
        if kind == "sh":
            found += [["sh", "-c", line] for line in text.splitlines() if line]
        elif kind == "python" and not is_file:
            found.append([sys.executable, "-c", text])
    return found


def marked(page: Path) -> Any:
    """A page, and the target that runs it: tutorials repeat much of the other pages."""
    mark = pytest.mark.tutorial if page.parent.name == "tutorials" else pytest.mark.long
    return pytest.param(page, marks=mark, id=page.stem)


@pytest.mark.parametrize("page", [marked(page) for page in pages()])
def test_a_page_runs_as_printed(page: Path, tmp_path: Path) -> None:
    env = environment(tmp_path)
    for words in steps(page, tmp_path):
        done = subprocess.run(
            words, cwd=tmp_path, env=env, text=True, capture_output=True, timeout=600, check=False
        )
        assert done.returncode == 0, f"{words}: {done.stdout}\n{done.stderr}"


@pytest.mark.long
def test_a_method_of_the_reader_is_in_the_table(tmp_path: Path) -> None:
    page = DOCS / "plug-ins.md"
    env = environment(tmp_path)
    run = next(words for words in steps(page, tmp_path) if "run mine.toml" in words[-1])
    subprocess.run(run, cwd=tmp_path, env=env, check=True, capture_output=True, timeout=600)
    assert "Ridge" in (tmp_path / "reports" / "mine" / "tables" / "main.md").read_text()


def test_the_tutorials_have_commands() -> None:
    names = {page.stem for page in pages()}
    assert {page.stem for page in (DOCS / "tutorials").glob("*.md")} <= names
    assert len(names) >= 7


def test_what_the_pages_link_to_is_there() -> None:
    made = re.compile(r"reference/|reports/index")  # pages from the code and of the reports
    for page in DOCS.rglob("*.md"):
        for link in re.findall(r"\]\(([^)#:\s]+)", page.read_text(encoding="utf-8")):
            if not made.search(link.removeprefix("../../").removeprefix("../reports/")):
                assert (page.parent / link).exists(), f"{page.name}: {link}"
