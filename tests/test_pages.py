"""The pages of docs/: each page's files alone make its commands run, top to bottom, in a folder."""

import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.printed_commands import blocks, place, run_line, run_python

DOCS = Path(__file__).parents[1] / "docs"
ELSEWHERE = {"continuous-integration.md", "index.md", "servo-arm.md"}
"""Run by tests of their own; commands of the first page, which run on other pages."""


def blocks_of(page: Path) -> list[tuple[str, str]]:
    """(language, text) of every fenced block."""
    return blocks(page.read_text(encoding="utf-8"))


def pages() -> list[Path]:
    """Pages with commands or Python."""
    return [
        page
        for page in sorted(DOCS.rglob("*.md"))
        if page.name not in ELSEWHERE and {kind for kind, _ in blocks_of(page)} & {"sh", "python"}
    ]


def steps(page: Path, folder: Path) -> list[tuple[str, str]]:
    """(language, line or Python) of a page in their order, once its files are written."""
    found = []
    for kind, text in blocks_of(page):
        is_file = place(folder, text)
        if kind == "sh":
            found += [(kind, line) for line in text.splitlines() if line]
        elif kind == "python" and not is_file:
            found.append((kind, text))
    return found


def marked(page: Path) -> Any:
    """A page, and the target that runs it: tutorials repeat much of the other pages."""
    mark = pytest.mark.tutorial if page.parent.name == "tutorials" else pytest.mark.long
    return pytest.param(page, marks=mark, id=page.stem)


@pytest.mark.parametrize("page", [marked(page) for page in pages()])
def test_a_page_runs_as_printed(page: Path, tmp_path: Path) -> None:
    for kind, text in steps(page, tmp_path):
        done = (run_line if kind == "sh" else run_python)(text, tmp_path)
        assert done.returncode == 0, f"{text}: {done.stdout}\n{done.stderr}"
    if page.name == "plug-ins.md":  # the method of the reader is in the table
        assert "Ridge" in (tmp_path / "reports" / "mine" / "tables" / "main.md").read_text()


@pytest.mark.data
@pytest.mark.tutorial
def test_the_servo_arm_runs_as_printed(data_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "so101_sage").symlink_to(data_folder / "so101_sage")
    shutil.copy(data_folder / "robots/robotstudio_so101__so101.xml", tmp_path / "so101.xml")
    for kind, text in steps(DOCS / "tutorials/servo-arm.md", tmp_path):
        done = (run_line if kind == "sh" else run_python)(text, tmp_path)
        assert done.returncode == 0, f"{text}: {done.stdout}\n{done.stderr}"


def test_the_tutorials_have_commands() -> None:
    names = {page.stem for page in pages()} | {"servo-arm"}
    assert {page.stem for page in (DOCS / "tutorials").glob("*.md")} <= names
    assert len(names) >= 7


def test_what_the_pages_link_to_is_there() -> None:
    made = re.compile(r"reference/|reports/index")  # pages from the code and of the reports
    for page in DOCS.rglob("*.md"):
        for link in re.findall(r"\]\(([^)#:\s]+)", page.read_text(encoding="utf-8")):
            if not made.search(link.removeprefix("../../").removeprefix("../reports/")):
                assert (page.parent / link).exists(), f"{page.name}: {link}"
