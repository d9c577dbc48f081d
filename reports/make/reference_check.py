"""Pages of reports/reference against what they were made from, in seconds: `make reference-check`.

Found are parts whose text is not what their command printed, origins of a checkout with changes,
numbers in sentences that no cell has (reports/make/page_numbers.py), and parts whose code or data
changed later (reports/make/page_sources.py) where the page does not say so. `--declare` writes into
the pages what has changed; `reports/reference/made.json` holds, for each part, its commit, the
digest of its text, and those of what it depends on.
"""

import json
import re
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import click

from reports.make.page_numbers import PART, problems
from reports.make.page_sources import changed, sources
from sysid_bench.canonical_json import canonical_hash

PAGES: Final = Path(__file__).parents[1] / "reference"
MADE: Final = "made.json"
LATER: Final = "Code or data behind this page changed after it was made: "
_LATER_LINE: Final = re.compile(
    rf"^{LATER}(.*?)\. `make reference [^`]*` makes it again\.\n\n", re.M
)
NOT_AGAIN: Final = "Not made again since commit"
"""Begins the text of a part that is older than its suite, and says why."""
COPIED: Final = frozenset({
    *("actuators", "cluster", "diagnose", "excite", "levels", "real", "scale", "seeds"),
    *("simulating-estimators", "speed", "transfer", "twins", "wild"),
})  # fmt: skip
"""Pages whose tables were copied by hand: they say so, and nothing else in them is checked."""
TYPED: Final = re.compile(r"Its figures are of commit [0-9a-f]{7,40} and are checked by no command")
"""Sentence of a page whose tables were copied by hand."""
_STAMP: Final = re.compile(r"Commit ([0-9a-f]{8})(?: with changes)?, Python ")


@dataclass(frozen=True)
class Made:
    """Origin of a part: command, commit (8 digits), digests of its text and its sources, which
    a part that was not made again does not have."""

    command: str
    commit: str
    text: str
    sources: Mapping[str, str] | None


def made_part(command: str, text: str, commit: str, root: Path | None = None) -> Made:
    """The entry of a part whose text was just made, from the checkout `root`."""
    found = sources(command) if root is None else sources(command, root)
    return Made(command, commit[:8], text_digest(text), found)


def text_digest(text: str) -> str:
    """12 hex digits of the text of a part."""
    return canonical_hash(text.strip())[:12]


def load(folder: Path = PAGES) -> dict[str, list[Made]]:
    """Entries of all parts by page."""
    file = folder / MADE
    found = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    return {page: [Made(**entry) for entry in entries] for page, entries in found.items()}


def save(made: Mapping[str, list[Made]], folder: Path = PAGES) -> None:
    """Write the entries of all parts."""
    found = {page: [asdict(entry) for entry in made[page]] for page in sorted(made)}
    text = json.dumps(found, indent=1, sort_keys=True)
    (folder / MADE).write_text(text + "\n", encoding="utf-8")


def keep(page: str, entry: Made, folder: Path = PAGES) -> None:
    """Put the entry of a part in the place of the one of its command."""
    made = load(folder)
    others = [one for one in made.get(page, []) if one.command != entry.command]
    save(made | {page: sorted([*others, entry], key=lambda one: one.command)}, folder)


def later_changes(made: list[Made]) -> set[str]:
    """Dependencies of the parts of a page that changed since they were made; parts that were not
    made again have no sources."""
    known = [(one.sources, one.command) for one in made if one.sources is not None]
    return set().union(*(changed(before, sources(command)) for before, command in known))


def declared(text: str) -> set[str]:
    """Changes that a page declares."""
    found = _LATER_LINE.search(text)
    return set(found[1].split(", ")) if found else set()


def with_declaration(name: str, text: str, later: set[str]) -> str:
    """The page with the sentence on later changes below its title, where there are any."""
    text = _LATER_LINE.sub("", text)
    if not later:
        return text
    title, _, rest = text.partition("\n\n")
    said = f'{LATER}{", ".join(sorted(later))}. `make reference REPORTS="{name}"` makes it again.'
    return f"{title}\n\n{said}\n\n{rest}"


def found_in(name: str, text: str, made: list[Made]) -> list[str]:
    """Faults of a page."""
    found = list[str]()
    entries = {entry.command: entry for entry in made}
    parts = PART.findall(text)
    commands = [command for command, _ in parts]
    for command, part in parts:
        if command not in entries:
            found.append(f"'{command}' has no entry in {MADE}; make the page again")
        else:
            found += _of_part(entries[command], part)
    twice = {command for command in commands if commands.count(command) > 1}
    found += [f"'{command}' makes more than one part" for command in sorted(twice)]
    found += [f"'{one}' of {MADE} is no part of the page" for one in entries.keys() - {*commands}]
    if name in COPIED:
        if not TYPED.search(text):
            found.append("does not say that its figures are copied")
    else:
        if not parts:
            found.append("has no part that a command makes")
        found += problems(text)
    later = later_changes(made)
    if new := later - declared(text):
        found.append(f"made before changes of {', '.join(sorted(new))}, and does not say so")
    if gone := declared(text) - later:
        found.append(f"says that {', '.join(sorted(gone))} changed; they are as they were")
    return [f"{name}.md: {one}" for one in found]


def _of_part(entry: Made, part: str) -> list[str]:
    found = []
    if text_digest(part) != entry.text:
        found.append(f"'{entry.command}': the text is not what the command printed")
    if entry.sources is None:  # not made again
        if NOT_AGAIN not in part:
            found.append(f"'{entry.command}' is older than its suite, and does not say so")
        return found
    stamp = _STAMP.search(part)
    if "with changes" in part or not re.fullmatch("[0-9a-f]{8}", entry.commit):
        found.append(f"'{entry.command}' was made from a checkout with changes")
    if stamp and stamp[1] != entry.commit:
        found.append(f"'{entry.command}' states commit {stamp[1]}, made of {entry.commit}")
    return found


@click.command()
@click.option("--declare", is_flag=True, help="Write into the pages what has changed since.")
def main(declare: bool) -> None:
    """Check all pages of reports/reference."""
    made = load()
    found = [
        f"{page}.md: is in {MADE} alone" for page in made if not (PAGES / f"{page}.md").is_file()
    ]
    for page in sorted(PAGES.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        entries = made.get(page.stem, [])
        if declare:
            text = with_declaration(page.stem, text, later_changes(entries))
            page.write_text(text, encoding="utf-8")
        found += found_in(page.stem, text, entries)
    for one in found:
        print(one)
    pages = list(PAGES.glob("*.md"))
    later = sum(bool(declared(page.read_text(encoding="utf-8"))) for page in pages)
    print(f"{len(pages)} pages, {later} declared older than their code, {len(found)} faults.")
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
