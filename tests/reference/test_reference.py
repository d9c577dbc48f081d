"""The reference names everything that a user can type, and says what it is."""

from collections.abc import Mapping

import click
import pytest
from pydantic import BaseModel

import sysid_bench
from sysid_bench.commands import request
from sysid_bench.commands.main import main
from sysid_bench.commands.table import VERBS
from sysid_bench.metrics import METRICS
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.plugin_names import BUILTIN, resolve
from sysid_bench.reference.find_help import find_page
from sysid_bench.reference.keys import FILES as KEYS
from sysid_bench.reference.keys import key_notes, key_tables
from sysid_bench.reference.page import markdown_line, markdown_text
from sysid_bench.reference.pages import (
    EXIT_CODES,
    PLUGINS,
    commands,
    pages,
    plain_types,
    sources,
)
from sysid_bench.words import CELL_FIELDS, STATUSES

FILES: Mapping[str, type[BaseModel]] = {name: model for name, (_, model) in KEYS.items()}

LEAST_TABLES = {"suite": 5, "robot": 5, "log": 5, "dataset": 3}


@pytest.fixture(scope="module")
def texts() -> dict[str, str]:
    """The Markdown of each page."""
    return {name: str(find_page(name, main)) for name in pages(main)}


def part(text: str, heading: str) -> str:
    """A section of a page, without those that follow it."""
    _, found, after = text.partition(f"\n{heading}\n")
    assert found, f"{heading} is missing"
    return after.partition("\n## ")[0]


def test_every_plugin_has_a_section_with_its_docstring(texts: dict[str, str]) -> None:
    page_of = {kind: page for page, (_, kinds) in PLUGINS.items() for kind in kinds}
    assert set(page_of) == set(BUILTIN) - {"metric"}
    for kind, page in page_of.items():
        for name in BUILTIN[kind]:
            assert f"# `{name}`\n" in texts[page]
            assert markdown_text(resolve(kind, name).__doc__) in texts[page], name


@pytest.mark.parametrize("name", BUILTIN["estimator"])
def test_an_estimator_states_what_it_reads(texts: dict[str, str], name: str) -> None:
    section = part(texts["estimators"], f"## `{name}`")
    simulates = hasattr(resolve("estimator", name), "fit")
    assert ("| Reads | signals, simulator |" in section) == simulates
    assert all(markdown_line(source) in section for source in sources(name))


def test_sources_are_read_from_docstrings() -> None:
    assert sources("huber") == ["Huber (1964)", "Holland and Welsch (1977)"]
    assert sources("lmi") == ["Sousa and Cortesao (2014)", "Wensing, Kim, Slotine (2018)"]
    assert sum(bool(sources(name)) for name in BUILTIN["estimator"]) >= 25


def test_every_metric_has_a_line_with_its_formula(texts: dict[str, str]) -> None:
    lines = {line.split("`")[1]: line for line in texts["metrics"].splitlines() if "| `" in line}
    assert set(lines) == set(METRICS)
    assert all(markdown_line(METRICS[name].formula) in line for name, line in lines.items())


def test_every_verb_and_option_is_listed(texts: dict[str, str]) -> None:
    names = [name for name, _ in commands(main)]
    assert set(names) == set(VERBS)
    assert "baseline save" in names
    for name, command in commands(main):
        section = part(texts["commands"], f"## `{name}`")
        for option in command.params:
            if isinstance(option, click.Option):
                assert option.opts[-1] in section, f"{name} {option.opts}"
                assert markdown_line(option.get_help_record(click.Context(command))[1]) in section  # type: ignore[index]


@pytest.mark.parametrize("page", FILES)
def test_every_table_of_a_file_is_reached(page: str) -> None:
    headings = [section.heading for section in key_tables(FILES[page])]
    assert len(headings) == len(set(headings)) >= LEAST_TABLES[page]


@pytest.mark.parametrize("page", FILES)
def test_every_key_says_what_it_means(page: str) -> None:
    """By a comment, or in the docstring of its table."""
    silent = [
        f"{section.heading} {name}"
        for section in key_tables(FILES[page])
        for name, note in key_notes(section.model).items()
        if name in section.model.model_fields
        and not note
        and f"`{name}`" not in str(section.model.__doc__)
    ]
    assert not silent


def test_defaults_and_words_are_those_of_the_checks(texts: dict[str, str]) -> None:
    line = next(line for line in texts["suite"].splitlines() if line.startswith("| `on_fail` "))
    assert line.split(" | ")[1:3] == ["`skip-robot`, `continue`", '`"skip-robot"`']
    line = next(line for line in texts["suite"].splitlines() if line.startswith("| `timeout` "))
    assert line.split(" | ")[1:3] == ["quantity in s, positive", '`"60 s"`']


def test_the_python_api_and_the_results_are_whole(texts: dict[str, str]) -> None:
    for name in sysid_bench.__all__:
        assert f"\n## `{name}`\n" in texts["python"]
    for name in ("RunResult", "CrosscheckResult", "GateResult", "ClaimsResult"):
        assert f"\n## `{name}`\n" in texts["json"]
    assert "| `exit_code` | `int` |" in part(texts["json"], "## `RunResult`")


def test_conditions_payloads_and_exit_codes(texts: dict[str, str]) -> None:
    assert all(f"| `{name}` |" in texts["conditions"] for name in CELL_FIELDS)
    assert all(f"`{name}`" in texts["conditions"] for name in STATUSES)
    assert all(f"| `{name}` |" in texts["statuses"] for name in STATUSES)
    assert all(f"| `{name}` |" in texts["payloads"] for name in PAYLOADS)
    assert {request.OK, request.FAILED, request.USAGE, request.INTERRUPTED} <= set(EXIT_CODES)
    assert all(f"| {code} |" in texts["commands"] for code in EXIT_CODES)


def test_docstrings_print_as_they_are() -> None:
    assert markdown_line("a *b* `c_|d` <e>  f_") == r"a \*b\* `c_|d` &lt;e&gt; f\_"
    assert markdown_line("|x| & [y]") == r"&#124;x&#124; &amp; \[y\]"
    assert plain_types("collections.abc.Sequence[pathlib.Path]") == "Sequence[Path]"
