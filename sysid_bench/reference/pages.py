"""All pages of the reference by their names."""

from collections.abc import Callable, Mapping
from functools import partial

import click

from sysid_bench.harness.suite.model import Suite
from sysid_bench.reference import keys, package_pages, plugin_pages
from sysid_bench.reference.command_page import commands_page
from sysid_bench.reference.page_text import code, markdown_line, page, table
from sysid_bench.words import CELL_FIELDS, STATUSES

Page = Callable[[], str]


def pages(group: click.Group) -> Mapping[str, Page]:
    """Return the pages of the reference, each a function that makes its Markdown; `group` has the
    verbs."""
    return {
        "index": _index,
        "commands": partial(commands_page, group),
        **{name: partial(keys.keys_page, name) for name in keys.FILES},
        "conditions": _conditions,
        "estimators": plugin_pages.estimator_page,
        **{name: partial(plugin_pages.plugin_page, name) for name in plugin_pages.PAGES},
        **{name: partial(plugin_pages.words_page, name) for name in _words()},
        "payloads": plugin_pages.payload_page,
        "metrics": plugin_pages.metrics_page,
        "python": package_pages.package_page,
        "json": package_pages.result_page,
    }


def title_by_page() -> Mapping[str, str]:
    """Return the title of each page but the index; no plug-in is imported for it."""
    return {
        "commands": "Verbs and options",
        **{name: title for name, (title, _) in keys.FILES.items()},
        "conditions": "Conditions on cells",
        "estimators": plugin_pages.TITLES["estimator"],
        **{name: plugin_pages.page_title(name) for name in (*plugin_pages.PAGES, *_words())},
        "payloads": "Payloads",
        "metrics": "Metrics",
        "python": "Python API",
        "json": "JSON of results",
    }


def _words() -> list[str]:
    """Pages of words alone; other words stand on the page of their plug-ins."""
    return [name for name in plugin_pages.WORD_PAGES if name not in plugin_pages.PAGES]


def _index() -> str:
    rows = [
        (f"[{name}]({name}.md)", markdown_line(title)) for name, title in title_by_page().items()
    ]
    return page("# Reference", "Made from the code.", table(("page", "about"), rows))


def _conditions() -> str:
    """Fields that conditions on cells may name."""
    fields = [(code(name),) for name in sorted(CELL_FIELDS)]
    return page(
        "# Conditions on cells",
        "`--select`, `when` and `select` compare fields with values, joined by `and`, `or` and "
        '`not`: `robot == "panda" and noise.tau < 0.01`, `estimator in ["ols", "wls"]`. A setting '
        "of a plug-in is a field as well, as `estimator.weight`. Conditions on rows also take "
        "`status` and every [metric](metrics.md).",
        table(("field of a cell",), fields),
        "`status` is one of " + ", ".join(map(code, STATUSES)) + ", see [statuses](statuses.md).",
        f"Tables of a suite that have conditions: {', '.join(_with_conditions())}.",
    )


def _with_conditions() -> list[str]:
    return [
        code(section.heading)
        for section in keys.key_tables(Suite)
        if {"select", "when"} & set(section.model.model_fields)
    ]
