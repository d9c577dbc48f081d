"""Pages and entries of the reference by name, as `sysid-bench help` finds them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain
from typing import Final

import click

from sysid_bench.commands.catalogue import WORDS
from sysid_bench.errors import unknown_name
from sysid_bench.plugin_names import BUILTIN
from sysid_bench.reference.entries import Entry, entries_of
from sysid_bench.reference.package_pages import package_names
from sysid_bench.reference.pages import pages, title_by_page
from sysid_bench.reference.plugin_pages import PAGES

_MOST: Final = 4
"""Entries of one name that are printed whole; more are listed."""


@dataclass(frozen=True)
class HelpText:
    """What was asked for: a title, its text as Markdown, and the entries that it holds or that
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
    name = name.strip().strip("[]")
    page = _page_name(name)
    if page is not None:
        text = page_text(page, group)
        return HelpText(page, title_by_page()[page], text, tuple(entries_of(page, text)))
    cheap, costly = _by_cost(name)
    entries = _entries(cheap, group)
    found = _named(entries, name)
    if not found:
        entries += _entries(costly, group)
        found = _named(entries, name)
    if not found:
        words = (word for entry in entries for word in entry.words[1:])
        raise unknown_name(
            "topic", name, {*title_by_page(), *words}, "All topics: sysid-bench help."
        )
    return HelpText(name, found[0].title, _text(found), tuple(found))


@cache
def page_text(name: str, group: click.Group) -> str:
    """Return the Markdown of a page; made once, which takes up to seconds."""
    return pages(group)[name]()


def _entries(names: Iterable[str], group: click.Group) -> list[Entry]:
    return [entry for name in names for entry in entries_of(name, page_text(name, group))]


def _page_name(name: str) -> str | None:
    """Name of a page, also of one of its kind and with blanks: "estimator", "log readers"."""
    plain = name.lower().replace(" ", "-").replace("_", "-")
    known = title_by_page()
    return next((page for page in (plain, f"{plain}s", f"{plain}es") if page in known), None)


def _names_by_page() -> dict[str, set[str]]:
    """Names on the pages whose making imports plug-ins or many modules."""
    names = {
        page: {*chain.from_iterable(map(BUILTIN.__getitem__, kinds))}
        for page, kinds in PAGES.items()
    }
    names |= {"estimators": {*BUILTIN["estimator"]}, "json": set(), "python": {*package_names()}}
    return names | {page: names[page] | {*WORDS[page]} for page in WORDS if page in names}


def _by_cost(name: str) -> tuple[list[str], list[str]]:
    """Pages without plug-ins or with one of that name, then the others."""
    names = _names_by_page()
    first, _, last = name.rpartition(".")
    costly = {page for page in names.keys() - {first} if names[page].isdisjoint((first, last))}
    cheap = [page for page in title_by_page() if page not in costly]
    return cheap, [page for page in title_by_page() if page in costly]


def _named(entries: Sequence[Entry], name: str) -> list[Entry]:
    """Entries with a name or with it as their last word, sections first; the one whose full name
    it is alone."""
    whole = [entry for entry in entries if entry.name_on_page == name]
    found = whole or [entry for entry in entries if name in entry.words]
    return sorted(found, key=lambda entry: (not entry.is_section, entry.name != name))


def _text(found: Sequence[Entry]) -> str:
    if len(found) > _MOST:
        lines = (f"- `{entry.name_on_page}`: {entry.title}" for entry in found)
        return f"{len(found)} entries have this name; choose one:\n\n" + "\n".join(lines) + "\n"
    return "\n\n".join(f"## `{entry.name_on_page}`\n\n{entry.text}" for entry in found) + "\n"
