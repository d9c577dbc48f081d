"""Every kind of name can be listed, piped and on a terminal."""

import json

import pytest

import sysid_bench
from sysid_bench.commands import terminal
from sysid_bench.commands.catalogue import KINDS, WORDS
from sysid_bench.reporting.tables import INTERVALS, STATISTICS
from sysid_bench.signals.filter import FORMS
from sysid_bench.words import INTEGRATORS, STATUSES, TERMS

from .conftest import Run


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_has_names_with_a_title(kind: str) -> None:
    entries = sysid_bench.list_(kind)
    assert entries
    assert all(entry["name"] and entry["title"] for entry in entries)
    singular = "status" if kind == "statuses" else kind.removesuffix("s")
    assert sysid_bench.list_(singular) == entries


def test_help_of_list_names_every_kind(cli: Run) -> None:
    text = " ".join(cli("list", "--help").stdout.replace("-\n", "-").split())
    assert set(KINDS) == set(text.partition("One of ")[2].partition(".")[0].split(", "))


def test_words_are_those_that_the_checks_know() -> None:
    known = {
        "terms": TERMS, "filters": FORMS, "integrators": INTEGRATORS, "statistics": STATISTICS,
        "intervals": INTERVALS, "statuses": STATUSES,
    }  # fmt: skip
    assert {kind: list(words) for kind, words in WORDS.items()} == {
        kind: list(words) for kind, words in known.items()
    }


@pytest.mark.parametrize("name", ["viscous", "rk4", "average N", "slurm"])
def test_a_word_is_shown(cli: Run, name: str) -> None:
    done = cli("show", name, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["title"]


@pytest.mark.parametrize("columns", [40, 80, 200])
@pytest.mark.parametrize("kind", ["estimators", "metrics", "statuses"])
def test_on_a_terminal_a_list_fits(
    cli: Run, monkeypatch: pytest.MonkeyPatch, kind: str, columns: int
) -> None:
    names = [entry["name"] for entry in sysid_bench.list_(kind)]
    least = max(map(len, names)) + 22
    monkeypatch.setattr(terminal, "on_terminal", lambda: True)
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("LINES", "30")
    lines = cli("list", kind).stdout.splitlines()
    assert all(len(line) <= max(columns, least) for line in lines if line[:3] != "...")
    assert len(lines) <= 30
    *_, last = lines
    shown = [line.split()[0] for line in lines if not line.startswith((" ", "..."))]
    assert shown == names[: len(shown)]
    if len(shown) < len(names):
        assert f"{len(names) - len(shown)} more of {len(names)}" in last
        assert f"sysid-bench list {kind} | less" in last


def test_a_piped_list_has_a_line_each(cli: Run) -> None:
    entries = sysid_bench.list_("estimators")
    lines = cli("list", "estimators").stdout.splitlines()
    marks = ["(not ranked) " * ("frame_dependent" in entry) for entry in entries]
    assert "(not ranked) " in marks
    assert [line.split(maxsplit=1) for line in lines] == [
        [entry["name"], mark + entry["title"]] for mark, entry in zip(marks, entries, strict=True)
    ]


def test_without_a_kind_the_kinds_are_listed(cli: Run) -> None:
    assert [entry["name"] for entry in sysid_bench.list_()] == list(KINDS)
    done = cli("list")
    assert done.returncode == 0
    assert [line.split()[0] for line in done.stdout.splitlines()] == list(KINDS)
