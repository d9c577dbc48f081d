"""The check of the site finds what is wrong with it, and formulas and links are written for it."""

import re
import tomllib
from pathlib import Path

import pytest

from docs.check_site import faults
from sysid_bench.commands.main import main
from sysid_bench.reference.pages import pages

ROOT = Path(__file__).parents[2]

GOOD = '<a href="b.html#there">b</a><a href="https://example.org">other</a><img src="p.png">'


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Two pages and a picture."""
    (tmp_path / "a.html").write_text(GOOD)
    (tmp_path / "b.html").write_text('<h1 id="there">b</h1><a href="sub/">folder</a>')
    (tmp_path / "p.png").write_bytes(b"")
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "index.html").write_text('<a href="../a.html">a</a>')
    return tmp_path


def test_a_whole_site_has_no_fault(site: Path) -> None:
    assert faults(site) == []


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ('<a href="c.html">', "c.html, which is not there"),
        ('<a href="b.html#nowhere">', "no such anchor"),
        ('<a href="../outside.html">', "not there"),
        ('<img src="q.png">', "q.png"),
        ('<script src="https://cdn.example.org/x.js"></script>', "another server"),
        ('<script src="//cdn.example.org/x.js"></script>', "another server"),
        ('<link rel="preconnect" href="https://fonts.example.org">', "another server"),
        ('<link rel="stylesheet" href="https://fonts.example.org/x.css">', "another server"),
        ('<iframe src="http://example.org"></iframe>', "another server"),
    ],
)
def test_a_fault_is_found_with_its_page(site: Path, text: str, word: str) -> None:
    (site / "a.html").write_text(GOOD + text)
    [fault] = faults(site)
    assert "a.html" in fault
    assert word in fault


def test_a_style_sheet_that_loads_is_found(site: Path) -> None:
    (site / "s.css").write_text("@import '//fonts.example.org/x.css'; a { b: url(p.png) }")
    assert [fault.partition(": ")[2] for fault in faults(site)] == [
        "loads //fonts.example.org/x.css."
    ]


def test_an_empty_folder_is_no_site(tmp_path: Path) -> None:
    assert "make docs" in faults(tmp_path)[0]


def text(name: str) -> str:
    """A file of the checkout."""
    return (ROOT / name).read_text(encoding="utf-8")


def test_the_citation_is_of_this_version() -> None:
    version = tomllib.loads(text("pyproject.toml"))["project"]["version"]
    assert f"\nversion: {version}\n" in text("CITATION.cff")
    assert f"Version {version}, " in text("docs/cite.md")
    assert f"sysid_bench {version}" in text("docs/cite.md")
    assert f"seed {tomllib.loads(text('suites/smoke.toml'))['seed']}" in text("docs/cite.md")


def test_the_hosted_checks_are_those_of_ci() -> None:
    (line,) = re.findall(r"^PARTS: Final = \((.*?)\)", text(".ci/parts.py"), re.M | re.S)
    ours = set(re.findall(r"^make ([\w-]+)", text(".ci/run"), re.MULTILINE))
    (beside,) = re.findall(r"--output-sync=target (.*)", text("Makefile"))
    ours = ours - {"side-by-side", "ratios"} | set(beside.split())
    # Ratios of times and tutorials are apart: they need a machine of their own, or long.
    assert set(re.findall(r'"([\w-]+)"', line)) == ours | {"bench"}
    assert ".ci/parts.py" in text(".github/workflows/checks.yml")


def test_the_glossary_is_short_and_in_order() -> None:
    terms = re.findall(r"^\| ([^|]+?) \|", text("docs/glossary.md"), re.MULTILINE)[2:]
    assert 40 <= len(terms) <= 60
    assert terms == sorted(terms, key=lambda term: term.replace("-", "").lower())


def test_every_page_has_a_place_in_the_site() -> None:
    sources = {str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")}
    made = {f"reference/{name}.md" for name in pages(main)}
    nav = text("mkdocs.yml").partition("nav:\n")[2]
    assert sources | made <= set(re.findall(r"([\w/-]+\.md)$", nav, re.MULTILINE))
