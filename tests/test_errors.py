"""Errors: one root, and a message that says what came, what there is, what to do."""

import inspect
import string
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_bench import errors, list_
from sysid_bench.commands.catalogue import KINDS
from sysid_bench.commands.main import main
from sysid_bench.errors import (
    LISTINGS,
    MEANT,
    SHOWN,
    SysidBenchError,
    UsageError,
    count_text,
    unknown_name,
)
from sysid_bench.plugin_names import known
from sysid_bench.signals.log_keys import check_keys

CLASSES = [
    thing
    for _, thing in inspect.getmembers(errors, inspect.isclass)
    if thing.__module__ == errors.__name__
]
WORDS = st.text(string.ascii_lowercase + string.digits + "-_", min_size=1, max_size=12)


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_every_error_has_the_one_root_and_prints_its_paragraph(kind: type[Exception]) -> None:
    assert issubclass(kind, SysidBenchError)
    assert str(kind("one readable paragraph")) == "one readable paragraph"
    assert kind.__doc__


@given(name=WORDS, known=st.lists(WORDS, min_size=1, max_size=6))
def test_an_unknown_name_is_answered_with_every_known_one(name: str, known: list[str]) -> None:
    message = str(unknown_name("robot", name, known, "Or give a path."))
    assert message.startswith(f"No robot is called {name!r}.")
    assert f"There are: {', '.join(sorted(set(known)))}." in message
    assert message.endswith("Or give a path.")


@given(name=WORDS, known=st.lists(WORDS, max_size=6))
def test_a_hint_is_a_name_that_exists(name: str, known: list[str]) -> None:
    message = str(unknown_name("robot", name, known))
    if "Did you mean" in message:
        hint = message.split("Did you mean ")[1].split("?")[0]
        assert hint.strip("'") in known


@pytest.mark.parametrize("kind", MEANT)
def test_words_of_the_literature_lead_to_a_name_that_exists(kind: str) -> None:
    names = known(kind)
    for word, meant in MEANT[kind].items():
        assert meant in names, word
        assert word not in names, f"{word} is a name itself"
        message = str(unknown_name(kind, word.upper().replace("-", "_"), names))
        assert f"Did you mean {meant!r}?" in message
        assert f"The nearest of {len(names)}: {meant}" in message


@given(name=WORDS, others=st.lists(WORDS, max_size=6))
def test_capitals_and_underscores_are_no_other_name(name: str, others: list[str]) -> None:
    written = name.upper().replace("-", "_")
    if any(one != name and one.replace("_", "-") == name.replace("_", "-") for one in others):
        return  # two names that differ by underscores alone
    assert f"Did you mean {name!r}?" in str(unknown_name("robot", written, [*others, name]))


@given(name=st.text(string.ascii_lowercase, min_size=4, max_size=10), known=st.lists(WORDS))
def test_a_slip_of_one_letter_is_recognised(name: str, known: list[str]) -> None:
    # Digits keep the other names far from the name, so that the slip has one nearest name.
    others = [f"{i}{'0' * len(name)}" for i in range(len(known))]
    message = str(unknown_name("robot", name[:-1], [*others, name]))
    assert f"Did you mean {name!r}?" in message


def test_of_many_names_the_near_ones_are_listed() -> None:
    known = [f"joint{k}" for k in range(20)]
    message = str(unknown_name("robot", "joint", [*known, "xy"]))
    listed = message.split("The nearest of 21: ")[1].rstrip(".").split(", ")
    assert len(set(listed)) == SHOWN
    assert set(listed) <= set(known)


def test_where_nothing_is_near_the_message_has_the_command_that_lists_all() -> None:
    known = [f"joint{k}" for k in range(10, 30)]
    first = ", ".join(known[:SHOWN])
    assert str(unknown_name("robot", "xyz", known)) == (
        f"No robot is called 'xyz'. There are {first} and 12 more (all: sysid-bench list robots)."
    )
    assert str(unknown_name("joint", "xyz", known)).endswith(f"There are {first} and 12 more.")


def test_every_kind_of_the_catalogue_has_its_command(capsys: pytest.CaptureFixture[str]) -> None:
    for kind, command in LISTINGS.items():
        if kind != "name":
            words = command.strip(" ()").split("sysid-bench ")[1].split()
            assert main(words, standalone_mode=False) in (0, None)
    assert capsys.readouterr().out
    with pytest.raises(UsageError) as refusal:
        list_("xyzzy")
    assert str(refusal.value).endswith(f" and {len(KINDS) - SHOWN} more.")


def test_where_nothing_exists_the_message_says_so() -> None:
    message = str(unknown_name("suite", "smoke", []))
    assert message == "No suite is called 'smoke'. There is no suite at all."


@pytest.mark.parametrize(("count", "text"), [(0, "0 models"), (1, "1 model"), (2, "2 models")])
def test_a_count_agrees_with_its_noun(count: int, text: str) -> None:
    assert count_text(count, "model") == text


LOG = {"joints": ["a"], "q": {"columns": [1]}, "tau": {"columns": [2]}, "rate": 100}


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"payload": 0.9}, "payload: must be a text or a table; got 0.9."),
        ({"q": [1, 2]}, "q: must be a table; got [1, 2]."),
        ({"joints": [3]}, "joints.0: must be a text; got 3."),
        ({"locked": {"b": "x"}}, "locked.b: must be a number; got 'x'."),
        ({"file": 3}, "file: must be a text or a list; got 3."),
        ({"rows": ["a", 2]}, "rows.0: must be a whole number; got 'a'."),
    ],
)
def test_a_value_of_the_wrong_type_is_named_in_words_of_toml(
    wrong: dict[str, object], sentence: str
) -> None:
    check_keys(LOG, Path("log.toml"))
    with pytest.raises(UsageError) as refusal:
        check_keys({**LOG, **wrong}, Path("log.toml"))
    assert str(refusal.value) == f"log.toml: {sentence}"
