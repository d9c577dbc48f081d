"""Hooks of MkDocs: reference pages from the code, reference reports, formulas as MathML."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from sysid_bench.commands.main import main
from sysid_bench.reference.pages import pages

ROOT: Final = Path(__file__).parents[1]
_BLOCK: Final = re.compile(r"^\$\$\n(.*?)\n\$\$$", re.MULTILINE | re.DOTALL)
_INLINE: Final = re.compile(r"`[^`\n]*`|\$(?=\S)([^$`\n]*[^$`\s])\$")
_FENCE: Final = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)
_OUTSIDE: Final = "../"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the reference, the reports and the changelog to the sources."""
    for name, make in pages(main).items():
        files.append(File.generated(config, f"reference/{name}.md", content=str(make())))
    for file in _reports():
        files.append(_copy(config, file, f"reports/{file.name}"))
    for name in ("CHANGELOG.md", "CONTRIBUTING.md"):
        files.append(_copy(config, ROOT / name, name.lower()))
    files.append(File.generated(config, "reports/index.md", content=_gallery()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Write formulas as MathML, and links to files beside docs/ as links within the site."""
    depth = page.file.src_uri.count("/")
    text = within_site(markdown, depth)
    parts = _FENCE.split(text)
    return "".join(part if number % 2 else formulas(part) for number, part in enumerate(parts))


def within_site(markdown: str, depth: int = 0) -> str:
    """Return links as they are within the site: those to reports/reference, README.md and so on
    in the repository are written from docs/."""
    up = _OUTSIDE * depth
    text = re.sub(r"\]\((?:\.\./)*reports/reference/", f"]({up}reports/", markdown)
    text = re.sub(r"\]\((?:\.\./)*(CHANGELOG|CONTRIBUTING)\.md", _lower(up), text)
    text = re.sub(r"\]\((?:\.\./)+README\.md", f"]({up}index.md", text)
    return re.sub(r"\]\(docs/", f"]({up}", text)


def _lower(up: str) -> Any:
    return lambda match: f"]({up}{match[1].lower()}.md"


def formulas(text: str) -> str:
    """Return text with `$$` blocks and `$...$` as MathML, which browsers draw without scripts."""
    text = _BLOCK.sub(lambda match: convert(match[1], display="block"), text)
    return _INLINE.sub(lambda match: _within_line(match[1]) if match[1] else match[0], text)


def _within_line(formula: str) -> str:
    """A formula in a line; Markdown takes <math> at its start for a paragraph of its own."""
    return f"<span>{convert(formula)}</span>"


def _reports() -> Iterator[Path]:
    return (file for file in sorted((ROOT / "reports" / "reference").iterdir()) if file.is_file())


def _copy(config: MkDocsConfig, file: Path, uri: str) -> File:
    if file.suffix == ".md":
        # GitHub's Markdown prints "\\<" as "<", that of the site as it stands.
        text = file.read_text(encoding="utf-8").replace("\\<", "&lt;")
        return File.generated(config, uri, content=text)
    return File.generated(config, uri, abs_src_path=str(file))


def _gallery() -> str:
    """Page of the reports with their titles, and of their pictures."""
    reports = [file for file in _reports() if file.suffix == ".md"]
    pictures = [file for file in _reports() if file.suffix == ".png"]
    lines = [f"- [{_title(file)}]({file.name})" for file in reports]
    shown = [f"![{file.stem}]({file.name})\n\n{file.stem}" for file in pictures]
    return "# Reference reports\n\n" + "\n".join(lines) + "\n\n" + "\n\n".join(shown) + "\n"


def _title(file: Path) -> str:
    first = file.read_text(encoding="utf-8").partition("\n")[0]
    return first.removeprefix("# ")
