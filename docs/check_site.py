"""Check of a built site: links and anchors lead somewhere, and no page asks another server."""

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

LOADED: Final = {
    "script": "src", "img": "src", "iframe": "src", "source": "src", "video": "src",
    "audio": "src", "embed": "src", "object": "data", "image": "href", "use": "href",
}  # fmt: skip
"""Elements that a browser loads by itself, and the attribute with the address."""

LOADED_LINKS: Final = frozenset({"stylesheet", "icon", "preload", "preconnect", "dns-prefetch"})
"""Relations of <link> that a browser follows by itself."""

_CSS_ADDRESS: Final = re.compile(r"(?:url\(|@import)\s*[\"']?((?:https?:)?//[^\"')\s]+)")


@dataclass
class _Page(HTMLParser):
    """Addresses that a page links to and loads, and the anchors that it has."""

    links: list[str] = field(default_factory=list)
    loads: list[str] = field(default_factory=list)
    anchors: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        super().__init__(convert_charrefs=True)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take up the addresses and anchors of an element."""
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[key] for key in ("id", "name") if key in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        if tag == "link" and LOADED_LINKS & set(values.get("rel", "").split()):
            self.loads.append(values.get("href", ""))
        if LOADED.get(tag) in values:
            self.loads.append(values[LOADED[tag]])


def faults(site: Path) -> list[str]:
    """Return what is wrong with the site, a line each."""
    pages = sorted(site.rglob("*.html"))
    if not pages:
        return [f"{site}: no page is there; 'make docs' builds them."]
    found = [fault for page in pages for fault in _faults_of(page, site)]
    return found + [fault for file in sorted(site.rglob("*.css")) for fault in _requests(file)]


def _faults_of(page: Path, site: Path) -> Iterator[str]:
    parsed = _parsed(page)
    for address in (*parsed.loads, *parsed.links):
        parts = urlsplit(address)
        if parts.scheme in ("http", "https") or parts.netloc:
            if address in parsed.loads:
                yield f"{page}: loads {address} from another server."
        elif not parts.scheme and page.name != "404.html":  # served at any depth
            yield from _missing(page, parts.path, parts.fragment, site)


def _missing(page: Path, path: str, anchor: str, site: Path) -> Iterator[str]:
    target = (page.parent / unquote(path)).resolve() if path else page.resolve()
    if target.is_dir():
        target = target / "index.html"
    if not target.is_file() or not target.is_relative_to(site.resolve()):
        yield f"{page}: links to {path}, which is not there."
    elif anchor and target.suffix == ".html" and unquote(anchor) not in _parsed(target).anchors:
        yield f"{page}: links to {path}#{anchor}; that page has no such anchor."


@cache
def _parsed(page: Path) -> _Page:
    parser = _Page()
    parser.feed(page.read_text(encoding="utf-8"))
    return parser


def _requests(file: Path) -> Iterator[str]:
    text = file.read_text(encoding="utf-8")
    yield from (f"{file}: loads {url}." for url in _CSS_ADDRESS.findall(text))


def main(site: str) -> int:
    """Print the faults of a site and the number of its pages; return the exit code."""
    found = faults(Path(site))
    print("\n".join(found) or f"{len(list(Path(site).rglob('*.html')))} pages: links hold")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
