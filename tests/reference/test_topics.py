"""`help` finds everything that the reference holds, by its name."""

from collections.abc import Mapping

import pytest
from click.testing import CliRunner

import sysid_bench
from sysid_bench.commands.catalogue import WORDS
from sysid_bench.commands.main import main
from sysid_bench.errors import UsageError
from sysid_bench.metrics import METRICS
from sysid_bench.plugin_names import BUILTIN
from sysid_bench.reference.find_help import find_help, find_page
from sysid_bench.reference.keys import FILES, key_tables
from sysid_bench.reference.page import Entry
from sysid_bench.reference.pages import commands, pages, title_by_page


@pytest.fixture(scope="module")
def entries() -> dict[str, list[Entry]]:
    """The entries of each page."""
    return {name: find_page(name, main).entries(name) for name in pages(main)}


@pytest.fixture(scope="module")
def names(entries: Mapping[str, list[Entry]]) -> set[str]:
    """The whole name of each entry."""
    return {entry.name_on_page for page in entries.values() for entry in page}


def test_every_plugin_metric_verb_and_word_is_an_entry(names: set[str]) -> None:
    words = {name.partition(".")[2] for name in names}
    for kind in set(BUILTIN) - {"metric"}:
        assert words >= set(BUILTIN[kind]), kind
    assert {f"metrics.{name}" for name in METRICS} <= names
    assert {f"commands.{name}" for name, _ in commands(main)} <= names
    assert {f"{kind}.{word}" for kind in WORDS for word in WORDS[kind]} <= names
    assert {f"python.{name}" for name in sysid_bench.__all__} <= names


@pytest.mark.parametrize("page", FILES)
def test_every_key_is_an_entry_under_its_table(names: set[str], page: str) -> None:
    for section in key_tables(FILES[page][1]):
        table = section.heading.strip("[]")
        for name, field in section.model.model_fields.items():
            path = (page, table, field.alias or name)
            assert ".".join(filter(None, path)) in names


def test_every_option_is_an_entry_under_its_verb(names: set[str]) -> None:
    for name, command in commands(main):
        for param in command.params:
            if param.param_type_name == "option":
                assert {f"commands.{name}.{word}" for word in param.opts} <= names


def test_whole_names_are_one_entry_each(entries: Mapping[str, list[Entry]]) -> None:
    for page, found in entries.items():
        whole = [entry.name_on_page for entry in found if entry.is_section]
        assert len(whole) == len(set(whole)), page


def test_titles_are_those_of_the_pages() -> None:
    assert set(title_by_page()) == set(pages(main)) - {"index"}
    for name, title in title_by_page().items():
        assert str(find_page(name, main)).startswith(f"# {title}\n"), name


@pytest.mark.parametrize(
    ("asked", "found"),
    [
        ("run.memory", ["suite.run.memory"]),
        ("suite.run.memory", ["suite.run.memory"]),
        ("[run]", ["commands.run", "suite.run", "python.run", "python.LimitsResult.run"]),
        ("memory", ["statuses.memory", "suite.run.memory"]),
        ("huber", ["estimators.huber"]),
        ("huber.cut", ["estimators.huber.cut"]),
        ("baseline save", ["commands.baseline save"]),
        ("robot.name", ["robot.name"]),
        ("viscous", ["terms.viscous", "robot.joints.viscous"]),
        ("exit-codes", ["commands.exit-codes"]),
    ],
)
def test_a_name_finds_its_entries(asked: str, found: list[str]) -> None:
    assert [entry.name_on_page for entry in find_help(asked, main).entries] == found


@pytest.mark.parametrize("asked", ["metrics", "metric", "log readers", "log_reader"])
def test_a_topic_is_its_page(asked: str) -> None:
    topic = find_help(asked, main)
    assert topic.text == str(find_page(topic.name, main))
    assert topic.title == title_by_page()[topic.name]


def test_a_name_of_many_entries_lists_them() -> None:
    result = sysid_bench.help_("--json")
    assert len(result.entries) > 10
    assert all(f"`commands.{name}.--json`" in result.text for name in ("plan", "lint"))


def test_an_unknown_topic_names_the_nearest() -> None:
    with pytest.raises(UsageError, match="Did you mean 'estimators'"):
        find_help("estimatos", main)


def test_help_lists_its_topics_and_prints_json() -> None:
    done = CliRunner().invoke(main, ["help"])
    assert all(f"| `{name}` | {title} |" in done.stdout for name, title in title_by_page().items())
    result = sysid_bench.help_("statuses")
    assert list(result) == ["topic", "title", "text", "entries"]
    assert [entry["name"] for entry in result.entries] == list(WORDS["statuses"])
    assert all(entry["title"] for entry in result.entries)
