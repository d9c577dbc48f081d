"""The command `help`: the reference by topic and by name."""

from dataclasses import dataclass
from importlib import import_module
from typing import Final

from sysid_bench.reference.find_help import find_help
from sysid_bench.reference.page_text import code, page, table
from sysid_bench.reference.pages import title_by_page
from sysid_bench.verbs.result import Result

_PROGRAM: Final = "sysid_bench.cli"
"""Module of the parser, whose verbs and options are a part of the reference."""


@dataclass(frozen=True, eq=False, repr=False)
class HelpResult(Result):
    """A part of the reference: its name, title and `text` (Markdown), and `entries` {page, name,
    title} that it holds, or that have its name."""

    topic: str
    title: str
    text: str
    entries: list[dict[str, str]]

    def summary(self) -> str:
        """The text as Markdown."""
        return self.text.rstrip("\n")


def help_(topic: str | None = None) -> HelpResult:
    """Return a page of the reference (suite, estimators, metrics, ...), what has a name on any of
    them (an estimator, a verb, a key as "run.memory"), or for None the list of pages.

    Raises UsageError with the nearest names.
    """
    if topic is None:
        return _topics()
    found = find_help(topic, import_module(_PROGRAM).main)
    entries = [_entry(one.page, one.name, one.title) for one in found.entries]
    return HelpResult(found.name, found.title, found.text, entries)


def _topics() -> HelpResult:
    known = title_by_page()
    lines = table(("topic", "about"), [(code(name), title) for name, title in known.items()])
    last = (
        "`sysid-bench help TOPIC` prints one, `sysid-bench help NAME` what has a name on any: an "
        "estimator, a metric, a verb, a key as `run.memory`."
    )
    text = page("# Topics", lines, last)
    return HelpResult("", "Topics", text, [_entry(x, x, title) for x, title in known.items()])


def _entry(page_name: str, name: str, title: str) -> dict[str, str]:
    return {"page": page_name, "name": name, "title": title}
