"""Verb `help`: the reference by topic and by name."""

from dataclasses import dataclass

from sysid_bench.commands.request import OK, Request, argument, python_function
from sysid_bench.commands.result import Result


class Help(Request["HelpResult"]):
    """Print the reference: a topic, or what has a name in any.

    Without argument it lists the topics.
    """

    topic: str | None = argument(
        "[TOPIC|NAME]", default=None, several=True, parse=" ".join, complete="topics names"
    )

    def run(self) -> "HelpResult":
        """Return a page of the reference (suite, estimators, metrics, ...), what has a name on any
        of them (an estimator, a verb, a key as "run.memory"), or for None the list of pages.

        Raises UsageError with the nearest names.
        """
        from sysid_bench.commands.main import main
        from sysid_bench.reference.find_help import find_help

        if self.topic is None:
            return _topics()
        found = find_help(self.topic, main)
        entries = [_entry(one.page, one.name, one.title) for one in found.entries]
        return HelpResult(found.name, found.title, found.text, entries)

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.terminal import print_json, print_markdown

        result = self.run()
        if as_json:
            print_json(result)
        else:
            print_markdown(result.summary())
        return OK


help_ = python_function(Help, "help_")


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


def _topics() -> HelpResult:
    from sysid_bench.reference.page import Section, Table, code
    from sysid_bench.reference.pages import title_by_page

    known = title_by_page()
    lines = Table(("topic", "about"), [(code(name), title) for name, title in known.items()])
    last = (
        "`sysid-bench help TOPIC` prints one, `sysid-bench help NAME` what has a name on any: an "
        "estimator, a metric, a verb, a key as `run.memory`."
    )
    text = str(Section("# Topics", lines, last))
    return HelpResult("", "Topics", text, [_entry(x, x, title) for x, title in known.items()])


def _entry(page_name: str, name: str, title: str) -> dict[str, str]:
    return {"page": page_name, "name": name, "title": title}
