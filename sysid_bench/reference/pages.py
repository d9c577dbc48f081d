"""All pages of the reference by their names."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

import click

from sysid_bench.harness.suite.model import Suite
from sysid_bench.reference import keys, objects, plugins
from sysid_bench.reference.page_text import code, inline, page, table
from sysid_bench.reference.verb_page import commands_page
from sysid_bench.vocabulary import CELL_FIELDS, STATUSES

Page = Callable[[], str]


def pages(group: click.Group) -> Mapping[str, Page]:
    """Return the pages of the reference, each a function that makes its Markdown; `group` has the
    verbs."""
    return {
        "index": partial(_index, group),
        "commands": partial(commands_page, group),
        "suite": keys.suite_page,
        "robot": keys.robot_page,
        "log": keys.log_page,
        "conditions": _conditions,
        "estimators": plugins.estimators_page,
        **{name: partial(plugins.plugins_page, name) for name in plugins.PAGES},
        "payloads": plugins.payloads_page,
        "metrics": plugins.metrics_page,
        "python": objects.python_page,
        "json": objects.results_page,
    }


def _index(group: click.Group) -> str:
    rows = [
        (f"[{name}]({name}.md)", inline(_title(make)))
        for name, make in pages(group).items()
        if name != "index"
    ]
    return page("# Reference", "Made from the code.", table(("page", "about"), rows))


_TITLE: Final = "# "


def _title(make: Page) -> str:
    return make().partition("\n")[0].removeprefix(_TITLE)


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
        "## Status of a cell",
        table(("status",), [(code(status),) for status in STATUSES]),
        f"Tables of a suite that have conditions: {', '.join(_with_conditions())}.",
    )


def _with_conditions() -> list[str]:
    return [
        code(section.heading)
        for section in keys.sections(Suite)
        if {"select", "when"} & set(section.model.model_fields)
    ]
