"""Pages and entries of the reference by name, as `sysid-bench help` finds them."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from itertools import chain
from typing import Final

import click

from sysid_bench.commands.catalogue import WORDS
from sysid_bench.errors import unknown_name
from sysid_bench.plugin_names import BUILTIN
from sysid_bench.reference.page import Entry, Section
from sysid_bench.reference.pages import PLUGINS, package_names, pages, title_by_page

_MOST: Final = 4
"""Entries of one name that are printed whole; more are listed."""


@dataclass(frozen=True)
class HelpText:
    """Answer to a request: a title, its text as Markdown, and the entries that it holds or that
    have its name."""

    name: str
    title: str
    text: str
    entries: tuple[Entry, ...]


def find_help(name: str, group: click.Group) -> HelpText:
    """Return a page, or what has a name on any page; raises UsageError with the nearest names.

    `group` has the verbs. Pages of plug-ins are made where their plug-ins have the name, or where
    no other page has it: importing all plug-ins takes seconds.
    """
    name, titles = name.strip().strip("[]"), title_by_page()
    # Typed as words, as they are spoken: "joint terms" is the page joint-terms.
    plain = name.lower().replace(" ", "-").replace("_", "-")
    for page_name in (plain, f"{plain}s", f"{plain}es"):  # "estimator", "log readers"
        if page_name in titles:
            page = find_page(page_name, group)
            entries = tuple(page.entries(page_name))
            return HelpText(page_name, titles[page_name], str(page), entries)
    costly = _costly_pages(name)
    known: list[Entry] = []
    # The quick pages first; those that import plug-ins only where no other has the name.
    for names in ([one for one in titles if one not in costly], costly):
        known += [entry for one in names for entry in find_page(one, group).entries(one)]
        found = _named_entries(known, name)
        if found:
            return HelpText(name, found[0].title, _text(found), tuple(found))
    words = {word for entry in known for word in entry.words[1:]}
    raise unknown_name("topic", name, {*titles, *words}, "All topics: sysid-bench help.")


def _named_entries(known: list[Entry], name: str) -> list[Entry]:
    """Entries of a whole name, else those that have it among their words."""
    whole = [entry for entry in known if entry.name_on_page == name]
    found = whole or [entry for entry in known if name in entry.words]
    # Sections before lines, whole names before last parts, else as on the pages.
    return sorted(found, key=lambda entry: (not entry.is_section, entry.name != name))


@cache
def find_page(name: str, group: click.Group) -> Section:
    """Return a page; made once, which takes up to seconds."""
    return pages(group)[name]()


def _costly_pages(name: str) -> list[str]:
    """Pages whose making imports plug-ins or many modules, and that have no plug-in of a name."""
    names: dict[str, Iterable[str]] = {"json": (), "python": package_names()}
    for page, (_, kinds) in PLUGINS.items():
        names[page] = {*chain.from_iterable(BUILTIN[kind] for kind in kinds), *WORDS.get(page, ())}
    first, _, last = name.rpartition(".")
    return [
        page
        for page in title_by_page()
        if page in names and page != first and {*names[page]}.isdisjoint((first, last))
    ]


def _text(found: list[Entry]) -> str:
    if len(found) > _MOST:
        lines = (f"- `{entry.name_on_page}`: {entry.title}" for entry in found)
        return f"{len(found)} entries have this name; choose one:\n\n" + "\n".join(lines) + "\n"
    return "\n\n".join(f"## `{entry.name_on_page}`\n\n{entry.text}" for entry in found) + "\n"
